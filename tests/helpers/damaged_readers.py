"""Every reader of files on damaged ones: what is not an error of this package in one line is a fault.

Used by a short test of the suite and by the long run of `.ci/fuzz.py`.
"""

import hashlib
import re
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import pandas as pd
import torch

from damage import damage
from policies import write
from small_networks import layer, weights
from synthetic import episodes, reach_episodes
from trainers import TINY, trainer
from training_targets import PROTOCOL, TARGETS
from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.export import write_onnx
from wbc_baselines.learned.policy.onnx_engine import OnnxEngine, seal
from wbc_baselines.learned.policy.policy import Policy
from wbc_baselines.learned.training.campaign import is_done, standing
from wbc_baselines.learned.training.curves import smooth
from wbc_baselines.learned.training.run_folder import RunFolder, load_resume, save_resume
from wbc_baselines.learned.training.target_set import TargetSet, read_target_set, write_target_set
from wbc_bench.episodes import ladder
from wbc_bench.episodes.kinds import kind_of
from wbc_bench.episodes.manifest import read_manifest
from wbc_bench.episodes.protocol import find_protocol, read_protocol
from wbc_bench.episodes.sealed import Commitment, read_commitment
from wbc_bench.errors import BenchError
from wbc_bench.files import PROTOCOLS
from wbc_bench.policies.controller import from_card
from wbc_bench.policies.descriptions import draft
from wbc_bench.policies.normalizer import read_normalizers
from wbc_bench.results.analysis import collect_all
from wbc_bench.results.doors import door_table, read_doors, write_doors
from wbc_bench.results.margins import analyse
from wbc_bench.results.report import figure_html, given_caption
from wbc_bench.results.run_writer import RunWriter
from wbc_bench.results.store import ResultStore, RunKey, ShardCost
from wbc_bench.results.stress import (
    FactorRecord,
    LadderRecord,
    LevelRecord,
    keep_ladder,
    read_stress,
    stress_folder,
)
from wbc_bench.results.study import Study, load_study
from wbc_bench.results.table import Table, read_markdown
from wbc_bench.results.tables.reach import reach_table
from wbc_bench.results.tables.strata import outcome_table, stratum_table
from wbc_bench.results.tables.stress import breaking_table, curve_table
from wbc_bench.results.tracking import Tracked, read_tracks, tracking_table, write_track
from wbc_bench.robot import load_robot
from wbc_bench.robot.facts import FACTS_FILE, load_facts
from wbc_bench.sources.diffusion import policy as door_policy
from wbc_bench.sources.scripted import load_script

SMOKE = find_protocol("smoke_v1")[0]


class Reader(NamedTuple):
    """A reader, the sound files that it reads, and how their hashes are made to fit damaged ones."""

    write: Callable[[Path], None]
    read: Callable[[Path], object]
    seal: Callable[[Path], None] = lambda folder: None


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _reseal(record: Path, field: str, data: Path) -> None:
    """Put the SHA-256 of a file into the JSON beside it, damaged or not."""
    text = re.sub(
        rf'("{field}":\s*")[0-9a-f]*"', rf'\g<1>{sha256(data)}"', record.read_text(errors="replace")
    )
    record.write_text(text)


# --- protocols, manifests, studies, scripts, facts ------------------------------------------------------


def write_protocols(folder: Path) -> None:
    for name in ("smoke_v1", "reach_v1"):
        shutil.copy(PROTOCOLS / f"{name}.toml", folder)


def read_protocols(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        protocol = read_protocol(path)
        assert kind_of(protocol).num_rows(protocol) <= 100_000 and protocol.num_steps <= 30_000
        find_protocol(str(path))


def write_manifests(folder: Path) -> None:
    for suffix in ("parquet", "sha256"):
        shutil.copy(PROTOCOLS / f"smoke_v1.{suffix}", folder)


def read_manifests(folder: Path) -> None:
    path = folder / "smoke_v1.parquet"
    manifest, _ = read_manifest(SMOKE, path)
    assert len(manifest) == 12 and np.isfinite(manifest.target_pos_w).all()


def seal_manifests(folder: Path) -> None:
    (folder / "smoke_v1.sha256").write_text(f"{sha256(folder / 'smoke_v1.parquet')}  smoke_v1.parquet\n")


def write_commitments(folder: Path) -> None:
    commitment = Commitment(SMOKE.name, SMOKE.digest, "a" * 64, 12)
    (folder / "smoke_v1_sealed.commitment.json").write_bytes(msgspec.json.encode(commitment))


def read_commitments(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        commitment, _ = read_commitment(path)
        assert commitment.protocol == "smoke_v1" and commitment.episodes == 12


def write_studies(folder: Path) -> None:
    for path in (PROTOCOLS / "studies").glob("*.toml"):
        shutil.copy(path, folder)


def read_studies(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        load_study(path)


def write_ladders(folder: Path) -> None:
    for path in ladder.FOLDER.glob("*.toml"):
        shutil.copy(path, folder)


def read_ladders(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        ladder.load_ladder(path)


def write_scripts(folder: Path) -> None:
    for path in (PROTOCOLS / "scripts").glob("*.toml"):
        shutil.copy(path, folder)


def read_scripts(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        load_script(path)


def write_facts(folder: Path) -> None:
    shutil.copy(FACTS_FILE, folder)


def read_facts(folder: Path) -> None:
    load_facts.__wrapped__(path=folder / FACTS_FILE.name)


# --- records --------------------------------------------------------------------------------------------

MADE = {"git_commit": None, "git_dirty": False, "versions": {"a": "1"}, "machine": {"cpu": "x", "cores": 2}}
MADE |= {"created": "2026-01-01T00:00:00+00:00"}


def _key(protocol: str, count: int) -> RunKey:
    return RunKey(
        protocol=protocol,
        protocol_digest="d" * 64,
        manifest_sha256="e" * 64,
        controller="a:b",
        replicate=0,
        requested=count,
        shard_episodes=50,
        software_sha256="f" * 64,
    )


def write_runs(folder: Path) -> None:
    import pyarrow as pa

    facts = {"controller_name": "a", "signals": ["ee_pose"], "source": "x", "checkpoint_sha256": None}
    facts |= {"workers": 1, "engine": "loky", "wall_time_s": 1.0} | MADE
    for name, frame in (("mine", episodes(0, 30, 0.5, 1)), ("reach", reach_episodes(0)[:200])):
        writer = RunWriter(ResultStore(folder), _key(name, len(frame)))
        for shard in writer.missing:
            rows = writer.rows(shard)
            table = pa.Table.from_pandas(frame[rows.start : rows.stop], preserve_index=False)
            writer.write(shard, table, ShardCost(1.0, 2.0))
        writer.finish(facts)
        writer.close()


def read_runs(folder: Path) -> None:
    for protocol, evaluated in collect_all(ResultStore(folder).runs()).items():
        study = Study(protocol, protocol)
        for make in (outcome_table, stratum_table, reach_table):
            make(study, evaluated).markdown()


def seal_runs(folder: Path) -> None:
    for path in folder.glob("runs/*/*/*/run.json"):
        _reseal(path, "episodes_sha256", path.with_name("episodes.parquet"))


def write_climbs(folder: Path) -> None:
    import pyarrow as pa

    record = LadderRecord(
        *("mine", "ablation_v1", LevelRecord(0.0, "mine@base", "d" * 64), 6),
        (FactorRecord("a", "A", "m", tuple(LevelRecord(v, f"mine@a@{v:g}", "d" * 64) for v in (1.0, 2.0))),),
    )
    root = stress_folder(folder, "mine")
    root.mkdir(parents=True)
    keep_ladder(root, record)
    facts = {"controller_name": "a", "signals": ["ee_pose"], "source": "x", "checkpoint_sha256": None}
    facts |= {"workers": 1, "engine": "loky", "wall_time_s": 1.0} | MADE
    for name in ("mine@base", "mine@a@1", "mine@a@2"):
        frame = episodes(0, 6, 0.9, 1)
        writer = RunWriter(ResultStore(root), _key(name, len(frame)))
        writer.write(0, pa.Table.from_pandas(frame, preserve_index=False), ShardCost(1.0, 2.0))
        writer.finish(facts)
        writer.close()


def read_climbs(folder: Path) -> None:
    for stress in read_stress(folder):
        found = analyse(stress)
        breaking_table(stress, found).markdown()
        curve_table(stress, found).markdown()


def seal_climbs(folder: Path) -> None:
    for path in folder.glob("stress/*/runs/*/*/*/run.json"):
        _reseal(path, "episodes_sha256", path.with_name("episodes.parquet"))


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
        _reseal(path, "series_sha256", path.with_name("series.parquet"))


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
        _reseal(path, "episodes_sha256", path.with_name("episodes.parquet"))


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


# --- policies and training ------------------------------------------------------------------------------


def write_checkpoint(folder: Path) -> None:
    write(folder, "no_latent")


def read_checkpoint(folder: Path) -> None:
    checkpoint.load(folder / "no_latent@0.safetensors", load_robot(), SMOKE)


def seal_checkpoint(folder: Path) -> None:
    _reseal(folder / "no_latent@0.json", "sha256", folder / "no_latent@0.safetensors")


def write_exported(folder: Path) -> None:
    path = write(folder, "no_latent")
    card, actor, estimator = checkpoint.load(path)
    write_onnx(folder / "policy.onnx", Policy(actor, estimator), card)
    path.unlink()
    path.with_suffix(".json").unlink()


def read_exported(folder: Path) -> None:
    engine = OnnxEngine(folder / "policy.onnx")
    engine({name: torch.zeros(2, *shape) for name, shape in engine.flow.inputs.items()})


def seal_exported(folder: Path) -> None:
    path = folder / "policy.onnx"
    model = path.read_bytes()[: -len(seal(b""))]
    path.write_bytes(model + seal(model))


POLICY_CARD = """
name = "walker"
joints = ["J1", "J2", "J3"]
[[observation]]
name = "policy"
history = 2
terms = [
    { term = "joint_pos_rel", scale = [1.0, 0.5, 0.1] },
    { term = "projected_gravity", clip = [-1.0, 1.0] },
]
[[network]]
file = "walk.onnx"
inputs = { obs = "policy" }
outputs = { actions = "action" }
[action]
scale = 0.25
kp = [40.0, 30.0, 20.0]
"""
DEPLOY = """
step_dt: 0.02
stiffness: [40.0, 30.0, 20.0]
actions: { JointPositionAction: { joint_names: [J1, J2, J3], scale: [0.25, 0.25, 0.25] } }
observations: { joint_pos_rel: { scale: [1.0, 0.5, 0.1], history_length: 2 } }
"""


def write_policy_card(folder: Path) -> None:
    layer(folder / "walk.onnx", weights(0, 12, 3), observation_names="joint_pos,actions", action_scale="0.25")
    (folder / "card.toml").write_text(POLICY_CARD)
    (folder / "deploy.yaml").write_text(DEPLOY)


def read_policy_card(folder: Path) -> None:
    draft(folder / "walk.onnx", folder / "deploy.yaml").text()
    draft(folder / "walk.onnx", None).text()
    controller = from_card(load_robot(), folder / "card.toml")
    for network in controller.networks:
        read_normalizers(network.path, network.widths)
        network({group.name: np.zeros((2, group.size)) for group in controller.groups})


def write_door_policy(folder: Path) -> None:
    facts = {"format": 1, "seed": 0, "demonstrations": 1, "demonstrations_seed": 0, "samples": 1, "steps": 1}
    facts |= {"demonstrations_sha256": "0" * 64, "batch": 1, "hidden": 16, "git_commit": None, "torch": "0"}
    card = msgspec.convert(facts | {"git_dirty": False}, door_policy.DoorPolicyCard)
    door_policy.save_policy(folder / "door.safetensors", door_policy.Policy(16), card)


def read_door_policy(folder: Path) -> None:
    door_policy.load_policy(folder / "door.safetensors")


@cache
def a_trainer():
    return trainer()


def write_training(folder: Path) -> None:
    one = RunFolder(folder / TINY.name)
    one.open(TINY)
    for iteration in range(1, 5):
        numbers = {"iteration": iteration, "samples": 48 * iteration, "seconds": 1.5, "episode/count": 3}
        one.append(numbers | {"episode/success": 0.5, "episode/falls": None, "episode/return": 1.0})
    save_resume(a_trainer(), one, 1.0)
    one.finished.write_text('{"samples": 192, "seconds": 3.0}')
    one.claim.write_text("elsewhere 1 2")


def read_training(folder: Path) -> None:
    one = RunFolder(folder / TINY.name)
    standing(folder)
    is_done(one, TINY)
    smooth(one.read_metrics(), "episode/return")
    one.owner()
    TINY.changes(one.settings())
    load_resume(a_trainer(), one)


def write_targets(folder: Path) -> None:
    part = TargetSet(TARGETS.stratum[:30], TARGETS.pos_w[:30], TARGETS.quat_w[:30], TARGETS.witness_qpos[:30])
    write_target_set(part, PROTOCOL, folder / "targets.parquet")


def read_targets(folder: Path) -> None:
    read_target_set(PROTOCOL, folder / "targets.parquet")


READERS = {
    "protocol": Reader(write_protocols, read_protocols),
    "manifest": Reader(write_manifests, read_manifests, seal_manifests),
    "commitment": Reader(write_commitments, read_commitments),
    "study": Reader(write_studies, read_studies),
    "ladder": Reader(write_ladders, read_ladders),
    "climb": Reader(write_climbs, read_climbs, seal_climbs),
    "script": Reader(write_scripts, read_scripts),
    "facts": Reader(write_facts, read_facts),
    "run": Reader(write_runs, read_runs, seal_runs),
    "track": Reader(write_tracks, read_all_tracks, seal_tracks),
    "doors": Reader(write_door_runs, read_door_runs, seal_door_runs),
    "report": Reader(write_report_parts, read_report_parts),
    "checkpoint": Reader(write_checkpoint, read_checkpoint, seal_checkpoint),
    "onnx": Reader(write_exported, read_exported, seal_exported),
    "policy card": Reader(write_policy_card, read_policy_card),
    "door policy": Reader(write_door_policy, read_door_policy),
    "training": Reader(write_training, read_training),
    "targets": Reader(write_targets, read_targets),
}


def contents(folder: Path) -> dict[str, tuple]:
    """Every file below a folder, and what it holds."""
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.read_bytes())
        if path.is_file()
        else (path.is_symlink(), path.is_dir())
        for path in sorted(folder.rglob("*"))
    }


def trial(name: str, seed: int, sound: Path, folder: Path) -> tuple[str, BaseException | None]:
    """Damage a copy of sound files and read it; what was done, and the fault if reading was no clean answer.

    Args:
        name: Of the reader.
        seed: Of the damage.
        sound: Sound files, written by the reader's `write`.
        folder: Where to copy them; it is removed afterwards.
    """
    reader, rng = READERS[name], np.random.default_rng(seed)
    shutil.copytree(sound, folder)
    try:
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        done = []
        for _ in range(rng.choice([1, 1, 1, 2])):
            path = files[rng.integers(len(files))]
            if path.is_file() and not path.is_symlink():
                done.append(f"{damage(rng, path)} in {path.relative_to(folder)}")
        if rng.random() < 0.7 and all(path.is_file() for path in files):
            reader.seal(folder)
        text, before = f"{name}, seed {seed}: {', '.join(done)}", contents(folder)
        try:
            reader.read(folder)
        except BenchError as error:
            if "\n" in str(error) or len(str(error)) > 2000:
                return text, error
        except Exception as error:
            return text, error
        if contents(folder) != before:
            return text, AssertionError("reading wrote or removed a file")
        return text, None
    finally:
        shutil.rmtree(folder)
