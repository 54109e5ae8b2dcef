"""Advantage estimates of the policy."""

import torch
from torch import Tensor


def generalized_advantages(
    rewards: Tensor, values: Tensor, done: Tensor, pushed: Tensor, gamma: float, lam: float
) -> Tensor:
    """Compute generalized advantage estimates that end before a push.

    A push is independent of the robot's actions, and the value before it already expects pushes. The sum of
    an action therefore ends before the next push; its further summands would only add variance.

    Args:
        rewards: (T, N) Rewards.
        values: (T + 1, N) Values of the critic.
        done: (T, N) Whether the episode ended with the step.
        pushed: (T, N) Whether a push came between the observation and the physics of the step.
        gamma: Discount factor per step.
        lam: Lambda of the estimator.

    Returns:
        Advantages (T, N), not normalized.

    Source: Schulman et al. 2016, eq. 16; Mao et al. 2019, "Variance reduction for reinforcement learning in
    input-driven environments", for baselines under an external input.
    """
    found, advantage = torch.empty_like(rewards), torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + gamma * values[t + 1] * ~done[t] - values[t]
        advantage = (delta + gamma * lam * advantage * ~done[t]) * ~pushed[t]
        found[t] = advantage
    return found
