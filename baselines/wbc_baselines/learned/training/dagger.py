"""A start for all methods alike: a policy without context that imitates another controller of the bench.

DAgger: the teacher answers in every state, but the student drives in a growing part of the episodes, so that
the states are those a policy meets and not only those a teacher leaves behind. Source: Ross, Gordon, Bagnell
2011, "A reduction of imitation learning and structured prediction to no-regret online learning".
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import huber_loss

from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.controller import LearnedController
from wbc_baselines.learned.policy.estimators import make_estimator
from wbc_baselines.learned.policy.networks import Actor
from wbc_baselines.learned.policy.policy import flow_of
from wbc_baselines.learned.training.resets import draw_starts, weakened
from wbc_baselines.learned.training.symmetry import input_mirror, joint_mirror
from wbc_baselines.learned.training.target_set import TargetPool
from wbc_bench.controller import (
    Controller,
    ControllerInfo,
    JointCommand,
    Observation,
    ProtocolAware,
    Target,
)
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.outcomes import STRATA
from wbc_bench.randomness import stream
from wbc_bench.registry import load_controller
from wbc_bench.robot import NUM_LEG_JOINTS, Robot, load_robot

METHOD = "no_latent"  # the one whose policy has no context
SHARD = 25  # episodes that are recorded together
# Of a leg's normalised action; choice: an answer beyond it is one to a fall, and not to be learned. The arm's
# scales are small (0.2 and 0.3 rad), so that what it needs to reach a target is often 5 and more.
LIMIT = 3.0
MOST = 0.9  # of a round's episodes that the student drives; choice
DELTA = 0.05  # [rad] of the Huber loss; choice

Progress = Callable[[int, int], None]


class Lessons(NamedTuple):
    """What the teacher answered to what a policy sees."""

    seen: NDArray[np.float32]  # (M, 67) observation and command
    action: NDArray[np.float32]  # (M, 14) normalised

    @classmethod
    def joined(cls, parts: "list[Lessons]") -> "Lessons":
        return cls(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def with_mirror_images(self, robot: Robot) -> "Lessons":
        """Twice the lessons: each also with left and right exchanged."""
        images = Lessons(input_mirror(robot)(self.seen), joint_mirror(robot)(self.action))
        return Lessons.joined([self, images])


class _Driver:
    """The engine of the student: drives where it is told to, and leaves the rest to the teacher."""

    flow = flow_of(make_estimator("none"))

    def __init__(self, student: Actor | None, drives: Tensor) -> None:
        self.student, self.drives = student, drives
        self.answer, self.seen = torch.empty(0), torch.empty(0)

    def __call__(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        self.seen = torch.cat([values["observation"], values["command"]], dim=-1)
        action = self.answer
        if self.student:
            action = torch.where(self.drives[:, None], self.student(self.seen), action)
        return {"action": action}


class Pupil:
    """A controller in which teacher and student see the same episodes, and one of them drives each."""

    def __init__(
        self, robot: Robot, protocol: EvalProtocol, teacher: Controller, student: Actor | None, drives: Tensor
    ) -> None:
        self._teacher, self._robot, self._driver = teacher, robot, _Driver(student, drives)
        card = new_card(METHOD, 0, 0, 0.0, protocol)
        self._hands = LearnedController(robot, card, self._driver, "pupil", "")
        signals = teacher.info.signals | self._hands.info.signals
        self.info = ControllerInfo("pupil", signals, protocol.control_period, "wbc_baselines.learned")
        self.lessons: list[Lessons] = []

    def prepare(self, protocol: EvalProtocol) -> None:
        for part in (self._teacher, self._hands):
            if isinstance(part, ProtocolAware):
                part.prepare(protocol)

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        self._teacher.reset(episodes, obs, target)
        self._hands.reset(episodes, obs, target)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        wanted = self._robot.action_of(self._teacher.act(obs, target).q)
        self._driver.answer = torch.from_numpy(wanted.astype(np.float32))
        command = self._hands.act(obs, target)
        sound = obs.active & (np.abs(wanted[:, :NUM_LEG_JOINTS]) < LIMIT).all(axis=1)
        self.lessons.append(Lessons(self._driver.seen.numpy()[sound], wanted[sound].astype(np.float32)))
        return command


def record(
    spec: str,
    protocol: EvalProtocol,
    pool: TargetPool,
    episodes: int,
    seed: int,
    student: Actor | None = None,
    share: float = 0.0,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> Lessons:
    """Lessons of `episodes` episodes, in a part `share` of which the student drives; for any `workers`.

    Targets come from training's pool and draws from streams of training's own, so no evaluation meets them.
    """
    state = student.state_dict() if student else None
    jobs = (
        delayed(_record_shard)(spec, protocol, pool, seed, k, min(SHARD, episodes - first), state, share)
        for k, first in enumerate(range(0, episodes, SHARD))
    )
    parts: list[Lessons] = []
    found: Any = Parallel(n_jobs=workers, return_as="generator")(jobs)
    for part in found:
        parts.append(part)
        progress(min(len(parts) * SHARD, episodes), episodes)
    return Lessons.joined(parts)


def _record_shard(
    spec: str,
    protocol: EvalProtocol,
    pool: TargetPool,
    seed: int,
    number: int,
    count: int,
    student_state: dict | None,
    share: float,
) -> Lessons:
    student = None
    if student_state:
        student = Actor(0)
        student.load_state_dict(student_state)
    rng = stream(seed, "lessons", number)
    robot, rows = load_robot(protocol.robot), draw_rows(protocol, pool, count, rng)
    drives = torch.from_numpy(rng.random(count) < share)
    pupil = Pupil(robot, protocol, load_controller(spec, robot), student, drives)
    for _ in ControlLoop(pupil, protocol, rows).run():
        pass  # the pupil keeps what is wanted
    return Lessons.joined(pupil.lessons)


def draw_rows(
    protocol: EvalProtocol, pool: TargetPool, count: int, rng: np.random.Generator
) -> EpisodeManifest:
    """Training's episodes as rows of a manifest."""
    draws = draw_starts(protocol, pool, count, rng)
    chosen, push_step = draws.target, draws.push_step.numpy()
    pos = pool.pos_w[chosen].astype(np.float64)
    none, number = np.full(count, "", dtype=object), np.arange(count)
    return EpisodeManifest(
        replicate=np.zeros(count, np.int64),
        episode=number,
        stratum=np.array([STRATA[k] for k in pool.stratum[chosen]], dtype=object),
        condition=none,
        orientation=none,
        height=pos[:, 2],
        target_pos_w=pos,
        target_quat_w=pool.quat_w[chosen].astype(np.float64),
        witness_qpos=np.full((count, 21), np.nan),
        **{name: column.numpy() for name, column in draws.start._asdict().items()},
        push_time=np.where(push_step < 0, np.nan, push_step * protocol.control_period),
        push_vel=draws.push_vel.numpy().reshape(count, -1),
        noise_key=rng.integers(2**63 - 1, size=count),
        noise_scale=np.ones(count),
    )


def fit(
    lessons: Lessons,
    robot: Robot,
    seed: int,
    start: Actor | None = None,
    updates: int = 3000,
    batch: int = 1024,
    learning_rate: float = 1e-3,
) -> tuple[Actor, float]:
    """The policy that answers most like the teacher, and its root mean square error [rad] on unseen lessons.

    Every lesson counts with its mirror image. Joints count by the angles asked for, actions times the
    action scale; errors beyond DELTA count linearly, since what a teacher answers to a robot that is lost is
    wild. It goes on from a `start`, in place; without one, from random weights with the lessons' normalisers.
    The newest fiftieth of the lessons is held out. The learning rate falls to zero along a cosine.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    known = len(lessons.seen) - len(lessons.seen) // 50
    held, kept = (Lessons(*(x[part] for x in lessons)) for part in (slice(known, None), slice(known)))
    seen, action = map(torch.from_numpy, kept.with_mirror_images(robot))
    radians = torch.tensor(robot.action_scale, dtype=torch.float32)
    actor = start
    if actor is None:
        actor = Actor(0)
        actor.normalizer.update(seen)
    optimizer = torch.optim.Adam(actor.mlp.parameters(), learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
    for _ in range(updates):
        chosen = torch.randint(len(seen), (batch,), generator=generator)
        loss = huber_loss(radians * actor(seen[chosen]), radians * action[chosen], delta=DELTA)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        answers = actor(torch.from_numpy(held.seen))
        error = (radians * (answers - torch.from_numpy(held.action))).square().mean().sqrt()
    return actor.eval(), float(error)


def imitate(
    spec: str,
    protocol: EvalProtocol,
    pool: TargetPool,
    episodes: int,
    rounds: int,
    seed: int,
    calm: int = 0,
    updates: int = 3000,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> tuple[Actor, float]:
    """DAgger: `rounds` of `episodes` each; the student drives a quarter more of them every round, up to MOST.

    In the first `calm` rounds nothing disturbs the robot; then disturbances rise evenly, to the protocol's in
    the last round.

    Returns the policy fitted to all lessons, and its root mean square error [rad] on the newest fiftieth.
    """
    parts: list[Lessons] = []
    robot = load_robot(protocol.robot)
    student, error = None, float("nan")
    for k in range(rounds):

        def told(done: int, _: int, before: int = k * episodes) -> None:
            progress(before + done, rounds * episodes)

        key = seed * rounds + k
        share, severity = min(MOST, k / 4), max(0.0, (k + 1 - calm) / (rounds - calm))
        disturbed = weakened(protocol, severity)
        parts.append(record(spec, disturbed, pool, episodes, key, student, share, workers, told))
        student, error = fit(Lessons.joined(parts), robot, seed, student, updates)
    assert student is not None
    return student, error
