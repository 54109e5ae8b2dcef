"""PPO on the environment, the estimator beside it on its own losses.

rsl-rl-lib's PPO is used as it is, but for the advantages, which are written over its own: they end before a
push. The context enters as an observation group, written at rollout time without a gradient, so no update of
the policy can reach the estimator. All randomness of an iteration comes from the seed and the iteration's
number, so between two iterations no generator has a state worth keeping.
"""

import math
import time
import zlib
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import msgspec
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.estimators import make_estimator
from wbc_baselines.learned.policy.inputs import ACTIONS, History
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import HIDDEN, Actor
from wbc_baselines.learned.training.config import Settings, TrainingError
from wbc_baselines.learned.training.distillation import ArmTeaching, Fit, PostureTeaching, Teaching
from wbc_baselines.learned.training.environment import PRIVILEGED_COLUMNS, Environment, Step
from wbc_baselines.learned.training.estimator_rollout import Rollout
from wbc_baselines.learned.training.symmetry import (
    critic_mirror,
    input_mirror,
    joint_mirror,
    privileged_mirror,
)
from wbc_baselines.learned.training.warm_start import begin_with
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.robot import NUM_LEG_JOINTS, load_robot

TIMES = ("time/rollout", "time/policy", "time/estimator")  # parts of an iteration, in its metrics


class Trainer:
    """One run: networks, optimisers and environment, advanced an iteration at a time."""

    def __init__(self, settings: Settings, environment: Environment) -> None:
        settings.check()
        self.settings, self.environment = settings, environment
        self.method = METHODS[settings.method]
        self.iteration, self.samples = 0, 0  # control steps so far
        self.device = environment.device
        self._origins = tuple(checkpoint.identity(name) for name in (settings.start, settings.teacher))
        if settings.backend == "cpu":
            torch.set_num_threads(settings.threads)
        else:
            torch.set_float32_matmul_precision("high")
        torch.manual_seed(_key(settings.seed, "weights"))
        self.estimator = make_estimator(self.method.estimator).to(self.device)
        start = None
        if settings.start:
            start = checkpoint.load_start(settings.start, self.method.estimator)
            if type(start.estimator) is type(self.estimator):
                self.estimator.load_state_dict(start.estimator.state_dict())
                for name, count in self.estimator.named_buffers():
                    if name.endswith("normalizer.count"):
                        count.fill_(settings.start_samples)
        self._privileged = self.method.estimator == "oracle"
        self._estimates = self.method.estimates
        self._begin()
        self.ppo = self._make_ppo(start)
        robot = load_robot(environment.protocol.robot)
        scale = torch.tensor(robot.action_scale, dtype=torch.float32, device=self.device)
        self.teaching = None
        if settings.teacher:
            self.teaching = Teaching(checkpoint.load_teacher(settings.teacher), self.ppo.actor, scale)
        self.lessons: dict[str, ArmTeaching | PostureTeaching] = {}  # of geometry, by their setting
        if settings.arm_teaching[1]:
            self.lessons["arm_teaching"] = ArmTeaching(robot, self.ppo.actor, scale)
        if settings.posture_teaching[1]:
            self.lessons["posture_teaching"] = PostureTeaching(self.ppo.actor, scale)
        parameters = list(self.estimator.parameters())
        self.optimizer = (
            torch.optim.Adam(parameters, settings.estimator_learning_rate) if parameters else None
        )

    def _begin(self) -> None:
        """An empty history and an estimator at rest, for episodes that begin now."""
        count = self.environment.num_envs
        self._history = History(self.environment.seen.term)
        self._state = torch.zeros(count, self.estimator.state_dim, device=self.device)
        self._start = torch.ones(count, dtype=torch.bool, device=self.device)
        self._context = self._estimate() if self._estimates else None

    def _make_ppo(self, start: checkpoint.Checkpoint | None) -> PPO:
        settings, seen = self.settings, self._observations()
        # the critic sees what the oracle's context holds already
        groups = {"actor": ["policy"], "critic": ["critic"]}
        if self.estimator.context_dim:
            groups["actor"].append("context")
        if self._estimates:
            groups["critic"].append("context")
        gaussian = {"class_name": "GaussianDistribution", "std_type": "log"}
        common = {"hidden_dims": HIDDEN, "activation": "elu", "obs_normalization": True}
        actor = MLPModel(seen, groups, "actor", ACTIONS, distribution_cfg=gaussian, **common)
        critic = MLPModel(seen, groups, "critic", 1, **common)
        self._log_std: Tensor = actor.distribution.log_std_param  # type: ignore[union-attr, assignment]
        self._log_std.requires_grad_(False)  # follows a schedule, see `iterate`
        if start:
            with torch.no_grad():
                shared = checkpoint.shared_context(start.estimator, self.estimator)
                begin_with(actor, start.actor, shared, settings.start_samples)
        storage = RolloutStorage("rl", settings.envs, settings.steps, seen, [ACTIONS], str(self.device))
        ppo = PPO(
            actor,
            critic,
            storage,
            num_learning_epochs=settings.epochs,
            num_mini_batches=settings.minibatches,
            clip_param=settings.clip,
            gamma=settings.gamma,
            lam=settings.lam,
            entropy_coef=0.0,  # would act on the deviation alone
            learning_rate=settings.learning_rate,
            max_grad_norm=settings.gradient_norm,
            use_clipped_value_loss=False,
            schedule="adaptive",
            desired_kl=settings.desired_kl,
            device=str(self.device),
            symmetry_cfg=self._symmetry() if settings.mirror else None,
        )
        groups = [{"params": list(model.parameters())} for model in (actor, critic)]
        ppo.optimizer = torch.optim.Adam(groups, settings.learning_rate)

        def set_rates(optimizer: torch.optim.Optimizer, *_: object) -> None:
            ppo.learning_rate = max(ppo.learning_rate, settings.least_learning_rate)
            if self.iteration < settings.critic_iterations or self._taught < 1:
                ppo.learning_rate = settings.learning_rate  # a policy at rest has no divergence to adapt to
                for parameter in actor.parameters():
                    parameter.grad = None
            rates = ppo.learning_rate, settings.critic_learning_rate
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate

        # PPO has one rate for both, without a lower bound, and no critic that learns alone
        ppo.optimizer.register_step_pre_hook(set_rates)
        return ppo

    def _symmetry(self) -> dict:
        """rsl-rl's extension, with a function that puts the mirror images behind the samples."""
        robot = load_robot(self.environment.protocol.robot)
        mirrors = {
            "policy": input_mirror(robot),
            "critic": critic_mirror(robot),
            "context": privileged_mirror(robot),
            "action": joint_mirror(robot),
        }
        images = {
            name: (torch.from_numpy(m.place).to(self.device), torch.from_numpy(m.sign).to(self.device))
            for name, m in mirrors.items()
        }

        def both(name: str, x: Tensor) -> Tensor:
            place, sign = images[name]
            return torch.cat([x, x[..., place] * sign])

        def augment(env: object, obs: TensorDict | None, actions: Tensor | None) -> tuple:
            if obs is not None:
                groups = {name: both(name, obs[name]) for name in map(str, obs.keys()) if name in images}
                obs = TensorDict(groups, batch_size=[2 * len(obs)], device=self.device)
            return obs, None if actions is None else both("action", actions)

        return {"env": None, "data_augmentation_func": augment, "use_data_augmentation": True}

    # ---- one iteration -------------------------------------------------------------------------------------

    @property
    def _taught(self) -> float:
        return self.settings.taught(self.samples)

    @property
    def done(self) -> bool:
        """Whether the budget is used up."""
        return self.samples >= self.settings.budget

    def iterate(self) -> dict[str, float]:
        """Roll out, update policy and estimator; what is worth logging, by name."""
        settings, environment, ppo = self.settings, self.environment, self.ppo
        torch.manual_seed(_key(settings.seed, "iteration", self.iteration))
        legs, arm = settings.std(self.samples)
        self._log_std[:NUM_LEG_JOINTS], self._log_std[NUM_LEG_JOINTS:] = math.log(legs), math.log(arm)
        environment.curriculum = settings.ramp(self.samples)
        environment.severity = settings.severity(self.samples)
        environment.clear_log()
        environment.begin_rollout(self.iteration, settings.steps)
        clock = [time.perf_counter()]
        rollout, pushed = self._roll_out()
        clock.append(time.perf_counter())
        self._judge(pushed)
        ppo.num_learning_epochs = settings.epochs if self._taught == 1 else 1  # the critic's alone
        losses = ppo.update()
        if self.teaching and self._taught < 1:
            losses |= self.teaching.update(ppo.storage.observations, self._taught)
        elif self.teaching and (weight := settings.advice(self.samples)):
            losses |= self.teaching.advise(ppo.storage.observations, weight)
        for name, lessons in self.lessons.items():
            begin, end = getattr(settings, name)
            if begin <= self.samples < end:
                losses |= lessons.update(ppo.storage.observations)
        clock.append(time.perf_counter())
        losses |= self._update_estimator(rollout) if rollout else {}
        clock.append(time.perf_counter())
        self.iteration += 1
        self.samples += settings.envs * settings.steps
        found = {f"loss/{name}": float(value) for name, value in losses.items()}
        wrong = [name for name, value in found.items() if value != value or abs(value) == float("inf")]
        if wrong:
            raise TrainingError(
                f"run {settings.name}: {', '.join(wrong)} is not finite in iteration {self.iteration}; "
                "the last checkpoint is sound: resume with a smaller --learning-rate or another --seed"
            )
        seconds = [b - a for a, b in pairwise(clock)]
        found |= dict(zip(TIMES, seconds, strict=True))
        found |= {
            "policy/std_legs": legs,
            "policy/std_arm": arm,
            "policy/learning_rate": ppo.learning_rate,
            "episode/severity": environment.severity,
        }
        return found | environment.log()

    @torch.no_grad()
    def _roll_out(self) -> tuple[Rollout | None, Tensor]:
        """What the estimator learns from, and before which steps (T, N) a push came."""
        settings, environment, ppo = self.settings, self.environment, self.ppo
        ppo.train_mode()
        rollout, pushed = None, []
        if self.optimizer:
            ids = torch.randperm(settings.envs, device=self.device)[: settings.estimator_envs]
            rollout = Rollout(settings.steps, ids, self._state_before)
        observations = self._observations()
        teaching = self.teaching if self._taught < 0.5 else None
        # the last of the environments, fewer and fewer
        drives = torch.arange(settings.envs, device=self.device) >= 2 * self._taught * settings.envs
        for t in range(settings.steps):
            if rollout:
                rollout.before(t, self._history.window, self._start, environment.seen.velocity)
            action = ppo.act(observations)
            if teaching:  # with the policy's exploration
                noise = action - ppo.transition.distribution_params[0]  # type: ignore[index]
                action = torch.where(drives[:, None], teaching.answer(observations) + noise, action)
            step = environment.step(action)
            pushed.append(step.pushed)
            if rollout:
                rollout.after(t, step)
            if self._estimates:
                self._advance_context(step)
            observations = self._observations()
            ppo.process_env_step(observations, step.reward, step.done, {"time_outs": step.time_out})
        return rollout, torch.stack(pushed)

    @torch.no_grad()
    def _judge(self, pushed: Tensor) -> None:
        """The critic's targets, by rsl-rl; the policy's advantages, by `advantages`, normalised."""
        settings, ppo = self.settings, self.ppo
        seen = self._observations()
        ppo.compute_returns(seen)
        storage = ppo.storage
        values = torch.cat([storage.values, ppo.critic(seen)[None]])[..., 0]
        found = advantages(
            storage.rewards[..., 0],
            values,
            storage.dones[..., 0].bool(),
            pushed,
            settings.gamma,
            settings.policy_lam,
        )
        storage.advantages = ((found - found.mean()) / (found.std() + 1e-8))[..., None]

    def _advance_context(self, step: Step) -> None:
        self._history.push(step.seen.term, fresh=step.done)
        self._state = torch.where(step.done[:, None], 0.0, self._state)
        self._start = step.done
        self._context = self._estimate()

    @torch.no_grad()
    def _estimate(self) -> Tensor:
        """The sampled context of the windows. Source: paper, eq. estimated_context."""
        self._state_before = self._state
        noise = torch.randn(len(self._state), self.estimator.latent_dim, device=self.device)
        context, self._state = self.estimator.step(self._history.window, self._state, noise)
        return context

    def _observations(self) -> TensorDict:
        seen = self.environment.seen
        groups = {"policy": seen.policy, "critic": seen.critic}
        if self._privileged:
            groups["context"] = seen.critic[:, PRIVILEGED_COLUMNS]
        elif self._context is not None:
            groups["context"] = self._context
        if self.settings.posture_teaching[1]:
            groups["lack"] = self.environment.lack()
        return TensorDict(groups, batch_size=[self.environment.num_envs], device=self.device)

    def _update_estimator(self, rollout: Rollout) -> dict[str, float]:
        assert self.optimizer is not None
        settings, sums = self.settings, {}
        for batch in rollout.batches(settings.estimator_minibatches):
            noise = torch.randn(*batch.start.shape, self.estimator.latent_dim, device=self.device)
            losses = self.estimator.losses(batch, noise)
            self.optimizer.zero_grad()
            losses["total"].backward()
            torch.nn.utils.clip_grad_norm_(self.estimator.parameters(), settings.gradient_norm)
            self.optimizer.step()
            for name, value in losses.items():
                sums[f"estimator_{name}"] = sums.get(f"estimator_{name}", 0.0) + value.detach()
        self.estimator.observe(rollout.history)
        return {name: float(value) / settings.estimator_minibatches for name, value in sums.items()}

    def _fits(self) -> dict[str, Fit]:
        taught = {"teaching": self.teaching.fit} if self.teaching else {}
        return taught | {name: lessons.fit for name, lessons in self.lessons.items()}

    # ---- networks for an evaluation, and everything for a resume -------------------------------------------

    def actor(self) -> Actor:
        """The policy's mean, in the form of an evaluation."""
        trained, actor = self.ppo.actor, Actor(self.estimator.context_dim)
        weights = {f"mlp.{name}": value for name, value in trained.mlp.state_dict().items()}
        normalizer = trained.obs_normalizer
        actor.load_state_dict(
            weights | {"normalizer.mean": normalizer.mean, "normalizer.std": normalizer.std}
        )
        return actor.eval()

    def write_checkpoint(self, path: Path, seconds: float) -> None:
        """Write what an evaluation needs, with its card; `seconds` of training so far."""
        settings = self.settings
        protocol, _ = find_protocol(settings.protocol)
        card = new_card(settings.method, settings.seed, self.samples, seconds, protocol)
        card = msgspec.structs.replace(card, start=self._origins[0], teacher=self._origins[1])
        checkpoint.save(path, self.actor(), self.estimator, card)

    def save(self) -> dict:
        """Everything that the next iterations depend on, as tensors and numbers."""
        counts = {
            name: value for name, value in self.estimator.named_buffers() if name.endswith("normalizer.count")
        }
        return {
            "settings": asdict(self.settings),
            "iteration": self.iteration,
            "samples": self.samples,
            "ppo": self.ppo.save(),
            "learning_rate": self.ppo.learning_rate,
            "estimator": self.estimator.state_dict() | counts,
            "optimizer": self.optimizer.state_dict() if self.optimizer else {},
            "teaching": {name: fit.optimizer.state_dict() for name, fit in self._fits().items()},
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
        """Go on from what `save` returned: bit by bit, or with new episodes where settings have changed."""
        self.iteration, self.samples = saved["iteration"], saved["samples"]
        self.ppo.load(saved["ppo"], None, strict=True)
        self.ppo.learning_rate = saved["learning_rate"]
        buffers = dict(self.estimator.named_buffers())
        for name, value in saved["estimator"].items():
            if name.endswith("normalizer.count"):
                buffers[name].copy_(value)
        self.estimator.load_state_dict(
            {k: v for k, v in saved["estimator"].items() if not k.endswith("normalizer.count")}
        )
        if self.optimizer:
            self.optimizer.load_state_dict(saved["optimizer"])
        for name, fit in self._fits().items():
            if name in saved["teaching"]:  # or these lessons are new
                fit.optimizer.load_state_dict(saved["teaching"][name])
        if self.settings.changes(saved["settings"]):
            torch.manual_seed(_key(self.settings.seed, "episodes", self.iteration))
            self.environment.begin(self.iteration)  # draws that no iteration before has come to
            self._begin()
            return
        episodes = saved["episodes"]
        self.environment.load(episodes["environment"])
        self._history.window = episodes["history"].to(self.device)
        self._state, self._start = episodes["state"].to(self.device), episodes["start"].to(self.device)
        self._state_before = episodes["state_before"].to(self.device)
        if self._estimates:
            self._context = episodes["context"].to(self.device)


def duration(metrics: dict[str, float]) -> float:
    """Time [s] that the iteration of these metrics took."""
    return sum(metrics[name] for name in TIMES)


def advantages(
    rewards: Tensor, values: Tensor, done: Tensor, pushed: Tensor, gamma: float, lam: float
) -> Tensor:
    """Generalised advantage estimates (T, N) in which no push is a merit or a fault of the actions before.

    A push comes whatever the robot does, and the value before it expects it already. The sum ends there, as
    if the step before were judged by that value alone; its other summands would be chance.

    rewards, done, pushed (T, N), values (T + 1, N); pushed: a push came between what the policy saw at t and
    the physics of step t. Source: Schulman et al. 2016, eq. 16; Mao et al. 2019, "Variance reduction for
    reinforcement learning in input-driven environments", for what an input is to a baseline.
    """
    found, advantage = torch.empty_like(rewards), torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        surprise = rewards[t] + gamma * values[t + 1] * ~done[t] - values[t]
        advantage = (surprise + gamma * lam * advantage * ~done[t]) * ~pushed[t]
        found[t] = advantage
    return found


def _key(seed: int, purpose: str, index: int = 0) -> int:
    """A seed for torch's generator: of one purpose and iteration, and of no other."""
    return ((seed & 0xFFFF) << 48) | ((zlib.crc32(purpose.encode()) & 0xFFFF) << 32) | (index & 0xFFFFFFFF)
