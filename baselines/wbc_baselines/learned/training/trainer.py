"""The training loop: rollouts, PPO, the imitation losses beside it, and the estimator on its own losses.

The context enters PPO as an observation group that is computed during the rollout without a gradient, so no
update of the policy can reach the estimator. All randomness of an iteration derives from the seed and the
iteration's number, so between two iterations no generator has a state worth saving.
"""

import time
import zlib
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import msgspec
import torch
from tensordict import TensorDict
from torch import Tensor

from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.estimators import make_estimator
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import Actor
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_baselines.learned.training.distillation import (
    ArmIKLoss,
    Distillation,
    PostureLoss,
    SupervisedUpdate,
)
from wbc_baselines.learned.training.environment import PRIVILEGED_COLUMNS, Environment, Step
from wbc_baselines.learned.training.estimator_rollout import EstimatorRollout
from wbc_baselines.learned.training.history import History
from wbc_baselines.learned.training.ppo import ScheduledPPO
from wbc_baselines.learned.training.precision import fast_products
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.robot import load_robot

TIMES = ("time/rollout", "time/policy", "time/estimator")  # [s] parts of an iteration, in its metrics
COUNT = "normalizer.count"  # how the buffers end that only training needs


class Trainer:
    """One run: networks, optimizers and environment, advanced by one iteration at a time."""

    def __init__(self, config: TrainConfig, environment: Environment) -> None:
        """Build the networks of a run that has not begun.

        Args:
            config: Configuration of the run.
            environment: Environment with `config.num_envs` episodes.

        Raises:
            UnknownNameError: There is no such method or checkpoint.
            TrainingError: A setting is out of its range.
            CheckpointError: A checkpoint is damaged, or of a method that cannot serve here.
        """
        config.check()
        self.config, self.environment = config, environment
        self.method = METHODS[config.method]
        self.iteration, self.samples = 0, 0  # samples: control steps so far
        self.device = environment.device
        variant = environment.protocol.robot.variant
        origins = config.init_checkpoint, config.teacher
        self._origins = tuple(checkpoint.identity(name, variant) for name in origins)
        if config.backend == "cpu":
            torch.set_num_threads(config.threads)
        torch.manual_seed(_key(config.seed, "weights"))
        self.estimator = make_estimator(self.method.estimator).to(self.device)
        init = None
        if config.init_checkpoint:
            init = checkpoint.load_init_checkpoint(config.init_checkpoint, self.method.estimator, variant)
            if type(init.estimator) is type(self.estimator):
                self.estimator.load_state_dict(init.estimator.state_dict())
                for name, count in self.estimator.named_buffers():
                    if name.endswith(COUNT):
                        count.fill_(config.init_normalizer_count)
        self._privileged = self.method.estimator == "oracle"
        self._estimates = self.method.estimates
        self._begin_episodes()
        robot = load_robot(environment.protocol.robot)
        self.ppo = ScheduledPPO(config, self._observations(), self.estimator, robot, init)
        scale = torch.tensor(robot.action_scale, dtype=torch.float32, device=self.device)
        self.distillation = None
        if config.teacher:
            teacher = checkpoint.load_teacher(config.teacher, variant)
            self.distillation = Distillation(teacher, self.ppo.actor, scale)
        self.auxiliary_losses: dict[str, ArmIKLoss | PostureLoss] = {}  # by the setting of their interval
        if config.arm_ik_loss[1]:
            self.auxiliary_losses["arm_ik_loss"] = ArmIKLoss(robot, self.ppo.actor, scale)
        if config.posture_loss[1]:
            self.auxiliary_losses["posture_loss"] = PostureLoss(self.ppo.actor, scale)
        parameters = list(self.estimator.parameters())
        self.optimizer = torch.optim.Adam(parameters, config.estimator_learning_rate) if parameters else None

    def _begin_episodes(self) -> None:
        """Reset history and recurrent state, for episodes that begin now."""
        count = self.environment.num_envs
        self._history = History(self.environment.observations.frame)
        self._state = torch.zeros(count, self.estimator.state_dim, device=self.device)
        self._start = torch.ones(count, dtype=torch.bool, device=self.device)
        self._context = self._estimate() if self._estimates else None

    # ---- one iteration -------------------------------------------------------------------------------------

    @property
    def _distillation_progress(self) -> float:
        return self.config.distillation_progress(self.samples)

    @property
    def done(self) -> bool:
        """Whether the budget is used up."""
        return self.samples >= self.config.budget

    def iterate(self) -> dict[str, float]:
        """Collect a rollout and update policy, critic and estimator.

        Returns:
            Metrics by name: losses, times [s], schedules, and the environment's log.

        Raises:
            TrainingError: A loss is not finite.
        """
        config, environment, ppo = self.config, self.environment, self.ppo
        torch.manual_seed(_key(config.seed, "iteration", self.iteration))
        legs, arm = config.std(self.samples)
        ppo.set_std(legs, arm)
        ppo.follow_schedules(self.samples)
        environment.curriculum = config.curriculum_progress(self.samples)
        environment.disturbance_scale = config.disturbance_scale(self.samples)
        environment.clear_log()
        environment.begin_rollout(self.iteration, config.num_steps_per_env)
        clock = [time.perf_counter()]
        rollout, pushed = self.collect_rollout()
        clock.append(time.perf_counter())
        losses = self._update_policy(pushed)
        clock.append(time.perf_counter())
        losses |= self.update_estimator(rollout) if rollout else {}
        clock.append(time.perf_counter())
        self.iteration += 1
        self.samples += config.num_envs * config.num_steps_per_env
        found = {f"loss/{name}": float(value) for name, value in losses.items()}
        wrong = [name for name, value in found.items() if value != value or abs(value) == float("inf")]
        if wrong:
            raise TrainingError(
                f"run {config.name}: {', '.join(wrong)} is not finite in iteration {self.iteration}; "
                "the last checkpoint is sound: resume with a smaller --learning-rate or another --seed"
            )
        seconds = [b - a for a, b in pairwise(clock)]
        found |= dict(zip(TIMES, seconds, strict=True))
        found |= {
            "policy/std_legs": legs,
            "policy/std_arm": arm,
            "policy/learning_rate": ppo.learning_rate,
            "episode/disturbance_scale": environment.disturbance_scale,
        }
        return found | environment.log()

    @torch.no_grad()
    def collect_rollout(self) -> tuple[EstimatorRollout | None, Tensor]:
        """Act in the environment for one rollout and store the transitions in PPO.

        Returns:
            The samples for the estimator, or None for a method without one; and whether a push came before
            each step (T, N).
        """
        config, environment, ppo = self.config, self.environment, self.ppo
        ppo.train_mode()
        rollout, pushed = None, []
        if self.optimizer:
            ids = torch.randperm(config.num_envs, device=self.device)[: config.estimator_envs]
            rollout = EstimatorRollout(config.num_steps_per_env, ids, self._state_before)
        observations = self._observations()
        progress = self._distillation_progress
        teacher = self.distillation if progress < 0.5 else None
        # the teacher acts in the last environments, in fewer and fewer of them
        teacher_acts = torch.arange(config.num_envs, device=self.device) >= 2 * progress * config.num_envs
        for t in range(config.num_steps_per_env):
            if rollout:
                rollout.before(t, self._history.window, self._start, environment.observations.velocity)
            with fast_products(self.device):
                action = ppo.act(observations)
            if teacher:  # with the policy's exploration
                noise = action - ppo.transition.distribution_params[0]  # type: ignore[index]
                action = torch.where(teacher_acts[:, None], teacher.actions(observations) + noise, action)
            step = environment.step(action)
            pushed.append(step.pushed)
            if rollout:
                rollout.after(t, step)
            if self._estimates:
                self._advance_context(step)
            observations = self._observations()
            ppo.process_env_step(observations, step.reward, step.done, {"time_outs": step.time_out})
        return rollout, torch.stack(pushed)

    def _update_policy(self, pushed: Tensor) -> dict[str, float]:
        """Update critic and policy: by PPO, by distillation, and by the auxiliary losses of this time."""
        config, ppo, progress = self.config, self.ppo, self._distillation_progress
        ppo.compute_advantages(self._observations(), pushed)
        ppo.critic_only = self.iteration < config.critic_warmup_iterations or progress < 1
        ppo.num_learning_epochs = config.num_learning_epochs if progress == 1 else 1
        states = ppo.storage.observations
        with fast_products(self.device):
            losses = ppo.update()
        if self.distillation and progress < 1:
            losses |= self.distillation.update(states, progress)
        elif self.distillation and (weight := config.kickstart_weight(self.samples)):
            losses |= self.distillation.kickstart(states, weight)
        for name, loss in self.auxiliary_losses.items():
            begin, end = getattr(config, name)
            if begin <= self.samples < end:
                losses |= loss.update(states, config.pace(self.samples))
        return losses

    def update_estimator(self, rollout: EstimatorRollout) -> dict[str, float]:
        """Update the estimator on its part of a rollout.

        Args:
            rollout: Samples of whole sequences.

        Returns:
            Mean losses by name.
        """
        assert self.optimizer is not None
        config, sums = self.config, {}
        for batch in rollout.batches(config.estimator_updates):
            noise = torch.randn(*batch.start.shape, self.estimator.latent_dim, device=self.device)
            with fast_products(self.device):
                losses = self.estimator.losses(batch, noise)
                self.optimizer.zero_grad()
                losses["total"].backward()
            torch.nn.utils.clip_grad_norm_(self.estimator.parameters(), config.max_grad_norm)
            self.optimizer.step()
            for name, value in losses.items():
                sums[f"estimator_{name}"] = sums.get(f"estimator_{name}", 0.0) + value.detach()
        self.estimator.observe(rollout.history)
        return {name: float(value) / config.estimator_updates for name, value in sums.items()}

    # ---- observations and context --------------------------------------------------------------------------

    def _advance_context(self, step: Step) -> None:
        self._history.push(step.observations.frame, fresh=step.done)
        self._state = torch.where(step.done[:, None], 0.0, self._state)
        self._start = step.done
        self._context = self._estimate()

    @torch.no_grad()
    def _estimate(self) -> Tensor:
        """Sample the context of the current windows. Source: paper, eq. estimated_context."""
        self._state_before = self._state
        noise = torch.randn(len(self._state), self.estimator.latent_dim, device=self.device)
        with fast_products(self.device):
            context, self._state = self.estimator.step(self._history.window, self._state, noise)
        return context

    def _observations(self) -> TensorDict:
        seen = self.environment.observations
        groups = {"policy": seen.policy, "critic": seen.critic}
        if self._privileged:
            groups["context"] = seen.critic[:, PRIVILEGED_COLUMNS]
        elif self._context is not None:
            groups["context"] = self._context
        if self.config.posture_loss[1]:
            groups["leg_posture_error"] = self.environment.leg_posture_error()
        return TensorDict(groups, batch_size=[self.environment.num_envs], device=self.device)

    # ---- networks for an evaluation, and everything for a resume -------------------------------------------

    def actor(self) -> Actor:
        """Return a copy of the policy's mean in the form that an evaluation uses."""
        trained, actor = self.ppo.actor, Actor(self.estimator.context_dim)
        weights = {f"mlp.{name}": value for name, value in trained.mlp.state_dict().items()}
        normalizer = trained.obs_normalizer
        actor.load_state_dict(
            weights | {"normalizer.mean": normalizer.mean, "normalizer.std": normalizer.std}
        )
        return actor.eval()

    def write_checkpoint(self, path: Path, seconds: float) -> None:
        """Write weights and card for an evaluation.

        Args:
            path: PATH.safetensors; the card is written beside it.
            seconds: Training time so far [s], for the card.
        """
        config = self.config
        protocol, _ = find_protocol(config.protocol)
        card = new_card(config.method, config.seed, self.samples, seconds, protocol)
        init, teacher = self._origins
        card = msgspec.structs.replace(card, init_checkpoint=init, teacher=teacher)
        checkpoint.save(path, self.actor(), self.estimator, card)

    def _supervised_updates(self) -> dict[str, SupervisedUpdate]:
        found = {"distillation": self.distillation.supervised} if self.distillation else {}
        return found | {name: loss.supervised for name, loss in self.auxiliary_losses.items()}

    def save(self) -> dict:
        """Return everything that the next iterations depend on, as tensors and numbers."""
        counts = {name: value for name, value in self.estimator.named_buffers() if name.endswith(COUNT)}
        optimizers = {name: part.optimizer for name, part in self._supervised_updates().items()}
        return {
            "config": asdict(self.config),
            "iteration": self.iteration,
            "samples": self.samples,
            "ppo": self.ppo.save(),
            "learning_rate": self.ppo.learning_rate,
            "estimator": self.estimator.state_dict() | counts,
            "optimizer": self.optimizer.state_dict() if self.optimizer else {},
            "supervised": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
            "episodes": {
                "environment": self.environment.save(),
                "history": self._history.window,
                "state": self._state,
                "state_before": self._state_before if self._estimates else self._state,
                "start": self._start,
                "context": self._context if self._context is not None else torch.zeros(0),
            },
        }

    def load(self, saved: dict) -> None:
        """Continue from a saved state: bit by bit, or with new episodes if settings have changed.

        Args:
            saved: What `save` returned.
        """
        before = saved["config"]  # first, so that the file of another version is refused unread
        self.iteration, self.samples = saved["iteration"], saved["samples"]
        self.ppo.load(saved["ppo"], None, strict=True)
        self.ppo.learning_rate = saved["learning_rate"]
        buffers = dict(self.estimator.named_buffers())
        for name, value in saved["estimator"].items():
            if name.endswith(COUNT):
                buffers[name].copy_(value)
        self.estimator.load_state_dict({k: v for k, v in saved["estimator"].items() if not k.endswith(COUNT)})
        if self.optimizer:
            self.optimizer.load_state_dict(saved["optimizer"])
        for name, part in self._supervised_updates().items():
            if name in saved["supervised"]:  # otherwise this loss is new in the run
                part.optimizer.load_state_dict(saved["supervised"][name])
        if self.config.changes(before):
            torch.manual_seed(_key(self.config.seed, "episodes", self.iteration))
            self.environment.begin(self.iteration)  # samples that no earlier iteration has reached
            self._begin_episodes()
            return
        episodes = saved["episodes"]
        self.environment.load(episodes["environment"])
        self._history.window = episodes["history"].to(self.device)
        self._state, self._start = episodes["state"].to(self.device), episodes["start"].to(self.device)
        self._state_before = episodes["state_before"].to(self.device)
        if self._estimates:
            self._context = episodes["context"].to(self.device)


def duration(metrics: dict[str, float]) -> float:
    """Return the time [s] that the iteration of these metrics took."""
    return sum(metrics[name] for name in TIMES)


def _key(seed: int, purpose: str, index: int = 0) -> int:
    """A seed for torch's generator: of one purpose and iteration, and of no other."""
    return ((seed & 0xFFFF) << 48) | ((zlib.crc32(purpose.encode()) & 0xFFFF) << 32) | (index & 0xFFFFFFFF)
