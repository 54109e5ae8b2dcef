"""A tiny run of training, and how two states of it are compared."""

from dataclasses import replace

import torch

from wbc_baselines.learned.training.config import TrainConfig
from wbc_baselines.learned.training.make import make_environment
from wbc_baselines.learned.training.trainer import Trainer

TINY = TrainConfig(
    "no_latent",
    budget=4 * 8 * 6,
    num_envs=8,
    num_steps_per_env=6,
    num_mini_batches=2,
    threads=1,
    estimator_share=0.5,
    estimator_mini_batches=2,
    learning_rate=3e-4,
    min_learning_rate=((0.0, 1e-4),),
    init_checkpoint="",
    teacher="",
    critic_warmup_iterations=0,
    disturbance_ramp=(0.0, 0.0),
    posture_loss=(0.0, 0.0),
)
STEPS = TINY.num_envs * TINY.num_steps_per_env  # of an iteration


def trainer(**changes) -> Trainer:
    config = replace(TINY, **changes)
    return Trainer(config, make_environment(config))


def assert_equal(a, b, where: str = "") -> None:
    """Nested states are equal bit by bit."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_equal(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{where}[{k}]")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b, where
