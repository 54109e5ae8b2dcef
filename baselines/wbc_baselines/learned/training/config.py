"""The settings of a training run."""

import json
from dataclasses import asdict, dataclass
from typing import Literal

from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench.errors import BenchError, UnknownNameError

FREE = frozenset({"budget", "threads"})  # settings that may differ when a run goes on


class TrainingError(BenchError):
    """A run that cannot be started, resumed or continued."""


@dataclass(frozen=True)
class Settings:
    """Everything that what a run learns depends on; a run resumes with the same ones only."""

    method: str
    """A method of the study: no_latent, cenet, gru, transformer, transformer_gru, oracle, ..."""
    seed: int = 0
    """Seed of weights and draws."""
    budget: float = 60e6
    """Control steps to train on, over all environments."""
    protocol: str = "ablation_v1"
    """Whose targets, randomisation, noise, pushes and terminations are trained on."""
    envs: int = 768
    """Environments side by side."""
    steps: int = 24
    """Control steps of a rollout."""
    epochs: int = 3
    """Passes of PPO over a rollout."""
    minibatches: int = 4
    """Parts of a rollout in one pass."""
    learning_rate: float = 1e-4
    """Of the policy at the start; then adapted to `desired_kl`."""
    least_learning_rate: float = 2e-5
    """Below which it is not adapted."""
    critic_learning_rate: float = 5e-4
    """Of the critic, throughout."""
    desired_kl: float = 0.03
    """KL divergence of an update that the learning rate aims at."""
    gamma: float = 0.99
    """Discount of a control step."""
    lam: float = 0.95
    """Lambda of the critic's targets."""
    policy_lam: float = 0.8
    """Lambda of the policy's advantages. The better the critic, the less is gained by looking further."""
    clip: float = 0.2
    """PPO's clip."""
    gradient_norm: float = 1.0
    """Largest norm of a gradient."""
    start: str = "oracle@0"
    """Checkpoint that the policy begins with: one without context (`wbc-train imitate`), the oracle, or one
    with the same estimator, which begins with it as well; "" for random weights."""
    start_samples: int = 30_000_000
    """Observations that the start's normaliser counts for. With fewer, first falls shift it faster than the
    policy can follow: at 200,000 a start that stood for 2.9 s fell at 1.2 s half a million steps later,
    before any update of the policy."""
    teacher: str = "oracle@0"
    """Checkpoint without memory (no_latent or oracle) that the policy imitates at first; "" for none."""
    teacher_steps: float = 8e6
    """Control steps of that: the policy learns from the teacher's answers alone, the critic from returns. In
    the first half the teacher drives in a part of the environments, at first in all."""
    advice_steps: float = 30e6
    """Control steps until which it then advises beside PPO, less and less; 0 for never."""
    arm_teaching: tuple[float, float] = (8e6, 57e6)
    """Control steps from which on and until when its inverse kinematics teaches the arm, beside PPO."""
    posture_teaching: tuple[float, float] = (8e6, 57e6)
    """Control steps from which on and until when robots that stand still, short of a target in reach, are
    taught a posture of the legs that reaches it, beside PPO; 0 0 for never, as above."""
    mirror: bool = False
    """Whether PPO also learns from the mirror image of every sample; for methods without an estimator, whose
    inputs have one."""
    critic_iterations: int = 15
    """First iterations in which only the critic learns: it knows nothing of a start's returns."""
    std_legs: tuple[float, float] = (0.27, 0.05)
    """Standard deviation of the leg actions at the start and in the end. Who learns at 0.14 stands still and
    falls when pushed; at 0.27 it learns to step (see baselines/README.md)."""
    std_arm: tuple[float, float] = (0.4, 0.05)
    """Standard deviation of the arm actions at the start and in the end."""
    std_steps: tuple[float, float] = (36e6, 58e6)
    """Control steps from which on and until when they fall, exponentially: the last two fifths of the
    budget. What succeeds at all, succeeds while they fall."""
    timestep: float = 0.01
    """[s] of the physics; an evaluation always takes the protocol's."""
    decimation: int = 2
    """Physics steps in a control period."""
    curriculum: float = 0.0
    """Control steps over which the strata ramp from mostly `arm` to the protocol's weights."""
    calm: tuple[float, float] = (0.0, 0.0)
    """Control steps from which on and until when noise, pushes and randomisation rise from none to the
    protocol's; 0 0 for all from the first step on: who learns to stand undisturbed does not learn to step."""
    push_interval: tuple[float, float] = (1.5, 3.0)
    """[s] between two pushes, least and most; 0 0 for the protocol's. Most steps of an episode show a robot
    that stands: with more pushes more of them show how to stay up."""
    estimator_share: float = 0.125
    """Part of the environments whose rollouts train the estimator; drawn anew each iteration."""
    estimator_minibatches: int = 4
    """Updates of the estimator in an iteration, each on whole rollouts of its own environments."""
    estimator_learning_rate: float = 1e-3
    """Of the estimator's Adam."""
    backend: Literal["cpu", "warp"] = "cpu"
    """mujoco.batch on a CPU, or mujoco_warp on a GPU."""
    threads: int = 2
    """Threads of physics and of torch on a CPU."""

    @property
    def name(self) -> str:
        """METHOD@SEED."""
        return f"{self.method}@{self.seed}"

    def changes(self, before: dict) -> dict[str, tuple[object, object]]:
        """Before and now, of what differs from a run's earlier settings and what it learns depends on."""
        before = asdict(Settings(self.method)) | before  # a setting newer than the run had its default
        # as they come back from a file: tuples become lists
        old, new = (json.loads(json.dumps(settings)) for settings in (before, asdict(self)))
        return {
            name: (old[name], value) for name, value in new.items() if name not in FREE and old[name] != value
        }

    # Schedules count control steps, not parts of the budget: a run is the beginning of every longer one.

    def std(self, samples: int) -> tuple[float, float]:
        """Standard deviations of leg and arm actions after so many control steps."""
        way = _way(samples, *self.std_steps)
        legs, arm = (first * (last / first) ** way for first, last in (self.std_legs, self.std_arm))
        return legs, arm

    def severity(self, samples: int) -> float:
        """Of the disturbances, in [0, 1], after so many control steps."""
        return _way(samples, *self.calm)

    def taught(self, samples: int) -> float:
        """Part of the teacher's time that is over, in [0, 1], after so many control steps; 1 without one."""
        return _way(samples, 0.0, self.teacher_steps) if self.teacher else 1.0

    def advice(self, samples: int) -> float:
        """Weight of the teacher's advice beside PPO, in [0, 1], after so many control steps."""
        return 1.0 - _way(samples, self.teacher_steps, self.advice_steps) if self.teacher else 0.0

    def ramp(self, samples: int) -> float:
        """Part of the curriculum that is done, in [0, 1], after so many control steps."""
        return _way(samples, 0.0, self.curriculum)

    def check(self) -> None:
        """Refuse what cannot be run.

        Raises:
            UnknownNameError: no such method.
            TrainingError: a number out of its range.
        """
        if self.method not in METHODS:
            raise UnknownNameError("method", self.method, METHODS, "--method")
        for name in ("budget", "envs", "steps", "epochs", "minibatches", "estimator_minibatches", "threads"):
            if getattr(self, name) < 1:
                option = name.replace("_", "-")
                raise TrainingError(f"--{option} {getattr(self, name)}: valid: 1 or more")
        for option, values in (
            ("teacher-steps", (self.teacher_steps,)),
            ("std-legs", self.std_legs),
            ("std-arm", self.std_arm),
        ):
            if not min(values) > 0:
                raise TrainingError(f"--{option} {' '.join(map(str, values))}: valid: more than 0")
        begin, end = self.std_steps
        if not 0.0 <= begin < end:
            raise TrainingError(f"--std-steps {begin:g} {end:g}: valid: 0 <= begin < end")
        begin, end = self.calm
        if not (0.0 <= begin < end or begin == end == 0.0):
            raise TrainingError(f"--calm {begin:g} {end:g}: valid: 0 <= begin < end, or 0 0 for never")
        least, most = self.push_interval
        if not (0.0 < least <= most or least == most == 0.0):
            raise TrainingError(
                f"--push-interval {least:g} {most:g}: valid: 0 < least <= most, or 0 0 for the protocol's"
            )
        for name in ("arm_teaching", "posture_teaching"):
            begin, end = getattr(self, name)
            if not 0.0 <= begin <= end:
                option = name.replace("_", "-")
                raise TrainingError(
                    f"--{option} {begin:g} {end:g}: valid: 0 <= begin <= end, or 0 0 for never"
                )
        if self.mirror and METHODS[self.method].estimates:
            valid = ", ".join(name for name, method in METHODS.items() if not method.estimates)
            raise TrainingError(
                f"--mirror with --method {self.method}: valid: {valid}, which estimate nothing"
            )
        if self.envs * self.steps < self.minibatches:
            raise TrainingError(
                f"--minibatches {self.minibatches}: valid: 1 to {self.envs * self.steps} (envs x steps)"
            )
        if self.estimator_minibatches > self.estimator_envs:
            raise TrainingError(
                f"--estimator-minibatches {self.estimator_minibatches}: valid: 1 to {self.estimator_envs} "
                "(envs x estimator-share)"
            )

    @property
    def estimator_envs(self) -> int:
        """Environments whose rollouts train the estimator."""
        return max(1, round(self.envs * self.estimator_share))


def _way(samples: float, begin: float, end: float) -> float:
    """Part of the way from `begin` to `end` that is done, in [0, 1]; all of it where there is none."""
    return max(0.0, (samples - begin) / (end - begin)) if samples < end else 1.0
