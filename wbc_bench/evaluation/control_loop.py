"""A shard of episodes under one controller, a control step at a time."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from wbc_bench.controller import (
    COMMAND_PARTS,
    Controller,
    JointCommand,
    ProtocolAware,
    Target,
    UsesRandomness,
    signal_of,
)
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import ControllerError
from wbc_bench.evaluation.delays import LateStates, physics_steps
from wbc_bench.evaluation.drives import Drive, action_of, drive_of, equivalent_position
from wbc_bench.evaluation.observation import Sensors
from wbc_bench.evaluation.simulation import Simulation, State
from wbc_bench.isolation import GlobalRandomness, blamed
from wbc_bench.outcomes import Outcome
from wbc_bench.randomness import stream
from wbc_bench.robot import NUM_JOINTS, Scene

RUNNING = ""


class StepResult(NamedTuple):
    """What happened in one control step."""

    stepped: NDArray[np.bool_]  # (N,) episodes that moved, also those that ended by this step
    q: NDArray[np.float64]  # (N, 14) [rad] commands; see `equivalent_position` where they are more than that
    infeasible: NDArray[np.bool_] | None  # (N,) as the controller said
    action: NDArray[np.float64] | None = None  # (N, A) [1] of a command that is more than positions


def at_rate_of(controller: Controller, protocol: EvalProtocol) -> tuple[EvalProtocol, int]:
    """A protocol with the control steps of a faster controller, and how many of them one of its own takes.

    Noise is then drawn at the controller's rate, like that of its sensors.
    """
    own, physics = controller.info.control_period, protocol.physics
    parts = round(protocol.control_period / max(own, 1e-9)) if math.isfinite(own) else 0
    if parts <= 1 or physics.decimation % parts:
        return protocol, 1
    physics = msgspec.structs.replace(physics, decimation=physics.decimation // parts)
    return msgspec.structs.replace(protocol, physics=physics), parts


class ControlLoop:
    """Observe, act, push, step, and end what has fallen.

    `state` and `observation` are the present ones, `odometry` is the state by which a target in the world is
    put into the base frame: of some time ago, where the episodes' odometry is late. For a controller that is
    faster than the protocol, each of the protocol's steps is taken in several `parts`.
    """

    def __init__(
        self,
        controller: Controller,
        protocol: EvalProtocol,
        rows: EpisodeManifest,
        scene: Scene | None = None,
    ) -> None:
        """Raises: ControllerError when the control period is no multiple of the protocol's."""
        every = protocol.control_period  # [s] of the protocol, in whose steps pushes come
        protocol, self.parts = at_rate_of(controller, protocol)
        self.period = period = protocol.control_period  # [s]
        count = len(rows)
        ratio = controller.info.control_period / period
        self._every = round(ratio) if math.isfinite(ratio) else 0  # control steps per call of `act`
        if self._every < 1 or abs(controller.info.control_period - self._every * period) > 1e-9:
            raise ControllerError(
                f"controller '{controller.info.name}' runs every {controller.info.control_period:g} s, "
                f"protocol {protocol.name} asks for {period:g} s, valid: that, a multiple, or a part of it "
                f"in whole physics steps of {protocol.physics.timestep:g} s"
            )
        self._controller, self._protocol, self._rows = controller, protocol, rows
        self._randomness = GlobalRandomness(int(rows.noise_key[0]))
        self._threads = ThreadpoolController()
        self.simulation = Simulation(protocol, rows, scene)
        self.sensors = Sensors(protocol, rows, controller.info.signals)
        self.push_step = np.full(rows.push_time.shape, -1)  # (N, P) the protocol's steps, -1 for none
        planned = np.isfinite(rows.push_time)
        self.push_step[planned] = np.round(rows.push_time[planned] / every)
        parts = (rows.push_vel, 2), (rows.push_vel_z, 1), (rows.push_ang_vel, 3)
        self._push_vel = np.concatenate([part.reshape(count, -1, width) for part, width in parts], axis=2)

        self._declared = controller.info.commands
        self._action_width = 0  # of the controller's own actions, once it gave one
        self.step = 0  # control steps taken
        self.ended = np.full(count, RUNNING, dtype=object)  # (N,) how, or RUNNING
        self.active = np.ones(count, dtype=bool)
        self.state: State = self.simulation.state()
        physics = protocol.physics
        self._late = [
            LateStates[State](physics_steps(delay, physics.timestep), physics.decimation)
            for delay in (rows.observation_delay, rows.odometry_delay)
        ]
        if isinstance(controller, ProtocolAware):
            with self.blamed("prepare"):
                controller.prepare(protocol)
        self._see()

    def run(self) -> Iterator[StepResult]:
        """Step towards the manifest's targets, until all episodes have ended or their time is up.

        Raises: see `advance`.
        """
        target = self.sensors.target(self.odometry)
        self.reset(target)
        for _ in range(self._protocol.num_steps):
            yield self.advance(target)
            if not self.active.any():
                return
            target = self.sensors.target(self.odometry, self.step)

    def target(self, pos_w: NDArray[np.float64], rot_w: NDArray[np.float64]) -> Target:
        """Poses (N, 3) [m], (N, 3, 3) in the world as the odometry of each robot puts them into its base."""
        return self.sensors.in_base(self.odometry, pos_w, rot_w, self.step)

    def reset(self, target: Target) -> None:
        """Tell the controller what it begins with."""
        controller = self._controller
        if isinstance(controller, UsesRandomness):
            with self.blamed("seed"):
                controller.seed(stream(int(self._rows.noise_key[0]), "controller"))
        with self.blamed("reset"):
            controller.reset(self._rows.episode.copy(), self.observation, target)

    def advance(self, target: Target) -> StepResult:
        """One control step towards a target; a controller of a longer period is asked at every n-th of them.

        Raises: ControllerError when the controller fails, or its command has the wrong type or shape, or
            carries what `info.commands` does not declare.
        """
        active = self.active
        if self.step % self._every == 0:
            with self.blamed("act"):
                self._command = self._controller.act(self.observation, target)
        command = self._command
        if not isinstance(command, JointCommand):
            fix = "is a `return` missing?" if command is None else "return JointCommand(q)"
            raise ControllerError(
                f"controller '{self._controller.info.name}' returned {type(command).__name__} from `act`, "
                f"valid: a wbc_bench.controller.JointCommand; {fix}"
            )
        q = self._array("commands", command.q, "iuf", (len(active), NUM_JOINTS))
        infeasible = command.infeasible
        if infeasible is not None:
            infeasible = self._array("`infeasible`", infeasible, "b", (len(active),))
        finite = np.isfinite(q).all(axis=1)
        drive, action, equivalent = None, None, q
        if self._declared or any(getattr(command, part) is not None for part in COMMAND_PARTS):
            drive, action = self._beside_positions(command._replace(q=q))
            for part in (*(drive or ()), action):
                finite &= np.isfinite(part).all(axis=1)
            if drive is not None:
                equivalent = equivalent_position(q, drive)
        self.ended[active & ~finite] = Outcome.INVALID
        active &= finite
        result = StepResult(active.copy(), equivalent, infeasible, action)
        if active.any():
            self._move(q, active, drive)
        return result

    def _beside_positions(self, command: JointCommand) -> tuple[Drive | None, NDArray[np.float64]]:
        """What a command carries beside positions, and its action (N, A).

        Raises: ControllerError, a part is not declared, has the wrong type or shape, or is a negative gain.
        """
        name, declared, parts = self._controller.info.name, self._declared, {}
        for part in COMMAND_PARTS:
            given = getattr(command, part)
            if given is None:
                continue
            if part not in declared:
                raise ControllerError(
                    f"controller '{name}' returned `{part}`, which its info does not declare, valid: "
                    f"ControllerInfo(..., commands=frozenset({{'{part}'}}))"
                )
            width = NUM_JOINTS
            if part == "action":
                width = self._action_width = self._action_width or (np.shape(given) or (1,))[-1]
            parts[part] = found = self._array(f"`{part}`", given, "iuf", (len(command.q), width))
            if part in ("kp", "kd") and (found[self.active] < 0).any():
                low = found[self.active].min()
                raise ControllerError(
                    f"controller '{name}' returned a `{part}` of {low:g} at control step {self.step}, "
                    "valid: 0 or more"
                )
        if "action" in declared and command.action is None:
            raise ControllerError(
                f"controller '{name}' returned no `action`, valid: one with every command, since its "
                "`info.commands` declares it"
            )
        command = command._replace(**parts)
        robot = self.simulation.robot
        if declared == {"action"}:
            return None, command.action  # pyright: ignore[reportReturnType]
        drive = drive_of(command, robot)
        if command.action is None:
            return drive, action_of(command.q, drive, declared, robot)
        return drive, command.action

    @contextmanager
    def blamed(self, method: str) -> Iterator[None]:
        """Where a method of the controller runs; see `isolation.blamed`. Undeclared signals are named.

        Its matrix products take one thread: several may round differently, and wait for each other busily.
        """
        episodes = self._rows.episode
        doing = (
            f"controller '{self._controller.info.name}' failed in `{method}` at control step {self.step} "
            f"of episodes {episodes.min()} to {episodes.max()}"
        )
        try:
            with self._threads.limit(limits=1, user_api="blas"), blamed(doing, self._randomness):
                yield
        except ControllerError as error:
            cause, declared = error.__cause__, self._controller.info.signals
            if isinstance(cause, AttributeError) and cause.obj is None:
                signal = signal_of(cause.name)
                if signal and signal not in declared:
                    asked = ", ".join(f"'{name}'" for name in sorted({*declared, signal}))
                    fix = f"`{cause.name}` is of that signal: declare signals=frozenset({{{asked}}})"
                    raise ControllerError(f"{error}; {fix}") from cause
            raise

    def _array(self, what: str, given: object, kinds: str, shape: tuple[int, ...]) -> NDArray:
        """A part of a command. Raises: ControllerError, its shape or NumPy's kind of its values is wrong."""
        if type(given) is np.ndarray:
            found = given
        else:
            try:
                with self.blamed("act"):  # an object may have its own way to become an array
                    found = np.asarray(given)
            except ControllerError as error:
                raise ControllerError(f"{error}; {what} are no array, expected {shape}") from error
        name, valid = self._controller.info.name, "booleans" if kinds == "b" else "real numbers"
        if found.dtype.kind not in kinds:
            odd = next(iter(found.flat), None)
            raise ControllerError(
                f"controller '{name}' returned {what} of type {found.dtype}, e.g. {ascii(odd)[:80]}, "
                f"at control step {self.step}, valid: {valid}"
            )
        if found.shape != shape:
            raise ControllerError(
                f"controller '{name}' returned {what} of shape {found.shape}, expected {shape}"
            )
        return found

    def _move(self, q: NDArray[np.float64], active: NDArray[np.bool_], drive: Drive | None) -> None:
        pushed = self.push_step * self.parts == self.step
        if pushed.any():
            mask = pushed[..., None] & active[:, None, None]
            self.simulation.push(np.where(mask, self._push_vel, 0.0).sum(axis=1))
        self.state = self.simulation.step(q, active, self._late, drive)
        self.step += 1
        for outcome, where in _terminations(self._protocol, self.state):
            self.ended[active & where] = outcome
            active &= ~where
        if active.any():
            self._see()

    def _see(self) -> None:
        """Take the measurements of the present control step."""
        measured, self.odometry = (
            late.seen() if self.step else late.start(self.state) for late in self._late
        )
        time = self.step * self._protocol.control_period  # [s]
        self.observation = self.sensors.observe(self.step, time, self.state, self.active, measured)


def _terminations(protocol: EvalProtocol, state: State) -> list[tuple[Outcome, NDArray[np.bool_]]]:
    """Ways an episode ends early; the first that holds counts. Source: the paper, made deterministic."""
    limits = protocol.termination
    tilted = state.base_rot_w[:, 2, 2] < limits.min_upright
    low = state.base_pos_w[:, 2] < limits.base_height
    return [
        (Outcome.INVALID, state.diverged),
        (Outcome.ILLEGAL_CONTACT, state.ground_contact & limits.illegal_contact),
        (Outcome.FELL, tilted | low),
    ]
