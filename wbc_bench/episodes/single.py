"""One episode that no manifest holds: free of a target, for a source or a person to lead."""

import dataclasses

import msgspec
import numpy as np

from wbc_bench.episodes.protocol import LONGEST, EvalProtocol, find_protocol
from wbc_bench.episodes.randomization import nominal, sample
from wbc_bench.episodes.rows import EpisodeManifest
from wbc_bench.errors import SourceError, UnknownNameError

CONDITIONS = ("nominal", "randomised")
BASE_PROTOCOL = "ablation_v1"  # whose physics, randomisation, noise, pushes and limits hold
UNSCRIPTED = 20.0  # [s] for a source that has no end


def door_protocol(seed: int) -> EvalProtocol:
    """The protocol whose robot a source's doors are drawn for, with the seed of an episode."""
    return _protocol(UNSCRIPTED, seed)


def episode_of(
    duration: float, seed: int, condition: str, episode: int = 0
) -> tuple[EvalProtocol, EpisodeManifest]:
    """An episode of `duration` [s] without a target, and the protocol it is of.

    Raises: SourceError when it would last less than a control step, or for ever.
    """
    protocol = _protocol(duration, seed)
    return protocol, _row(protocol, condition, episode)


def free_episode(
    base: str, condition: str, seed: int, duration: float
) -> tuple[EvalProtocol, EpisodeManifest]:
    """An episode of `duration` [s] as protocol `base` has them, but without pushes and target.

    Raises: UnknownNameError, ProtocolError.
    """
    if condition not in CONDITIONS:
        raise UnknownNameError("condition", condition, CONDITIONS, "--condition")
    protocol = _protocol(duration, seed, base)
    row = _row(protocol, condition)
    calm = np.full_like(row.push_time, np.nan), np.zeros_like(row.push_vel)
    return protocol, dataclasses.replace(row, push_time=calm[0], push_vel=calm[1])


def _protocol(duration: float, seed: int, base: str = BASE_PROTOCOL) -> EvalProtocol:
    protocol, _ = find_protocol(base)
    if not protocol.control_period <= duration <= LONGEST:
        raise SourceError(f"duration {duration:g} s, valid: {protocol.control_period:g} to {LONGEST:g} s")
    episodes = msgspec.structs.replace(
        protocol.episodes, replicates=1, per_replicate=1, horizon=duration, seed=seed
    )
    return msgspec.structs.replace(protocol, name="track", episodes=episodes)


def _row(protocol: EvalProtocol, condition: str, episode: int = 0) -> EpisodeManifest:
    draws = (sample if condition == "randomised" else nominal)(protocol, 0, episode)
    columns = {name: np.array([value]) for name, value in draws._asdict().items()}
    labels = {name: np.array([""], dtype=object) for name in ("stratum", "orientation")}
    return EpisodeManifest(
        replicate=np.zeros(1, dtype=np.int64),
        episode=np.full(1, episode, dtype=np.int64),
        condition=np.array([condition], dtype=object),
        height=np.full(1, np.nan),
        target_pos_w=np.full((1, 3), np.nan),
        target_quat_w=np.array([[1.0, 0.0, 0.0, 0.0]]),
        feasible_qpos=np.full((1, 21), np.nan),
        **labels,
        **columns,
    )
