"""Imitation of another controller of the bench by a policy without a context, to initialize all methods.

DAgger: the teacher gives an action in every state, but the student acts in a growing fraction of the
episodes, so that the states are those that a policy visits and not only those that a teacher visits.

Source: Ross, Gordon, Bagnell 2011, "A reduction of imitation learning and structured prediction to no-regret
online learning".
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import huber_loss

from wbc_baselines.learned.policy.architecture import SIZES, flow_of
from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.controller import LearnedController
from wbc_baselines.learned.policy.networks import Actor
from wbc_baselines.learned.training.resets import sample_episodes, scale_disturbances
from wbc_baselines.learned.training.symmetry import input_mirror, joint_mirror
from wbc_baselines.learned.training.target_set import TargetSet
from wbc_bench.controller import (
    Controller,
    ControllerInfo,
    JointCommand,
    Observation,
    ProtocolAware,
    Target,
)
from wbc_bench.episodes.manifest import EpisodeManifest, neutral
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.outcomes import STRATA
from wbc_bench.parallel import in_parallel
from wbc_bench.randomness import stream
from wbc_bench.registry import load_controller
from wbc_bench.robot import NUM_LEG_JOINTS, Robot, load_robot

METHOD = "no_latent"  # the method whose policy has no context
SHARD = 25  # episodes that are simulated together
# Of a leg's action, in units of the action scale; choice: a larger one answers a fall and is not to be
# imitated. The arm's scales are small (0.2 and 0.3 rad), so that reaching a target often takes 5 and more.
MAX_LEG_ACTION = 3.0
MAX_STUDENT_FRACTION = 0.9  # of a round's episodes in which the student acts; choice
HUBER_DELTA = 0.05  # [rad] of the Huber loss; choice

Progress = Callable[[int, int], None]  # (done, total) episodes


class ImitationDataset(NamedTuple):
    """The teacher's actions for inputs of the policy."""

    inputs: NDArray[np.float32]  # (M, 67) observation and command
    action: NDArray[np.float32]  # (M, 14) in units of the action scale

    @classmethod
    def joined(cls, parts: "list[ImitationDataset]") -> "ImitationDataset":
        """Concatenate datasets in their order."""
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def with_mirror_images(self, robot: Robot) -> "ImitationDataset":
        """Append the mirror image of every sample, left and right exchanged."""
        images = ImitationDataset(input_mirror(robot)(self.inputs), joint_mirror(robot)(self.action))
        return ImitationDataset.joined([self, images])


class _StudentEngine:
    """The engine of the student: its actions where it acts, and the teacher's elsewhere."""

    flow = flow_of(SIZES["none"])

    def __init__(self, student: Actor | None, student_acts: NDArray[np.bool_]) -> None:
        self.student, self.student_acts = student, student_acts
        self.teacher_action = self.inputs = np.empty((0, 0), np.float32)

    def begin(self, frame: NDArray[np.float32]) -> None:
        """Carry nothing."""

    def __call__(
        self, values: Mapping[str, NDArray[np.float32]], carried: None
    ) -> tuple[dict[str, NDArray[np.float32]], None]:
        self.inputs = np.concatenate([values["observation"], values["command"]], axis=-1)
        action = self.teacher_action
        if self.student:
            with torch.inference_mode():
                mine = self.student(torch.from_numpy(self.inputs)).numpy()
            action = np.where(self.student_acts[:, None], mine, action)
        return {"action": action}, None


class DaggerController:
    """A controller in which teacher and student observe the same episodes, and one of them acts in each."""

    def __init__(
        self,
        robot: Robot,
        protocol: EvalProtocol,
        teacher: Controller,
        student: Actor | None,
        student_acts: NDArray[np.bool_],
    ) -> None:
        """Combine a teacher and a student.

        Args:
            robot: Robot of the protocol.
            protocol: Protocol of the episodes.
            teacher: Controller whose actions are recorded.
            student: Policy without a context, or None where the teacher always acts.
            student_acts: (N,) bool Episodes in which the student acts.
        """
        self._teacher, self._robot, self._engine = teacher, robot, _StudentEngine(student, student_acts)
        card = new_card(METHOD, 0, 0, 0.0, protocol)
        self._student = LearnedController(robot, card, self._engine, "dagger", "")
        signals = teacher.info.signals | self._student.info.signals
        self.info = ControllerInfo("dagger", signals, protocol.control_period, "wbc_baselines.learned")
        self.recorded: list[ImitationDataset] = []

    def prepare(self, protocol: EvalProtocol) -> None:
        """See `wbc_bench.controller.ProtocolAware`."""
        for part in (self._teacher, self._student):
            if isinstance(part, ProtocolAware):
                part.prepare(protocol)

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """See `wbc_bench.controller.Controller`."""
        self._teacher.reset(episodes, obs, target)
        self._student.reset(episodes, obs, target)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Act, and record the teacher's action wherever it is fit to be imitated."""
        wanted = self._robot.action_of(self._teacher.act(obs, target).q)
        self._engine.teacher_action = wanted.astype(np.float32)
        command = self._student.act(obs, target)
        kept = obs.active & (np.abs(wanted[:, :NUM_LEG_JOINTS]) < MAX_LEG_ACTION).all(axis=1)
        inputs = self._engine.inputs[kept]
        self.recorded.append(ImitationDataset(inputs, wanted[kept].astype(np.float32)))
        return command


def record(
    spec: str,
    protocol: EvalProtocol,
    target_set: TargetSet,
    episodes: int,
    seed: int,
    student: Actor | None = None,
    student_fraction: float = 0.0,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> ImitationDataset:
    """Simulate episodes and record the teacher's actions.

    Targets come from training's set and samples from streams of training's own, so no evaluation shares them.

    Args:
        spec: SPEC of the teacher.
        protocol: Protocol of the episodes.
        target_set: Targets that episodes pick from.
        episodes: Number of episodes.
        seed: Seed of all samples.
        student: Policy without a context, or None where the teacher always acts.
        student_fraction: Probability with which the student acts in an episode.
        workers: Number of processes; the result does not depend on it.
        progress: Is called with completed and total episodes.

    Returns:
        The dataset of all episodes.
    """
    state = student.state_dict() if student else None

    def work(number: int) -> ImitationDataset:
        count = min(SHARD, episodes - number * SHARD)
        return _record_shard(spec, protocol, target_set, seed, number, count, state, student_fraction)

    parts: list[ImitationDataset] = []
    for part in in_parallel(workers, work, range(-(-episodes // SHARD))):
        parts.append(part)
        progress(min(len(parts) * SHARD, episodes), episodes)
    return ImitationDataset.joined(parts)


def _record_shard(
    spec: str,
    protocol: EvalProtocol,
    target_set: TargetSet,
    seed: int,
    number: int,
    count: int,
    student_state: dict | None,
    student_fraction: float,
) -> ImitationDataset:
    student = None
    if student_state:
        student = Actor(0)
        student.load_state_dict(student_state)
    rng = stream(seed, "lessons", number)
    robot, rows = load_robot(protocol.robot), sample_manifest(protocol, target_set, count, rng)
    student_acts = rng.random(count) < student_fraction
    controller = DaggerController(robot, protocol, load_controller(spec, robot), student, student_acts)
    for _ in ControlLoop(controller, protocol, rows).run():
        pass  # the controller records
    return ImitationDataset.joined(controller.recorded)


def sample_manifest(
    protocol: EvalProtocol, target_set: TargetSet, count: int, rng: np.random.Generator
) -> EpisodeManifest:
    """Sample training episodes as rows of a manifest.

    Args:
        protocol: Protocol of the episodes.
        target_set: Targets that episodes pick from.
        count: Number of episodes.
        rng: Random generator.

    Returns:
        A manifest of `count` episodes.
    """
    samples = sample_episodes(protocol, target_set, count, rng)
    chosen, push_step = samples.target, samples.push_step.numpy()
    pos = target_set.pos_w[chosen].astype(np.float64)
    none, number = np.full(count, "", dtype=object), np.arange(count)
    push, delays = samples.push_vel.numpy(), samples.delays.numpy() * protocol.physics.timestep
    drawn = {name: column.numpy() for name, column in samples.reset._asdict().items()} | {
        "push_vel": push[..., :2].reshape(count, -1),
        "push_vel_z": push[..., 2],
        "push_ang_vel": push[..., 3:].reshape(count, -1),
        "command_delay": delays[:, 0],
        "observation_delay": delays[:, 1],
        "odometry_delay": delays[:, 2],
        "odometry_drift": np.full(count, protocol.randomization.odometry_drift),
        "imu_tilt": samples.imu_tilt.numpy(),
    }
    columns: dict[str, Any] = neutral(count, push_step.shape[1]) | drawn
    return EpisodeManifest(
        **columns,
        replicate=np.zeros(count, np.int64),
        episode=number,
        stratum=np.array([STRATA[k] for k in target_set.stratum[chosen]], dtype=object),
        condition=none,
        orientation=none,
        height=pos[:, 2],
        target_pos_w=pos,
        target_quat_w=target_set.quat_w[chosen].astype(np.float64),
        feasible_qpos=np.full((count, 21), np.nan),
        push_time=np.where(push_step < 0, np.nan, push_step * protocol.control_period),
        noise_key=rng.integers(2**63 - 1, size=count),
        noise_scale=np.ones(count),
    )


def fit(
    dataset: ImitationDataset,
    robot: Robot,
    seed: int,
    init: Actor | None = None,
    updates: int = 3000,
    batch: int = 1024,
    learning_rate: float = 1e-3,
) -> tuple[Actor, float]:
    """Fit a policy to the teacher's actions and their mirror images.

    The loss is a Huber loss of joint angles, that is actions times the action scale: errors beyond
    HUBER_DELTA count linearly, because a teacher's actions in hopeless states are erratic. The newest
    fiftieth of the dataset is held out. The learning rate decays to zero along a cosine.

    Args:
        dataset: Inputs and actions.
        robot: Robot, for the action scale and the mirror images.
        seed: Seed of the initial weights and of the mini-batches.
        init: Policy that is trained further, in place; None for random weights and the dataset's statistics.
        updates: Number of updates.
        batch: Samples per update.
        learning_rate: Initial learning rate.

    Returns:
        The policy, and its root mean square error [rad] on the held-out samples.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    known = len(dataset.inputs) - len(dataset.inputs) // 50
    parts = slice(known, None), slice(known)
    held, kept = (ImitationDataset(*(column[part] for column in dataset)) for part in parts)
    inputs, action = map(torch.from_numpy, kept.with_mirror_images(robot))
    radians = torch.tensor(robot.action_scale, dtype=torch.float32)
    actor = init
    if actor is None:
        actor = Actor(0)
        actor.normalizer.update(inputs)
    optimizer = torch.optim.Adam(actor.mlp.parameters(), learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    for _ in range(updates):
        chosen = torch.randint(len(inputs), (batch,), generator=generator)
        loss = huber_loss(radians * actor(inputs[chosen]), radians * action[chosen], delta=HUBER_DELTA)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        answers = actor(torch.from_numpy(held.inputs))
        error = (radians * (answers - torch.from_numpy(held.action))).square().mean().sqrt()
    return actor.eval(), float(error)


def dagger(
    spec: str,
    protocol: EvalProtocol,
    target_set: TargetSet,
    episodes: int,
    rounds: int,
    seed: int,
    undisturbed_rounds: int = 0,
    updates: int = 3000,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> tuple[Actor, float]:
    """Imitate a controller by DAgger.

    The fraction of episodes in which the student acts grows by a quarter per round, up to
    MAX_STUDENT_FRACTION. After the undisturbed rounds, disturbances grow linearly to the protocol's in the
    last round.

    Args:
        spec: SPEC of the teacher.
        protocol: Protocol of the episodes.
        target_set: Targets that episodes pick from.
        episodes: Number of episodes per round.
        rounds: Number of rounds.
        seed: Seed of all samples and of the initial weights.
        undisturbed_rounds: Number of first rounds without noise, pushes and randomization.
        updates: Number of updates after each round.
        workers: Number of processes; the result does not depend on it.
        progress: Is called with completed and total episodes.

    Returns:
        The policy fitted to the data of all rounds, and its root mean square error [rad] on held-out samples.
    """
    parts: list[ImitationDataset] = []
    robot = load_robot(protocol.robot)
    student, error = None, float("nan")
    for k in range(rounds):

        def told(done: int, _: int, before: int = k * episodes) -> None:
            progress(before + done, rounds * episodes)

        key = seed * rounds + k
        fraction = min(MAX_STUDENT_FRACTION, k / 4)
        scale = max(0.0, (k + 1 - undisturbed_rounds) / (rounds - undisturbed_rounds))
        disturbed = scale_disturbances(protocol, scale)
        parts.append(record(spec, disturbed, target_set, episodes, key, student, fraction, workers, told))
        student, error = fit(ImitationDataset.joined(parts), robot, seed, student, updates)
    assert student is not None
    return student, error
