"""Sound records of every kind, and their readers."""

import subprocess
import tempfile
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pyarrow as pa

from damage import reseal, sha256
from synthetic import episodes, reach_episodes
from tiny_protocol import write_tiny
from wbc_bench.evaluation.evaluate import evaluate
from wbc_bench.results.analysis import collect_all
from wbc_bench.results.doors import door_table, read_doors, write_doors
from wbc_bench.results.margins import analyse
from wbc_bench.results.report import figure_html, given_caption
from wbc_bench.results.run_writer import RunWriter
from wbc_bench.results.store import ResultStore, Run, RunKey, ShardCost
from wbc_bench.results.stress import (
    FactorRecord,
    LadderRecord,
    LevelRecord,
    keep_ladder,
    read_stress,
    stress_folder,
)
from wbc_bench.results.study import Study
from wbc_bench.results.submission import pack, read_submission
from wbc_bench.results.table import Table, read_markdown
from wbc_bench.results.tables.reach import reach_table
from wbc_bench.results.tables.strata import outcome_table, stratum_table
from wbc_bench.results.tables.stress import breaking_table, curve_table
from wbc_bench.results.tracking import Tracked, read_tracks, tracking_table, write_track
from wbc_bench.viewer.rerun import rerun

MADE = {"git_commit": None, "git_dirty": False, "versions": {"a": "1"}, "machine": {"cpu": "x", "cores": 2}}
MADE |= {"created": "2026-01-01T00:00:00+00:00"}
FACTS = {"controller_name": "a", "signals": ["ee_pose"], "source": "x", "checkpoint_sha256": None}
FACTS |= {"workers": 1, "engine": "loky", "wall_time_s": 1.0} | MADE


def _key(protocol: str, count: int, shard_episodes: int = 50) -> RunKey:
    return RunKey(
        protocol=protocol,
        protocol_digest="d" * 64,
        manifest_sha256="e" * 64,
        controller="a:b",
        replicate=0,
        requested=count,
        shard_episodes=shard_episodes,
        software_sha256="f" * 64,
    )


def write_runs(folder: Path) -> None:
    for name, frame in (("mine", episodes(0, 30, 0.5, 1)), ("reach", reach_episodes(0)[:200])):
        writer = RunWriter(ResultStore(folder), _key(name, len(frame)))
        for shard in writer.missing:
            rows = writer.rows(shard)
            table = pa.Table.from_pandas(frame[rows.start : rows.stop], preserve_index=False)
            writer.write(shard, table, ShardCost(1.0, 2.0))
        writer.finish(FACTS)
        writer.close()


def read_runs(folder: Path) -> None:
    for protocol, evaluated in collect_all(ResultStore(folder).runs()).items():
        study = Study(protocol, protocol)
        for make in (outcome_table, stratum_table, reach_table):
            make(study, evaluated).markdown()


def seal_runs(folder: Path) -> None:
    for path in folder.glob("runs/*/*/*/run.json"):
        reseal(path, "episodes_sha256", path.with_name("episodes.parquet"))


def write_submissions(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        write_runs(Path(scratch))
        known = {"resolved_controller": "a:b", "controller_sha256": "a" * 64}
        runs = [
            Run(run.path, msgspec.structs.replace(run.record, **known))
            for run in ResultStore(scratch).runs("mine")
        ]
        (folder / "mine.zip").write_bytes(pack("mine", runs, "a card"))


def read_submissions(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        assert read_submission(folder / "mine.zip", Path(scratch)).name == "mine"


def write_climbs(folder: Path) -> None:
    record = LadderRecord(
        *("mine", "ablation_v1", LevelRecord(0.0, "mine@base", "d" * 64), 6),
        (FactorRecord("a", "A", "m", tuple(LevelRecord(v, f"mine@a@{v:g}", "d" * 64) for v in (1.0, 2.0))),),
    )
    root = stress_folder(folder, "mine")
    root.mkdir(parents=True)
    keep_ladder(root, record)
    for name in ("mine@base", "mine@a@1", "mine@a@2"):
        frame = episodes(0, 6, 0.9, 1)
        writer = RunWriter(ResultStore(root), _key(name, len(frame)))
        writer.write(0, pa.Table.from_pandas(frame, preserve_index=False), ShardCost(1.0, 2.0))
        writer.finish(FACTS)
        writer.close()


def read_climbs(folder: Path) -> None:
    for stress in read_stress(folder):
        found = analyse(stress)
        breaking_table(stress, found).markdown()
        curve_table(stress, found).markdown()


def seal_climbs(folder: Path) -> None:
    for path in folder.glob("stress/*/runs/*/*/*/run.json"):
        reseal(path, "episodes_sha256", path.with_name("episodes.parquet"))


def write_tracks(folder: Path) -> None:
    time = np.arange(100, dtype=np.float64) * 0.02
    pos = np.stack([np.sin(time), np.cos(time), time], axis=1)
    facts = {"source": "s", "source_sha256": None, "controller": "ik", "signals": ["ee_pose"], "seed": 0}
    facts |= {"condition": "nominal", "requested_s": 2.0, "counters": {"accepted": 1}}
    tracked = Tracked(0.02, "stood", pos, pos + 0.01, time * 0.01, time * 0.02)
    write_track(folder, tracked, **facts, **MADE, software_sha256="f" * 64)


def read_all_tracks(folder: Path) -> None:
    tracking_table(read_tracks(folder)).markdown()


def seal_tracks(folder: Path) -> None:
    for path in folder.glob("tracks/*/*/*/track.json"):
        reseal(path, "series_sha256", path.with_name("series.parquet"))


def write_door_runs(folder: Path) -> None:
    count, rng = 6, np.random.default_rng(0)
    names = ("x", "y", "z", "yaw", "angle", "final_angle")
    frame = pd.DataFrame({name: rng.normal(size=count) for name in names})
    frame["outcome"], frame["steps"] = ["stood"] * 5 + ["fell"], 100
    frame["success"] = [True, True, False, True, True, False]
    frame["first_closed"] = np.where(frame["success"], 3.0, np.nan)
    facts = {"source": "expert", "policy_sha256": None, "controller": "ik", "signals": ["ee_pose"], "seed": 1}
    facts |= {"condition": "nominal", "requested": count, "duration": 12.0, "closed_below": 0.1}
    write_doors(folder, frame, **facts, **MADE, software_sha256="f" * 64)


def read_door_runs(folder: Path) -> None:
    door_table(read_doors(folder)).markdown()


def seal_door_runs(folder: Path) -> None:
    for path in folder.glob("doors/*/*/*/run.json"):
        reseal(path, "episodes_sha256", path.with_name("episodes.parquet"))


def write_report_parts(folder: Path) -> None:
    table = Table("t", "A table", ("Name", "Value"), (("a", "1"), ("b", "2")), ("a note",))
    table.write(folder)
    (folder / "strip_a.png").write_bytes(b"\x89PNG")
    (folder / "strip_a.json").write_text('{"caption": "what it shows", "more": [1, 2]}')
    (folder / "strip_b.png").write_bytes(b"\x89PNG")
    (folder / "strip_b.txt").write_text("what it shows")


def read_report_parts(folder: Path) -> None:
    read_markdown(folder / "t.md").html()
    for name in ("strip_a.png", "strip_b.png"):
        figure_html(folder / name, given_caption(folder / name))


KEPT = ("protocols/tiny.parquet", "runs/tiny/hold/replicate_0")


def write_replayed(folder: Path) -> None:
    write_tiny(folder, 1, 2)
    (folder / "store").mkdir()
    evaluate("hold", str(folder / "tiny.toml"), out=folder / "store")
    for path in folder.glob("tiny.*"):  # its copy beside the run is what is read
        path.unlink()


def read_replayed(folder: Path) -> None:
    rerun(ResultStore(folder / "store").find("tiny/hold/replicate_0"), 1)


def seal_replayed(folder: Path) -> None:
    manifest, run = (folder / "store" / name for name in KEPT)
    manifest.with_suffix(".sha256").write_text(f"{sha256(manifest)}  tiny.parquet\n")
    reseal(run / "run.json", "manifest_sha256", manifest)
    reseal(run / "run.json", "episodes_sha256", run / "episodes.parquet")


def write_shards(folder: Path) -> None:
    frame = episodes(0, 30, 0.5, 1)
    writer = RunWriter(ResultStore(folder), _key("mine", len(frame), 10))
    for shard in (0, 2):
        rows = writer.rows(shard)
        table = pa.Table.from_pandas(frame[rows.start : rows.stop], preserve_index=False)
        writer.write(shard, table, ShardCost(1.0, 2.0))
    writer.close()


def read_shards(folder: Path) -> None:
    """Resume in a copy: a damaged shard is moved aside, computed again, and all are merged."""
    frame = episodes(0, 30, 0.5, 1)
    with tempfile.TemporaryDirectory() as copy:
        subprocess.run(["cp", "-a", f"{folder}/.", copy], check=True)  # pipes, too
        writer = RunWriter(ResultStore(copy), _key("mine", len(frame), 10))
        try:
            for shard in writer.missing:
                rows = writer.rows(shard)
                table = pa.Table.from_pandas(frame[rows.start : rows.stop], preserve_index=False)
                writer.write(shard, table, ShardCost(1.0, 2.0))
            made = writer.finish(FACTS).table().replace_schema_metadata()
            assert made.equals(pa.Table.from_pandas(frame, preserve_index=False).replace_schema_metadata())
        finally:
            writer.close()
