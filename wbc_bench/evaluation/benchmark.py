"""What the harness costs beside the physics: `wbc-bench bench harness`."""

import time

import numpy as np
import pandas as pd

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.evaluation.shard import SHARD_EPISODES, episode_table
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot

SHARDS = 6


def harness_share(controller: str = "hold", protocol_name: str = "ablation_v1") -> pd.DataFrame:
    """Processor time [s] of the engine's steps and of the whole evaluations that they are part of; one row.

    Both are taken in the same run, on one thread: the share is below 1 whatever else the machine does.
    """
    protocol, path = find_protocol(protocol_name)
    manifest, _ = read_manifest(protocol, manifest_path(path))
    _times(controller, protocol, manifest.take(slice(2)))  # imports and first calls are not counted
    shards = [slice(k * SHARD_EPISODES, (k + 1) * SHARD_EPISODES) for k in range(SHARDS)]
    steps, physics, total = np.array([_times(controller, protocol, manifest.take(rows)) for rows in shards]).T
    share = physics / total
    return pd.DataFrame(
        {
            "controller": [controller],
            "control steps": [int(steps.sum())],
            "physics (s)": [physics.sum()],
            "evaluation (s)": [total.sum()],
            "physics / evaluation": [physics.sum() / total.sum()],
            "lowest shard": [share.min()],
            "highest shard": [share.max()],
        }
    )


def _times(controller: str, protocol: EvalProtocol, rows: EpisodeManifest) -> tuple[int, float, float]:
    """Control steps, and processor time [s] of the engine's steps and of all that a shard takes."""
    loops: list[ControlLoop] = []
    start = time.process_time()
    batch = rollout(load_controller(controller, load_robot(protocol.robot)), protocol, rows, loops.append)
    episode_table(rows, batch)
    total = time.process_time() - start
    return int(batch.steps.sum()), loops[0].simulation.physics_time, total
