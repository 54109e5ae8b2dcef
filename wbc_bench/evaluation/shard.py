"""A shard: a fixed number of neighbouring episodes on one thread, with a controller built for it alone.

So its rows depend neither on who computes it nor on what that process computed before.
"""

from typing import Any

import pyarrow as pa

from wbc_bench import provenance
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import ControllerError
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.outcomes import EpisodeBatch
from wbc_bench.registry import build_controller
from wbc_bench.results import metrics
from wbc_bench.robot import load_robot

SHARD_EPISODES = 50


def evaluate_shard(
    source: str | bytes, protocol: EvalProtocol, rows: EpisodeManifest, software: str = ""
) -> pa.Table:
    """The episode record of some manifest rows: one row per episode, one column per metric.

    Args:
        source: a spec, or what `pack_controller` made of a controller.
        software: the digest that the code must have here; any when not given.

    Raises:
        ControllerError: it cannot be built, breaks the interface, or is not the code that was asked for.
    """
    controller = build_controller(source, load_robot(protocol.robot))
    if software and provenance.software(controller).digest != software:
        raise ControllerError(
            f"the code or the files of controller '{controller.info.name}' changed during its evaluation, or "
            "differ on this worker: run again"
        )
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
