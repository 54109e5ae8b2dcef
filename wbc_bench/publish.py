"""Everything that follows from the records: tables, figures and report, of every protocol that has a run."""

import contextlib
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd

from wbc_bench.episodes.conditions import conditions_of
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import (
    EvalProtocol,
    ReachTargets,
    find_protocol,
    load_protocol,
    protocol_names,
)
from wbc_bench.errors import BenchError, StoreError, UnknownNameError
from wbc_bench.files import PROTOCOLS, made_whole
from wbc_bench.results import report
from wbc_bench.results.analysis import Evaluated, collect_all, label_of
from wbc_bench.results.doors import DoorRun, door_table, read_doors
from wbc_bench.results.figures.reach import write_reach_figures
from wbc_bench.results.figures.stress import write_stress_figure
from wbc_bench.results.figures.study import write_study_figures
from wbc_bench.results.figures.style import controller_colours
from wbc_bench.results.figures.targets import write_targets
from wbc_bench.results.figures.tracking import write_tracking
from wbc_bench.results.figures.workspace import write_workspace
from wbc_bench.results.gallery import Told
from wbc_bench.results.kept import NOTE, KeptParts
from wbc_bench.results.margins import analyse
from wbc_bench.results.store import ResultStore
from wbc_bench.results.stress import read_stress
from wbc_bench.results.study import (
    Study,
    StudyError,
    labels_of,
    released_rows,
    released_studies,
    studies_of,
)
from wbc_bench.results.tables.stress import write_stress_tables
from wbc_bench.results.tables.write import write_reach_tables, write_sealed_tables, write_study_tables
from wbc_bench.results.tracking import Track, read_tracks, tracking_table
from wbc_bench.robot import RobotConfig


def publish(
    store: ResultStore, out: Path, beside: Sequence[str] = (), studies: Sequence[Study] = ()
) -> list[Path]:
    """Write `<out>/tables`, `<out>/figures` and `<out>/report.html`; equal records give equal bytes.

    They are made in a folder of their own and moved when all of them are there. What follows from the same
    records and code as the files of the last report in the folder is taken from it.

    Args:
        store: The records.
        out: The folder that is written.
        beside: Controllers shown side by side over the workspace; the best two of each protocol when empty.
        studies: Studies besides the released ones; one of the same name takes the place of a released one.

    Raises:
        StoreError: The store has no run, mixes digests, or the folder cannot be written.
        StudyError: A study has the name of a protocol that is not its own.
        UnknownNameError: A controller named has no run under any protocol.
    """
    known_studies = list({study.name: study for study in (*released_studies(), *studies)}.values())
    rows = [row for study in known_studies for row in study.rows]
    labels = labels_of(rows)
    collected = collect_all(store.runs(), labels)
    released = {name: load_protocol(name) for name in protocol_names() if name in collected}
    evaluated = {name: collected[name] for name in sorted(collected, key=lambda name: _place(name, released))}
    for study in known_studies:
        if study.name != study.protocol and study.name in evaluated:
            raise StudyError(
                f"study '{study.name}' of {study.protocol}: its name is that of another protocol with runs"
            )
    tracks, doors = read_tracks(store.root), read_doors(store.root)
    ladders = read_stress(store.root, labels)
    for name in (stress.ladder.name for stress in ladders):
        if name in evaluated or name in {study.name for study in known_studies}:
            raise StoreError(f"ladder '{name}' has the name of a protocol with runs or of a study: rename it")
    if not evaluated and not tracks and not doors and not ladders:
        raise StoreError(f"no finished run under '{store.root}': nothing to make tables of")
    known = {spec for methods in evaluated.values() for spec in methods}
    for spec in beside:
        if spec not in known:
            raise UnknownNameError("evaluated controller", spec, known, "--workspace")
    specs = known | {track.record.controller for track in tracks}
    specs |= {climb.spec for stress in ladders for climb in stress.climbs}
    colours = controller_colours({spec: label_of(spec, labels) or spec for spec in sorted(specs)}, rows)
    with made_whole(out) as (made, paths):
        kept = KeptParts(out, made, __name__)
        for protocol, methods in evaluated.items():
            own, shown = studies_of(protocol, known_studies), {spec: colours[spec] for spec in methods}
            records = [(method.spec, method.name, method.records) for method in methods.values()]
            kept.part(
                f"protocol {protocol}",
                (records, released.get(protocol), beside, own, shown),
                partial(_write_protocol, protocol, released.get(protocol), methods, beside, own, shown),
            )
        write_sealed_tables(evaluated, made / "tables")
        kept.part(
            "tracks",
            ([track.record for track in tracks], labels, colours),
            partial(_write_tracks, tracks, labels, colours),
        )
        _write_doors(doors, made, labels)
        for stress in ladders:
            found = analyse(stress)
            write_stress_tables(stress, found, made / "tables")
            write_stress_figure(stress, found, made / "figures", colours)
        kept.write()
        protocol_of = {study.name: study.protocol for study in known_studies}
        told = _told(store, evaluated)
        report.write(evaluated, made, out, protocol_of, ladders, os.path.relpath(store.root, out), told)
    return [path for path in paths if path.name != NOTE]


def publish_tracks(root: Path, out: Path) -> list[Path]:
    """Write the table and the figure of the tracks under `root` alone.

    Raises: StoreError when a track cannot be read or the folder cannot be written.
    """
    with made_whole(out) as (made, paths):
        _write_tracks(read_tracks(root), labels_of(released_rows()), None, made)
    return paths


def publish_doors(root: Path, out: Path) -> list[Path]:
    """Write the table of the doors under `root` alone.

    Raises: StoreError when a run cannot be read or the folder cannot be written.
    """
    with made_whole(out) as (made, paths):
        _write_doors(read_doors(root), made, labels_of(released_rows()))
    return paths


def _place(name: str, released: Mapping[str, EvalProtocol]) -> tuple[bool, str]:
    """Order of the protocols in a report: the released ones of the paper's robot lead."""
    leads = name in released and released[name].robot != RobotConfig()
    return not leads, name


def told_by(manifest: EpisodeManifest) -> Told:
    """What says of an episode of a manifest what disturbs it."""
    row_of = {key: row for row, key in enumerate(zip(manifest.replicate, manifest.episode, strict=True))}
    return lambda replicate, episode: ", ".join(conditions_of(manifest, row_of[replicate, episode]))


def _told(store: ResultStore, evaluated: Mapping[str, Mapping[str, Evaluated]]) -> dict[str, Told]:
    """Protocol -> what says how its episodes are disturbed, where the manifest of its records is here."""
    found = {}
    for name, methods in evaluated.items():
        path = PROTOCOLS / f"{name}.toml" if name in protocol_names() else store.protocol_path(name)
        with contextlib.suppress(BenchError):  # it only tells more; `replay` says what is wrong with it
            manifest, digest = read_manifest(find_protocol(str(path))[0], manifest_path(path), False)
            records = [record for method in methods.values() for record in method.records]
            if all(record.manifest_sha256 == digest for record in records):
                found[name] = told_by(manifest)
    return found


def target_frame(manifest: EpisodeManifest) -> pd.DataFrame:
    """What a picture of a manifest's targets needs; metres."""
    x, y, height = manifest.target_pos_w.T
    return pd.DataFrame({"target_x": x, "target_y": y, "height": height, "stratum": manifest.stratum})


def _write_protocol(
    name: str,
    released: EvalProtocol | None,
    methods: Mapping[str, Evaluated],
    beside: Sequence[str],
    studies: Sequence[Study],
    colours: Mapping[str, str],
    out: Path,
) -> None:
    for study in studies:
        if released and isinstance(released.targets, ReachTargets):
            write_reach_tables(study, methods, out / "tables")
            write_reach_figures(study, methods, out / "figures")
        else:
            write_study_tables(study, methods, out / "tables")
            write_study_figures(study, methods, out / "figures", colours)
            write_workspace(study, methods, out / "figures", [spec for spec in beside if spec in methods])
    if released:
        manifest, _ = read_manifest(released, manifest_path(PROTOCOLS / f"{name}.toml"))
        write_targets(target_frame(manifest), name, out / "figures")


def _write_tracks(
    tracks: list[Track], labels: Mapping[str, str], colours: Mapping[str, str] | None, out: Path
) -> None:
    if tracks:
        tracking_table(tracks, labels).write(out / "tables")
        write_tracking(tracks, out / "figures", labels, colours)


def _write_doors(runs: list[DoorRun], out: Path, labels: Mapping[str, str]) -> None:
    if runs:
        door_table(runs, labels).write(out / "tables")
