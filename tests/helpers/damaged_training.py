"""Sound files of what is learned, and their readers: policies, training runs, demonstrations."""

import contextlib
from functools import cache
from pathlib import Path

import msgspec
import numcodecs
import numpy as np
import torch

from damage import reseal
from policies import write
from trainers import TINY, trainer
from training_targets import PROTOCOL, TARGETS
from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.export import write_onnx
from wbc_baselines.learned.policy.inputs import HISTORY_FRAME
from wbc_baselines.learned.policy.onnx_engine import OnnxEngine, seal
from wbc_baselines.learned.policy.policy import Policy
from wbc_baselines.learned.training.campaign import is_done, standing
from wbc_baselines.learned.training.curves import smooth
from wbc_baselines.learned.training.run_folder import RunFolder, load_resume, save_resume
from wbc_baselines.learned.training.target_set import TargetSet, read_target_set, write_target_set
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.errors import SourceError
from wbc_bench.robot import load_robot
from wbc_bench.sources.diffusion import policy as door_policy
from wbc_bench.sources.diffusion.demonstrations import read_demonstrations, write_demonstrations
from wbc_bench.sources.diffusion.training import stride_of, windows
from zarr_files import recorded
from zarr_files import write as write_zarr

SMOKE = find_protocol("smoke_v1")[0]


def write_checkpoint(folder: Path) -> None:
    write(folder, "no_latent")


def read_checkpoint(folder: Path) -> None:
    checkpoint.load(folder / "no_latent@0.safetensors", load_robot(), SMOKE)


def seal_checkpoint(folder: Path) -> None:
    reseal(folder / "no_latent@0.json", "sha256", folder / "no_latent@0.safetensors")


def write_exported(folder: Path) -> None:
    path = write(folder, "no_latent")
    card, actor, estimator = checkpoint.load(path)
    write_onnx(folder / "policy.onnx", Policy(actor, estimator), card)
    path.unlink()
    path.with_suffix(".json").unlink()


def read_exported(folder: Path) -> None:
    engine = OnnxEngine(folder / "policy.onnx")
    values = {name: np.zeros((2, *shape), np.float32) for name, shape in engine.flow.inputs.items()}
    engine(values, engine.begin(np.zeros((2, HISTORY_FRAME), np.float32)))


def seal_exported(folder: Path) -> None:
    path = folder / "policy.onnx"
    model = path.read_bytes()[: -len(seal(b""))]
    path.write_bytes(model + seal(model))


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


def write_demonstration_files(folder: Path) -> None:
    arrays, packed = recorded(), numcodecs.Blosc("zstd", shuffle=numcodecs.Blosc.BITSHUFFLE)
    write_zarr(folder / "packed.zarr.zip", arrays, packed=packed, chunks=(25, 1))
    same = read_demonstrations(folder / "packed.zarr.zip").episodes
    write_demonstrations(folder / "plain.zarr.zip", same, {"control_period": 0.02})


def read_demonstration_files(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        found = read_demonstrations(path)
        data = windows(found.episodes, 0.02, np.random.default_rng(0))
        assert all(torch.isfinite(part).all() for part in data)
        with contextlib.suppress(SourceError):
            stride_of(found.attributes.get("control_period"))
