"""What the harness costs beside the physics: `wbc-bench bench harness`."""

import time

import mujoco
import numpy as np
import pandas as pd
from mujoco.batch import Batch

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.evaluation.shard import SHARD_EPISODES, evaluate_shard
from wbc_bench.robot import load_robot

SHARDS = 6


def harness_share(controller: str = "hold", protocol_name: str = "ablation_v1") -> pd.DataFrame:
    """Time [s] of bare physics and of whole evaluations of the same steps, in turn, on one thread; one row.

    Bare physics is `Batch.step` alone, as many control steps an episode as the evaluation took.
    """
    protocol, path = find_protocol(protocol_name)
    manifest, _ = read_manifest(protocol, manifest_path(path))
    evaluate_shard(controller, protocol, manifest.take(slice(2)))  # imports and first calls are not counted
    total, bare, steps = [], [], 0
    for shard in range(SHARDS):
        rows = manifest.take(slice(shard * SHARD_EPISODES, (shard + 1) * SHARD_EPISODES))
        start = time.perf_counter()
        record = evaluate_shard(controller, protocol, rows)
        total.append(time.perf_counter() - start)
        taken = record["steps"].to_numpy()
        steps += int(taken.sum())
        bare.append(_bare(protocol, rows, taken))
    share = np.array(bare) / np.array(total)
    return pd.DataFrame(
        {
            "controller": [controller],
            "control steps": [steps],
            "bare Batch.step (s)": [sum(bare)],
            "evaluation (s)": [sum(total)],
            "bare / evaluation": [sum(bare) / sum(total)],
            "lowest shard": [share.min()],
            "highest shard": [share.max()],
        }
    )


def _bare(protocol: EvalProtocol, rows: EpisodeManifest, taken: np.ndarray) -> float:
    """Seconds of stepping the same number of control steps, each episode until its own end."""
    robot = load_robot(protocol.robot)
    batch = Batch(robot.model(protocol.physics.timestep), len(rows), nthread=1, persistent=True)
    batch.reset()
    batch.bind("qpos")[:, 7:] = robot.default_q
    batch.bind("ctrl")[:] = robot.default_q
    for field in ("site_xpos", "site_xmat", "actuator_force", "sensordata"):
        batch.bind(field)
    batch.forward()
    seconds = 0.0
    for step in range(int(taken.max())):
        ids = np.flatnonzero(taken > step)
        start = time.perf_counter()
        batch.step(ids, nstep=protocol.physics.decimation, stage=mujoco.mjtStage.mjSTAGE_VEL)
        seconds += time.perf_counter() - start
    return seconds
