"""The configuration of a training run, its schedules and its checks."""

import json
from bisect import bisect_right
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Literal

from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench.errors import BenchError, UnknownNameError

EXPLORING = 0.27  # [1] noise of the legs at which the rates of the auxiliary losses were found
ESTIMATOR_UPDATES = 4  # per iteration, where the estimator has as many environments
FREE = frozenset({"budget", "threads"})  # settings that may differ when a run is resumed
# Control steps and value of each knot; geometric between knots, constant before the first and after the last
Schedule = tuple[tuple[float, float], ...]


class TrainingError(BenchError):
    """A run that cannot be started, resumed or continued."""


@dataclass(frozen=True)
class TrainConfig:
    """All settings that affect what a run learns. A run can be resumed only with identical settings.

    Control steps are counted over all environments. Schedules are intervals in control steps, not parts of
    the budget, so a short run is the beginning of every longer one. Names that rsl-rl also has mean the same
    here.
    """

    method: str
    """Method of the study, for example no_latent, cenet, gru, transformer, transformer_gru or oracle."""
    seed: int = 0
    """Seed of the initial weights and of all random samples of the run."""
    budget: float = 60e6
    """Length of the training [control steps], summed over all environments."""
    protocol: str = "ablation_v1"
    """Protocol whose targets, randomization, noise, pushes and terminations are used in training."""
    num_envs: int = 768
    """Number of environments simulated in parallel."""
    num_steps_per_env: int = 24
    """Length of a rollout [control steps per environment]."""
    num_learning_epochs: int = 3
    """Number of passes of PPO over each rollout."""
    num_mini_batches: int = 4
    """Number of mini-batches into which PPO divides a rollout in each pass."""
    learning_rate: float = 1e-4
    """Initial learning rate of the policy [1]; it is then adapted to reach `desired_kl`."""
    min_learning_rate: Schedule = ((0.0, 2e-5),)
    """Lower bound [1] of the adapted learning rate of the policy, at control steps: STEPS VALUE STEPS VALUE
    and so on, geometric in between."""
    critic_learning_rate: float = 5e-4
    """Constant learning rate of the critic [1]."""
    desired_kl: Schedule = ((0.0, 0.03),)
    """KL divergence per update [nat] that the adapted learning rate aims at, at control steps."""
    gamma: float = 0.99
    """Discount factor per control step [1]."""
    lam: float = 0.95
    """Lambda of the critic's return targets [1], as in TD(lambda)."""
    actor_lam: float = 0.8
    """Lambda of the policy's generalized advantage estimates [1]. It is smaller than the critic's because a
    well-trained critic makes long sums of rewards unnecessary."""
    clip_param: float = 0.2
    """Clipping range of PPO's probability ratio [1]."""
    max_grad_norm: float = 1.0
    """Largest norm to which a gradient is clipped [1]."""
    init_checkpoint: str = "oracle@0"
    """Checkpoint whose weights initialize the policy: one without a context (see `wbc-train dagger`), the
    oracle, or one with the same estimator, which is then initialized as well; "" for random weights."""
    init_normalizer_count: int = 30_000_000
    """Number of observations that the initial checkpoint's normalizer statistics count for. With few, the
    first falls shift the statistics faster than the policy can adapt: with 200,000, a policy that stood for
    2.9 s fell at 1.2 s half a million control steps later, before its first update."""
    teacher: str = "oracle@0"
    """Checkpoint without an estimated context (no_latent or oracle) from which the policy is distilled at
    first; "" for no distillation."""
    distillation_steps: float = 8e6
    """Duration of the distillation [control steps]. Meanwhile the policy is fitted to the teacher's actions
    alone and the critic to the returns. In the first half the teacher acts in a part of the environments,
    which shrinks from all to none."""
    kickstart_steps: float = 30e6
    """End [control steps] of the phase in which the teacher's actions are an auxiliary loss beside PPO, with
    a weight that falls linearly to 0 from the end of the distillation; 0 for none."""
    arm_ik_loss: tuple[float, float] = (8e6, 57e6)
    """Interval [control steps] during which an imitation loss toward the arm's inverse kinematics is added to
    PPO; 0 0 for never."""
    posture_loss: tuple[float, float] = (8e6, 57e6)
    """Interval [control steps] during which robots that stand still with the hand short of a target, although
    it needs no step, imitate a leg posture that reaches it, in addition to PPO; 0 0 for never."""
    symmetry_augmentation: bool = False
    """Whether PPO also learns from the mirror image of every sample; only for methods without an estimator,
    because the inputs of an estimator are not mirrored."""
    critic_warmup_iterations: int = 15
    """Number of first iterations in which only the critic is updated, because it knows nothing yet about the
    returns of the initial policy; 0 for none."""
    std_legs: Schedule = ((36e6, 0.27), (58e6, 0.05))
    """Standard deviation of the leg actions [1] in units of the action scale, at control steps. At 0.14 a
    policy keeps standing still and falls when pushed; at 0.27 it learns to step, see docs/training-log.md.
    Most of the successful episodes appear while it decays."""
    std_arm: Schedule = ((36e6, 0.4), (58e6, 0.05))
    """Standard deviation of the arm actions [1] in units of the action scale, at control steps."""
    timestep: float = 0.01
    """Physics step [s] in training; an evaluation always uses the protocol's."""
    decimation: int = 2
    """Number of physics steps per control period."""
    curriculum: float = 0.0
    """Duration [control steps] of the curriculum from mostly `arm` targets to the protocol's weights of the
    strata; 0 for the protocol's weights from the beginning."""
    disturbance_ramp: tuple[float, float] = (0.0, 0.0)
    """Interval [control steps] over which noise, pushes and randomization grow linearly from none to the
    protocol's; 0 0 for the protocol's from the beginning, because a policy that first learns to stand
    undisturbed does not learn to step."""
    undisturbed: float = 0.0
    """Fraction of the episodes [1] without noise, pushes and randomization."""
    push_interval: tuple[float, float] = (1.5, 3.0)
    """Shortest and longest time between two pushes [s]; 0 0 for the protocol's. Frequent pushes make up for
    the many control steps in which a robot merely stands."""
    estimator_share: float = 0.125
    """Fraction of the environments [1] whose rollouts train the estimator; they are drawn anew in each
    iteration."""
    estimator_mini_batches: int | None = None
    """Number of updates of the estimator per iteration, each on whole rollouts of a part of its
    environments; 4, or one per environment of the estimator if it has fewer, when not given."""
    estimator_learning_rate: float = 1e-3
    """Constant learning rate of the estimator [1]."""
    backend: Literal["cpu", "warp"] = "cpu"
    """Physics engine of the training: mujoco.batch on a CPU, or mujoco_warp on a GPU."""
    threads: int = 2
    """Number of CPU threads for the physics and for torch."""

    @property
    def name(self) -> str:
        """Name of the run, METHOD@SEED."""
        return f"{self.method}@{self.seed}"

    def changes(self, before: dict) -> dict[str, tuple[object, object]]:
        """Compare with the earlier settings of a run.

        Args:
            before: Settings by name, as `dataclasses.asdict` or a JSON file gives them.

        Returns:
            Old and new value by name, of all settings that differ and affect what is learned.
        """
        before = asdict(TrainConfig(self.method)) | before  # a setting newer than the run had its default
        # as they come back from a file: tuples become lists
        old, new = (json.loads(json.dumps(_with_updates(settings))) for settings in (before, asdict(self)))
        return {
            name: (old[name], value) for name, value in new.items() if name not in FREE and old[name] != value
        }

    # ---- schedules, after `samples` control steps ----------------------------------------------------------

    def std(self, samples: int) -> tuple[float, float]:
        """Standard deviations of the leg and the arm actions."""
        return value_at(self.std_legs, samples), value_at(self.std_arm, samples)

    def pace(self, samples: int) -> float:
        """Factor on the rates of the auxiliary losses: the noise of the legs over EXPLORING, at most 1.

        PPO moves the policy by a part of the noise, whatever the losses beside it do. With rates that stayed,
        falls rose from 8 to 40 % while the noise fell from 0.27 to 0.08, and came down within a million
        control steps after the losses had ended, see docs/training-log.md.
        """
        return min(1.0, value_at(self.std_legs, samples) / EXPLORING)

    def disturbance_scale(self, samples: int) -> float:
        """Scale in [0, 1] of noise, pushes and randomization."""
        return _progress(samples, *self.disturbance_ramp)

    def distillation_progress(self, samples: int) -> float:
        """Completed fraction in [0, 1] of the distillation; 1 without a teacher."""
        return _progress(samples, 0.0, self.distillation_steps) if self.teacher else 1.0

    def kickstart_weight(self, samples: int) -> float:
        """Weight in [0, 1] of the teacher's actions beside PPO; 0 without a teacher."""
        if not self.teacher:
            return 0.0
        return 1.0 - _progress(samples, self.distillation_steps, self.kickstart_steps)

    def curriculum_progress(self, samples: int) -> float:
        """Completed fraction in [0, 1] of the curriculum."""
        return _progress(samples, 0.0, self.curriculum)

    # ---- checks --------------------------------------------------------------------------------------------

    def check(self) -> None:
        """Refuse settings that cannot be run.

        Raises:
            UnknownNameError: There is no such method.
            TrainingError: A number is out of its range.
        """
        if self.method not in METHODS:
            raise UnknownNameError("method", self.method, METHODS, "--method")
        for name in (
            *("budget", "num_envs", "num_steps_per_env", "num_learning_epochs", "num_mini_batches"),
            *("estimator_mini_batches", "threads"),
        ):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise TrainingError(f"{option(name)} {value}: valid: 1 or more")
        if not self.distillation_steps > 0:
            raise TrainingError(f"--distillation-steps {self.distillation_steps:g}: valid: more than 0")
        for name in ("std_legs", "std_arm", "min_learning_rate", "desired_kl"):
            knots = getattr(self, name)
            steps, values = [step for step, _ in knots], [value for _, value in knots]
            rising = all(a < b for a, b in pairwise(steps))
            if not (knots and rising and steps[0] >= 0 and min(values) > 0):
                given = " ".join(f"{number:g}" for knot in knots for number in knot)
                raise TrainingError(
                    f"{option(name)} {given}: valid: control steps from 0 on that rise, each followed by a "
                    "value above 0"
                )
        begin, end = self.disturbance_ramp
        if not (0.0 <= begin < end or begin == end == 0.0):
            raise TrainingError(
                f"--disturbance-ramp {begin:g} {end:g}: valid: 0 <= begin < end, or 0 0 for no ramp"
            )
        if not 0.0 <= self.undisturbed <= 1.0:
            raise TrainingError(f"--undisturbed {self.undisturbed:g}: valid: 0 to 1")
        least, most = self.push_interval
        if not (0.0 < least <= most or least == most == 0.0):
            raise TrainingError(
                f"--push-interval {least:g} {most:g}: valid: 0 < least <= most, or 0 0 for the protocol's"
            )
        for name in ("arm_ik_loss", "posture_loss"):
            begin, end = getattr(self, name)
            if not 0.0 <= begin <= end:
                raise TrainingError(
                    f"{option(name)} {begin:g} {end:g}: valid: 0 <= begin <= end, or 0 0 for never"
                )
        if self.symmetry_augmentation and METHODS[self.method].estimates:
            valid = ", ".join(name for name, method in METHODS.items() if not method.estimates)
            raise TrainingError(
                f"--symmetry-augmentation with --method {self.method}: valid: {valid}, "
                "which have no estimator"
            )
        if self.num_envs * self.num_steps_per_env < self.num_mini_batches:
            raise TrainingError(
                f"--num-mini-batches {self.num_mini_batches}: valid: 1 to "
                f"{self.num_envs * self.num_steps_per_env} (num-envs x num-steps-per-env)"
            )
        if self.estimator_updates > self.estimator_envs:
            raise TrainingError(
                f"--estimator-mini-batches {self.estimator_mini_batches}: valid: 1 to {self.estimator_envs}, "
                f"the environments that train the estimator (--num-envs {self.num_envs} x --estimator-share "
                f"{self.estimator_share:g}): give --estimator-mini-batches {self.estimator_envs} or fewer"
            )

    @property
    def estimator_envs(self) -> int:
        """Number of environments whose rollouts train the estimator."""
        return _estimator_envs(self.num_envs, self.estimator_share)

    @property
    def estimator_updates(self) -> int:
        """Number of updates of the estimator per iteration."""
        return _with_updates(asdict(self))["estimator_mini_batches"]


def value_at(schedule: Schedule, samples: float) -> float:
    """Return the value of a schedule after `samples` control steps."""
    after = bisect_right(schedule, samples, key=lambda knot: knot[0])
    if after in (0, len(schedule)):
        return schedule[max(after - 1, 0)][1]
    (begin, first), (end, last) = schedule[after - 1 : after + 1]
    return first * (last / first) ** ((samples - begin) / (end - begin))


def option(name: str) -> str:
    """Command-line option of a setting, for error messages: `--num-envs` of `num_envs`."""
    return f"--{name.replace('_', '-')}"


def _estimator_envs(num_envs: int, share: float) -> int:
    return max(1, round(num_envs * share))


def _with_updates(settings: dict) -> dict:
    """Settings in which a number of updates of the estimator that was not given is the one that is used."""
    if settings["estimator_mini_batches"] is not None:
        return settings
    most = _estimator_envs(settings["num_envs"], settings["estimator_share"])
    return settings | {"estimator_mini_batches": min(ESTIMATOR_UPDATES, most)}


def _progress(samples: float, begin: float, end: float) -> float:
    """Completed fraction in [0, 1] of the interval from `begin` to `end`; 1 if the interval is empty."""
    return max(0.0, (samples - begin) / (end - begin)) if samples < end else 1.0
