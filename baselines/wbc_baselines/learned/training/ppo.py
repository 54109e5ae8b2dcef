"""PPO of rsl-rl-lib, with the schedules and the advantages of this training.

rsl-rl's implementation is used unchanged except for three things: advantages end before a push, policy and
critic have learning rates of their own, and the policy can be left out of an update.
"""

import math

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from wbc_baselines.learned.policy.checkpoint import Checkpoint, shared_context
from wbc_baselines.learned.policy.estimators import Estimator
from wbc_baselines.learned.policy.inputs import ACTIONS
from wbc_baselines.learned.policy.networks import HIDDEN
from wbc_baselines.learned.training.config import TrainConfig, value_at
from wbc_baselines.learned.training.returns import generalized_advantages
from wbc_baselines.learned.training.symmetry import (
    critic_mirror,
    input_mirror,
    joint_mirror,
    privileged_mirror,
)
from wbc_baselines.learned.training.warm_start import warm_start
from wbc_bench.robot import NUM_LEG_JOINTS, Robot


class ScheduledPPO(PPO):
    """rsl-rl's PPO with separate learning rates, a scheduled exploration noise and advantages before pushes.

    `critic_only` makes updates leave the policy unchanged.
    """

    def __init__(
        self,
        config: TrainConfig,
        observations: TensorDict,
        estimator: Estimator,
        robot: Robot,
        init: Checkpoint | None,
    ) -> None:
        """Build policy, critic, storage and optimizer.

        Args:
            config: Configuration of the run.
            observations: Observation groups of N environments, as examples of their sizes.
            estimator: Estimator whose context is the observation group `context`.
            robot: Robot, for the mirror images of the samples.
            init: Checkpoint that initializes the policy, or None for random weights.
        """
        device = observations.device
        # the critic's own group already contains what the oracle's context holds
        groups = {"actor": ["policy"], "critic": ["critic"]}
        if estimator.context_dim:
            groups["actor"].append("context")
        if estimator.trainable:
            groups["critic"].append("context")
        gaussian = {"class_name": "GaussianDistribution", "std_type": "log"}
        common = {"hidden_dims": HIDDEN, "activation": "elu", "obs_normalization": True}
        actor = MLPModel(observations, groups, "actor", ACTIONS, distribution_cfg=gaussian, **common)
        critic = MLPModel(observations, groups, "critic", 1, **common)
        self.log_std: Tensor = actor.distribution.log_std_param  # type: ignore[union-attr, assignment]
        self.log_std.requires_grad_(False)  # follows a schedule, see `set_std`
        if init:
            with torch.no_grad():
                shared = shared_context(init.estimator, estimator)
                warm_start(actor, init.actor, shared, config.init_normalizer_count)
        size = config.num_envs, config.num_steps_per_env
        super().__init__(
            actor,
            critic,
            RolloutStorage("rl", *size, observations, [ACTIONS], str(device)),
            num_learning_epochs=config.num_learning_epochs,
            num_mini_batches=config.num_mini_batches,
            clip_param=config.clip_param,
            gamma=config.gamma,
            lam=config.lam,
            entropy_coef=0.0,  # it would affect the scheduled standard deviation alone
            learning_rate=config.learning_rate,
            max_grad_norm=config.max_grad_norm,
            use_clipped_value_loss=False,
            schedule="adaptive",
            desired_kl=value_at(config.desired_kl, 0),
            device=str(device),
            symmetry_cfg=symmetry_config(robot, device) if config.symmetry_augmentation else None,
        )
        self._config = config
        self.critic_only = False
        self.min_learning_rate = value_at(config.min_learning_rate, 0)
        groups = [{"params": list(model.parameters())} for model in (actor, critic)]
        self.optimizer = torch.optim.Adam(groups, config.learning_rate)
        # rsl-rl has one rate for both networks, without a lower bound, and no update of the critic alone
        self.optimizer.register_step_pre_hook(self._set_learning_rates)

    def _set_learning_rates(self, optimizer: torch.optim.Optimizer, *_: object) -> None:
        config = self._config
        self.learning_rate = max(self.learning_rate, self.min_learning_rate)
        if self.critic_only:
            self.learning_rate = config.learning_rate  # a fixed policy has no divergence to adapt to
            for parameter in self.actor.parameters():
                parameter.grad = None
        rates = self.learning_rate, config.critic_learning_rate
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate

    def follow_schedules(self, samples: int) -> None:
        """Set what depends on the control steps so far: the bounds of the adapted learning rate."""
        self.desired_kl = value_at(self._config.desired_kl, samples)
        self.min_learning_rate = value_at(self._config.min_learning_rate, samples)

    def set_std(self, legs: float, arm: float) -> None:
        """Set the standard deviations of the leg and the arm actions, in units of the action scale."""
        self.log_std[:NUM_LEG_JOINTS], self.log_std[NUM_LEG_JOINTS:] = math.log(legs), math.log(arm)

    @torch.no_grad()
    def compute_advantages(self, observations: TensorDict, pushed: Tensor) -> None:
        """Compute the critic's return targets, and the policy's advantages, normalized over the rollout.

        Args:
            observations: Observation groups (N) after the last step of the rollout.
            pushed: (T, N) Whether a push came before the physics of a step.
        """
        self.compute_returns(observations)
        storage = self.storage
        values = torch.cat([storage.values, self.critic(observations)[None]])[..., 0]
        found = generalized_advantages(
            storage.rewards[..., 0],
            values,
            storage.dones[..., 0].bool(),
            pushed,
            self._config.gamma,
            self._config.actor_lam,
        )
        storage.advantages = ((found - found.mean()) / (found.std() + 1e-8))[..., None]


def symmetry_config(robot: Robot, device: torch.device | None) -> dict:
    """Build rsl-rl's symmetry extension, which appends the mirror images to the samples of a mini-batch."""
    mirrors = {
        "policy": input_mirror(robot),
        "critic": critic_mirror(robot),
        "context": privileged_mirror(robot),
        "action": joint_mirror(robot),
    }
    images = {
        name: (torch.from_numpy(m.place).to(device), torch.from_numpy(m.sign).to(device))
        for name, m in mirrors.items()
    }

    def both(name: str, x: Tensor) -> Tensor:
        place, sign = images[name]
        return torch.cat([x, x[..., place] * sign])

    def augment(env: object, obs: TensorDict | None, actions: Tensor | None) -> tuple:
        if obs is not None:
            groups = {name: both(name, obs[name]) for name in map(str, obs.keys()) if name in images}
            obs = TensorDict(groups, batch_size=[2 * len(obs)], device=device)
        return obs, None if actions is None else both("action", actions)

    return {"env": None, "data_augmentation_func": augment, "use_data_augmentation": True}
