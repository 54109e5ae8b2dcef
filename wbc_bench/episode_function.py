"""A controller of a function that looks at one episode: no batch, no class."""

import inspect
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import (
    COMMAND_PARTS,
    DEPLOYABLE,
    CommandPart,
    ControllerInfo,
    JointCommand,
    Observation,
    Signal,
    Target,
)
from wbc_bench.errors import ControllerError
from wbc_bench.robot import NUM_JOINTS, Robot

T = TypeVar("T", bound=tuple)


def per_episode(
    function: Callable[..., Any] | None = None,
    *,
    signals: Iterable[Signal] = DEPLOYABLE,
    control_period: float = 0.02,
    commands: Iterable[CommandPart] = (),
    name: str = "",
) -> Any:
    """Make a controller of a function of one episode, as a decorator or by a call.

    It is called for every episode that still runs, with arrays that lack the axis of the episodes. A class is
    made anew for each episode, with the robot, and its instances are called: they may remember.

        @per_episode
        def still(robot, obs, target):
            return robot.default_q

    The loop over episodes is in Python: a controller that computes all at once is faster.

    Args:
        function: `function(robot, obs, target)`, or a class whose instances `Class(robot)` are called with
            `(obs, target)`. Either returns joint positions (14,) [rad], or a `JointCommand` without the axis
            of the episodes.
        signals: What it reads; see `ControllerInfo`.
        control_period: [s]
        commands: Parts of commands that it uses beside positions.
        name: Of its rows in tables; the function's when not given.

    Returns:
        A class, to be used as `file.py:still` or handed to `wbc_bench.evaluate`.
    """
    if function is None:
        return lambda found: per_episode(
            found, signals=signals, control_period=control_period, commands=commands, name=name
        )
    info = ControllerInfo(
        name or function.__name__,
        frozenset(signals),
        control_period,
        f"{function.__module__}.{function.__qualname__}",
        commands=frozenset(commands),
    )
    # of the user's module: its sources are those that count
    content = {"info": info, "function": staticmethod(function), "__module__": function.__module__}
    return type(function.__name__, (_PerEpisode,), content)


class _PerEpisode:
    """Calls a function for one episode after the other."""

    info: ControllerInfo
    function: Callable[..., Any]

    def __init__(self, robot: Robot, **options: Any) -> None:
        self._robot, self._options = robot, options

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Start the episodes with these numbers, (N,)."""
        make: Callable[..., Any] = self.function
        robot = self._robot
        if inspect.isclass(make):
            self._calls: list[Callable[..., Any]] = [make(robot, **self._options) for _ in episodes]  # pyright: ignore[reportCallIssue]
        else:
            self._calls = [lambda *seen: make(robot, *seen, **self._options)] * len(episodes)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """The commands of one control step."""
        count = len(obs.active)
        q = np.tile(self._robot.default_q, (count, 1))
        parts: dict[str, NDArray[np.float64]] = {}
        infeasible = np.zeros(count, dtype=bool)
        for row in np.flatnonzero(obs.active):
            found = self._calls[row](_row(obs, row), _row(target, row))
            command = found if isinstance(found, JointCommand) else JointCommand(found)
            q[row] = self._one("positions", command.q, (NUM_JOINTS,))
            infeasible[row] = bool(command.infeasible)
            for part in COMMAND_PARTS:
                given = getattr(command, part)
                if given is not None:
                    shape = np.shape(given) if part == "action" else (NUM_JOINTS,)
                    parts.setdefault(part, self._own(part, count, shape))
                    parts[part][row] = self._one(part, given, parts[part].shape[1:])
        return JointCommand(q, infeasible, **parts)

    def _own(self, part: str, count: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """What a part of a command is where nothing is said: the variant's own gains, and zero."""
        own = getattr(self._robot, part) if part in ("kp", "kd") else np.zeros(shape)
        return np.tile(own, (count, 1))

    def _one(self, what: str, found: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """An array of one episode. Raises: ControllerError, its shape is another or it has none."""
        try:
            array = np.asarray(found, dtype=np.float64)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != shape:
            text = type(found).__name__ if array.ndim < 1 or not array.size else f"shape {array.shape}"
            raise ControllerError(
                f"function '{self.info.name}' returned {what} of {text} for one episode, valid: an array of "
                f"shape {shape}, or a JointCommand of one"
            )
        return array


def _row(part: T, row: int) -> T:
    """One episode of a named tuple of arrays, named tuples and None."""

    def one(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return value[row]
        return _row(value, row) if isinstance(value, tuple) else value

    return type(part)(*map(one, part))
