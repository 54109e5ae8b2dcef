"""Everything that follows from the records: tables, figures and report, of every protocol that has a run."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pandas as pd

from wbc_bench import door_records, plots, report, tables, tracking, workspace
from wbc_bench.errors import StoreError, UnknownNameError
from wbc_bench.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.protocol import PROTOCOL_DIR, ReachTargets, load_protocol, protocol_names
from wbc_bench.store import ResultStore


def publish(store: ResultStore, out: Path, beside: Sequence[str] = ()) -> list[Path]:
    """Write <out>/tables, <out>/figures and <out>/report.html; equal records give equal bytes.

    They are made in a folder of their own and moved when all of them are there. `beside` names the
    controllers shown side by side over the workspace; the best two of each protocol otherwise.

    Raises:
        StoreError: the store has no run, mixes digests, or the folder cannot be written.
        UnknownNameError: a controller named has no run under any protocol.
    """
    protocols = sorted({run.record.protocol for run in store.runs()})
    tracks = tracking.read_tracks(store.root)
    doors = door_records.read_doors(store.root)
    if not protocols and not tracks and not doors:
        raise StoreError(f"no finished run under '{store.root}': nothing to make tables of")
    known = {run.record.controller for run in store.runs()}
    for spec in beside:
        if spec not in known:
            raise UnknownNameError("evaluated controller", spec, known, "--workspace")
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".publish-", dir=out) as folder:
            made = Path(folder)
            for protocol in protocols:
                _write_protocol(store, protocol, made, beside)
            _write_tracks(tracks, made)
            _write_doors(doors, made)
            report.write(store, made, out)
            return [
                _move(path, out / path.relative_to(made))
                for path in sorted(made.rglob("*"))
                if path.is_file()
            ]


def publish_tracks(root: Path, out: Path) -> list[Path]:
    """Write the table and the figure of the tracks under `root` alone.

    Raises: StoreError when a track cannot be read or the folder cannot be written.
    """
    with _writing(out):
        return _write_tracks(tracking.read_tracks(root), out)


def publish_doors(root: Path, out: Path) -> list[Path]:
    """Write the table of the doors under `root` alone.

    Raises: StoreError when a run cannot be read or the folder cannot be written.
    """
    with _writing(out):
        return _write_doors(door_records.read_doors(root), out)


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot write to '{out}': {error.strerror}") from error


def target_frame(manifest: EpisodeManifest) -> pd.DataFrame:
    """What a picture of a manifest's targets needs; metres."""
    x, y, height = manifest.target_pos_w.T
    return pd.DataFrame({"target_x": x, "target_y": y, "height": height, "stratum": manifest.stratum})


def _write_protocol(store: ResultStore, name: str, out: Path, beside: Sequence[str]) -> None:
    released = load_protocol(PROTOCOL_DIR / f"{name}.toml") if name in protocol_names() else None
    if released and isinstance(released.targets, ReachTargets):
        tables.write_reach(store, name, out / "tables")
        plots.write_reach(store, name, out / "figures")
    else:
        study = tables.ABLATION if name == tables.ABLATION.protocol else tables.Study(name, ())
        tables.write_study(store, study, out / "tables")
        plots.write_study(store, study, out / "figures")
        known = {run.record.controller for run in store.runs(name)}
        workspace.write_workspace(store, study, out / "figures", [spec for spec in beside if spec in known])
    if released:
        manifest, _ = read_manifest(released, manifest_path(PROTOCOL_DIR / f"{name}.toml"))
        plots.write_targets(target_frame(manifest), name, out / "figures")


def _write_tracks(tracks: list[tracking.Track], out: Path) -> list[Path]:
    if not tracks:
        return []
    paths = tracking.tracking_table(tracks).write(out / "tables")
    return paths + plots.write_tracking(tracks, out / "figures")


def _write_doors(runs: list[door_records.DoorRun], out: Path) -> list[Path]:
    return door_records.door_table(runs).write(out / "tables") if runs else []


def _move(source: Path, destination: Path) -> Path:
    destination.parent.mkdir(parents=True, exist_ok=True)
    return source.replace(destination)
