"""A shard: a fixed number of neighbouring episodes on one thread, with a controller built for it alone.

So its rows depend neither on who computes it nor on what that process computed before.
"""

from typing import Any

import pyarrow as pa

from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.outcomes import EpisodeBatch
from wbc_bench.registry import load_controller
from wbc_bench.results import metrics
from wbc_bench.robot import load_robot

SHARD_EPISODES = 50


def evaluate_shard(spec: str, protocol: EvalProtocol, rows: EpisodeManifest) -> pa.Table:
    """The episode record of some manifest rows: one row an episode, one column a metric."""
    controller = load_controller(spec, load_robot(protocol.robot))
    return episode_table(rows, rollout(controller, protocol, rows))


def episode_table(rows: EpisodeManifest, batch: EpisodeBatch) -> pa.Table:
    """The record of episodes: what was asked, how they ended, and every metric."""
    columns: dict[str, Any] = {
        "replicate": rows.replicate,
        "episode": rows.episode,
        **{
            name: pa.array(getattr(rows, name), pa.string())
            for name in ("stratum", "condition", "orientation")
        },
        "height": rows.height,
        "target_x": rows.target_pos_w[:, 0],
        "target_y": rows.target_pos_w[:, 1],
        "outcome": pa.array([str(outcome) for outcome in batch.outcome], pa.string()),
        "steps": batch.steps,
        **metrics.compute(batch),
    }
    return pa.table(columns)
