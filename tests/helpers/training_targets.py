"""The training targets and physics of the tests."""

from dataclasses import fields
from typing import Any

import msgspec
import numpy as np

from wbc_baselines.learned.training.backends.base import ResetState
from wbc_baselines.learned.training.target_set import (
    read_target_set,
)
from wbc_bench.episodes.manifest import EpisodeManifest, neutral
from wbc_bench.episodes.protocol import MAX_PUSHES, EvalProtocol, find_protocol

PROTOCOL = find_protocol("ablation_v1")[0]
TARGETS = read_target_set(PROTOCOL)


def coarse(protocol: EvalProtocol = PROTOCOL, **changes) -> EvalProtocol:
    """Physics of 10 ms, and other changes."""
    physics = msgspec.structs.replace(protocol.physics, timestep=0.01, decimation=2)
    return msgspec.structs.replace(protocol, physics=physics, **changes)


def manifest_of(start: ResetState, target: np.ndarray) -> EpisodeManifest:
    """A manifest of the same episodes as a training start's."""
    count = len(start.friction)
    columns: dict[str, Any] = {field.name: np.zeros(count) for field in fields(EpisodeManifest)}
    columns |= neutral(count)
    columns |= {name: column.numpy() for name, column in start._asdict().items()}
    columns |= {
        "target_pos_w": TARGETS.pos_w[target].astype(float),
        "target_quat_w": TARGETS.quat_w[target].astype(float),
        "push_time": np.full((count, MAX_PUSHES), np.nan),
        "push_vel": np.zeros((count, 2 * MAX_PUSHES)),
        "noise_key": np.arange(count),
    }
    return EpisodeManifest(**columns)
