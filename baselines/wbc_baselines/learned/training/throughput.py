"""The speed of training and evaluation relative to the physics alone, measured together in one process."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from statistics import median
from typing import NamedTuple

import mujoco.batch

from wbc_baselines.learned.policy import weights
from wbc_baselines.learned.training.config import TrainConfig
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.evaluation import simulation
from wbc_bench.evaluation.shard import evaluate_shard

ROUNDS = 5  # the first is a warm-up; methods alternate, so that all run under the same load
EPISODES = 50  # per evaluation, as many as in a shard


class Speed(NamedTuple):
    """The speed of one method on this machine, as medians over the rounds."""

    method: str
    steps: float  # control steps/s of training
    physics: float  # control steps/s of the engine alone, in the same states
    training: float  # fraction of the training time spent in the engine, steps / physics
    evaluation: float | None  # the same for an evaluation on one thread; None without a checkpoint


class EngineClock(mujoco.batch.Batch):
    """MuJoCo's batch of simulations, with a counter of the time [s] spent in its steps."""

    seconds = 0.0

    def step(self, *arguments, **options):
        begun = time.perf_counter()
        found = super().step(*arguments, **options)
        EngineClock.seconds += time.perf_counter() - begun
        return found


def measure(
    config: TrainConfig, methods: Sequence[str], rounds: int = ROUNDS, episodes: int = EPISODES
) -> list[Speed]:
    """Train and evaluate methods in turns, each from its committed checkpoint or else from the oracle's.

    Training is PPO without a teacher; the arm-IK and posture losses are active if their intervals begin at 0.

    Args:
        config: Settings that all methods share.
        methods: Methods to measure.
        rounds: Number of rounds, of which the first is discarded.
        episodes: Number of episodes per evaluation.

    Returns:
        The speed of each method.
    """
    import torch

    from wbc_baselines.learned.training.make import make_environment
    from wbc_baselines.learned.training.trainer import Trainer, duration

    protocol, path = find_protocol(config.protocol)
    available = weights.available(protocol.robot.variant)
    ours = {m: name for m in methods if (name := f"{m}@{config.seed}") in available}
    rows = read_manifest(protocol, manifest_path(path))[0].of_replicate(0, episodes)
    control_steps = config.num_envs * config.num_steps_per_env
    training: dict[str, list[tuple[float, float]]] = {method: [] for method in methods}
    evaluation: dict[str, list[float]] = {method: [] for method in methods}
    with _engine_clocks():
        trainers = []
        for method in methods:
            chosen = replace(config, method=method, init_checkpoint=ours.get(method, "oracle@0"), teacher="")
            trainers.append(Trainer(chosen, make_environment(chosen)))
        for _ in range(rounds):
            for trainer in trainers:
                before = EngineClock.seconds
                whole = duration(trainer.iterate())
                training[trainer.config.method].append((whole, EngineClock.seconds - before))
        torch.set_num_threads(1)
        for _ in range(rounds):
            for method, name in ours.items():
                evaluation[method].append(_evaluation(f"learned:{name}", protocol, rows))
        torch.set_num_threads(config.threads)
    return [
        Speed(
            method,
            control_steps / median(whole for whole, _ in times[1:]),
            control_steps / median(engine for _, engine in times[1:]),
            median(engine / whole for whole, engine in times[1:]),
            median(evaluation[method][1:]) if method in ours else None,
        )
        for method, times in training.items()
    ]


def _evaluation(spec: str, protocol: EvalProtocol, rows: EpisodeManifest) -> float:
    """The fraction of the time of these episodes, as one shard, that is spent in the engine."""
    begun, before = time.perf_counter(), EngineClock.seconds
    evaluate_shard(spec, protocol, rows)
    return (EngineClock.seconds - before) / (time.perf_counter() - begun)


@contextmanager
def _engine_clocks() -> Iterator[None]:
    """Let simulations of training and evaluation that are created from here on count their engine's time."""
    from wbc_baselines.learned.training.backends import cpu

    places = (cpu, simulation)
    for place in places:
        place.Batch = EngineClock
    try:
        yield
    finally:
        for place in places:
            place.Batch = mujoco.batch.Batch
