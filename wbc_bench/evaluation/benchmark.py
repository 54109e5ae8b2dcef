"""What the harness costs beside the physics: `wbc-bench bench harness`."""

import time
from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.evaluation.shard import SHARD_EPISODES, episode_table
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot

Array = NDArray[np.float64]
SHARDS = 4
CONTROLLERS = "hold", "learned:no_latent@0", "learned:transformer_gru@0", "ik"


def harness_share(
    controllers: Sequence[str] = CONTROLLERS, protocol_name: str = "ablation_v1"
) -> pd.DataFrame:
    """Processor time [s] of the engine's steps and of the whole evaluations that they are part of.

    Both are taken in the same run, on one thread: the share is below 1 whatever else the machine does.

    Args:
        controllers: Specs, a row each; those that cannot be made, e.g. for want of an extra, are left out.
        protocol_name: Protocol of the episodes; the controllers take turns in its first shards.
    """
    protocol, path = find_protocol(protocol_name)
    manifest, _ = read_manifest(protocol, manifest_path(path))
    times: dict[str, list[tuple[int, float, float]]] = {}
    for controller in controllers:
        with suppress(BenchError):
            load_controller(controller, load_robot(protocol.robot))
            times[controller] = []
    for controller in times:
        _times(controller, protocol, manifest.take(slice(2)))  # imports and first calls are not counted
    for k in range(SHARDS):
        rows = manifest.take(slice(k * SHARD_EPISODES, (k + 1) * SHARD_EPISODES))
        for controller, found in times.items():
            found.append(_times(controller, protocol, rows))
    return pd.DataFrame([_row(controller, *np.array(found).T) for controller, found in times.items()])


def _row(controller: str, steps: Array, physics: Array, total: Array) -> dict[str, str | int | float]:
    share = physics / total
    return {
        "controller": controller,
        "control steps": int(steps.sum()),
        "physics (s)": physics.sum(),
        "evaluation (s)": total.sum(),
        "physics / evaluation": physics.sum() / total.sum(),
        "lowest shard": share.min(),
        "highest shard": share.max(),
    }


def _times(controller: str, protocol: EvalProtocol, rows: EpisodeManifest) -> tuple[int, float, float]:
    """Control steps, and processor time [s] of the engine's steps and of all that a shard takes."""
    loops: list[ControlLoop] = []
    start = time.process_time()
    batch = rollout(load_controller(controller, load_robot(protocol.robot)), protocol, rows, loops.append)
    episode_table(rows, batch)
    total = time.process_time() - start
    return int(batch.steps.sum()), loops[0].simulation.physics_time, total
