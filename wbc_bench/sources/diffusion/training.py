"""Training a policy on demonstrations: every control step of each is a window that begins there."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wbc_bench import provenance
from wbc_bench.errors import SourceError
from wbc_bench.rotations import matrix_from_rotvec
from wbc_bench.sources.diffusion import poses
from wbc_bench.sources.diffusion.demonstrations import (
    Demonstration,
    door_state,
    read_demonstrations,
)
from wbc_bench.sources.diffusion.denoising import STEPS, noised
from wbc_bench.sources.diffusion.policy import (
    FORMAT,
    HIDDEN,
    HORIZON,
    PERIOD,
    DoorPolicyCard,
    Policy,
)
from wbc_bench.sources.slew import Pose

Array = NDArray[np.float64]
BATCH = 256
UPDATES = 6000
RATE = 1e-3  # of AdamW, down to zero along a cosine
DECAY = 0.999  # of the running mean of the weights that is kept. Source: Chi et al. 2023 keep one, too
COPIES = 3  # of every window, each with the hand displaced
SHIFT, TURN = 0.01, 0.05  # [m], [rad] standard deviations of the displacement
SHORTEST = 1e-3  # [s] between recorded steps
DETUNED = 0.01  # of the period: a camera of 59.94 Hz is one of 60 Hz
LEAST = 1e-2  # half a range that a number must have to be scaled by it: what is constant stays so


class Windows(NamedTuple):
    """What the policy sees and what the expert asked for from there on."""

    looks: Tensor  # (W, LOOKS * LOOK)
    chunks: Tensor  # (W, HORIZON * ACTION)


def windows(episodes: list[Demonstration], period: float, rng: np.random.Generator) -> Windows:
    """Windows of demonstrations recorded every `period` [s], COPIES of each.

    In a copy the hand is a little elsewhere than it was, and everything is seen from there: so the policy
    learns the way back to the demonstration, which its own errors will make it need.
    Source: Ke et al. 2021 (Grasping with chopsticks), noise injection; Laskey et al. 2017 (DART).

    Raises: SourceError, see `stride_of`.
    """
    stride = stride_of(period)
    looks, chunks = [], []
    for episode in episodes:
        ee, target = poses.tool(episode.ee), poses.tool(episode.target)
        count = len(episode.angle)
        now = np.arange(count)
        before = np.maximum(now - stride, 0)
        ahead = np.minimum(now[:, None] + stride * np.arange(HORIZON), count - 1)  # (T, HORIZON)
        for copy in range(COPIES):
            scale = 0.0 if copy == 0 else 1.0
            # before and now are displaced alike: the way between them is that of the demonstration
            shift = Pose(
                scale * SHIFT * rng.standard_normal((count, 3)),
                matrix_from_rotvec(scale * TURN * rng.standard_normal((count, 3))),
            )
            here, last = (poses.absolute(shift, Pose(ee.pos[k], ee.rot[k])) for k in (now, before))
            views = []
            for hand, k in ((last, before), (here, now)):
                door = door_state(
                    Pose(episode.panel.pos[k], episode.panel.rot[k]), episode.angle[k], poses.hand(hand)
                )
                width = episode.widths[k, :1]
                views += [poses.numbers(poses.relative(hand, here)), width, door]
            looks.append(np.concatenate(views, axis=-1))
            base = Pose(here.pos[:, None], here.rot[:, None])
            action = poses.numbers(poses.relative(Pose(target.pos[ahead], target.rot[ahead]), base))
            width = episode.widths[ahead, 1:]
            chunks.append(np.concatenate([action, width], axis=-1).reshape(count, -1))
    return Windows(*(torch.from_numpy(np.concatenate(part)).float() for part in (looks, chunks)))


def stride_of(period: Any) -> int:
    """Steps recorded every `period` [s] from one pose of a chunk to the next.

    Raises: SourceError, the period of the policy is no multiple of it.
    """
    if isinstance(period, int | float) and SHORTEST <= period <= PERIOD * (1 + DETUNED):
        stride = round(PERIOD / period)
        if abs(stride * period - PERIOD) <= DETUNED * PERIOD:
            return stride
    found = "is missing" if period is None else f"is {period}"
    valid = f"{PERIOD:g} s or a whole part of it within {DETUNED:.0%}, from {SHORTEST:g} s on"
    raise SourceError(f"control_period {found}, valid: {valid}")


def fit(
    data: Windows,
    seed: int,
    updates: int = UPDATES,
    hidden: int = HIDDEN,
    report: Callable[[int, float], None] = lambda update, loss: None,
) -> Policy:
    """A policy fitted to windows; equal data and seed give equal weights on equal machines.

    `report` is told of every update and its loss. Source: Ho et al. 2020, algorithm 1, with x0 as the target.
    """
    draw = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = Policy(hidden)
    for name, values in (("look", data.looks), ("action", data.chunks)):
        low, high = values.min(0).values, values.max(0).values
        getattr(policy, f"{name}_middle").copy_((low + high) / 2)
        getattr(policy, f"{name}_half").copy_(((high - low) / 2).clamp(min=LEAST))
    looks, chunks = policy.look(data.looks), policy.action(data.chunks)
    network = policy.denoiser
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    mean = {name: value.detach().clone() for name, value in network.state_dict().items()}
    for update in range(updates):
        chosen = torch.randint(len(looks), (BATCH,), generator=draw)
        step = torch.randint(1, STEPS + 1, (BATCH,), generator=draw)
        clean = chunks[chosen]
        noise = torch.randn(clean.shape, generator=draw)
        loss = (network(noised(clean, noise, step), step, looks[chosen]) - clean).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        keep = min(DECAY, (1 + update) / (10 + update))  # a young mean forgets its beginning
        for name, value in network.state_dict().items():
            mean[name].lerp_(value, 1 - keep)
        report(update, float(loss.detach()))
    network.load_state_dict(mean)
    return policy.eval()


def train(
    path: Path,
    seed: int,
    updates: int = UPDATES,
    report: Callable[[int, float], None] = lambda update, loss: None,
) -> tuple[Policy, DoorPolicyCard]:
    """The policy of a file of demonstrations, and its card.

    Raises: SourceError, the file cannot be used or does not say how often it was recorded.
    """
    found = read_demonstrations(path)
    period: Any = found.attributes.get("control_period")
    try:
        stride_of(period)
    except SourceError as error:
        raise SourceError(f"demonstrations '{path}': attribute {error}") from error
    data = windows(found.episodes, period, np.random.default_rng(seed))
    policy = fit(data, seed, updates, report=report)
    commit = provenance.commit()
    doors: Any = found.attributes.get("seed")
    return policy, DoorPolicyCard(
        format=FORMAT,
        seed=seed,
        demonstrations=len(found.episodes),
        demonstrations_seed=doors if isinstance(doors, int) else None,
        demonstrations_sha256=found.sha256,
        samples=len(data.looks),
        steps=updates,
        batch=BATCH,
        hidden=HIDDEN,
        git_commit=commit.sha,
        git_dirty=commit.dirty,
        torch=str(torch.__version__),
    )
