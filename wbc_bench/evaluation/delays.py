"""Late commands and late measurements, in whole physics steps, one delay an episode."""

from collections.abc import Iterable
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=tuple)


def physics_steps(delay: NDArray[np.float64], timestep: float) -> NDArray[np.int64]:
    """Delays (N,) [s] in physics steps of `timestep` [s], rounded to the nearest."""
    return np.round(delay / timestep).astype(np.int64)


class LateCommands:
    """A command given at the start of control step t acts from `delay` physics steps later on."""

    def __init__(self, delay: NDArray[np.int64], decimation: int, rest: NDArray[np.float64]) -> None:
        """`delay` (N,) in physics steps, `decimation` of them per control step, `rest` (J,) before all."""
        self._delay, self._decimation = delay, decimation
        depth = int(delay.max(initial=0)) // decimation + 2
        self._past = np.tile(rest, (depth, len(delay), 1))  # the newest first

    @property
    def offsets(self) -> set[int]:
        """Physics steps after the start of a control step at which some episode's command changes."""
        return set((self._delay % self._decimation).tolist())

    def give(self, command: NDArray[np.float64]) -> None:
        """The commands (N, J) of the control step that starts now."""
        self._past = np.roll(self._past, 1, axis=0)
        self._past[0] = command

    def acting(self, offset: int) -> NDArray[np.float64]:
        """Commands (N, J) that act `offset` physics steps after the start of this control step."""
        age = -((offset - self._delay) // self._decimation)  # control steps since it was given
        return self._past[age, np.arange(len(age))]


class LateStates(Generic[T]):
    """Holds the rows of past states until they are seen, `delay` physics steps after they were true.

    A state is a named tuple of arrays whose first axis are the N episodes.
    """

    def __init__(self, delay: NDArray[np.int64], decimation: int) -> None:
        """`delay` (N,) in physics steps, `decimation` of them per control step."""
        self._decimation = decimation
        self._whole, rest = np.divmod(delay, decimation)
        self._sampled = decimation - rest  # physics steps after the start of a control step
        self._past: list[T] = []  # the newest first; each row sampled at its own time

    @property
    def offsets(self) -> set[int]:
        """Physics steps after the start of a control step at which states must be sampled."""
        return set(self._sampled.tolist())

    def start(self, state: T) -> T:
        """The state in which the episodes begin, which is seen until a later one is."""
        self._past = [state] * (int(self._whole.max(initial=0)) + 1)
        return state

    def begin_step(self) -> None:
        """A control step begins: its sample is the newest from now on."""
        self._past = [self._past[0], *self._past[:-1]]

    def sample(self, offset: int, state: T) -> None:
        """The state `offset` physics steps after the start of this control step."""
        due = self._sampled == offset
        if due.all():
            self._past[0] = state
        elif due.any():
            newest = self._past[0]
            self._past[0] = _with(state, (_where(due, *pair) for pair in zip(state, newest, strict=True)))

    def seen(self) -> T:
        """The state as it is seen now, the last control step having ended."""
        whole = self._whole
        if not whole.any():
            return self._past[0]
        newest, rows = self._past[0], np.arange(len(whole))
        return _with(newest, (np.stack(ages)[whole, rows] for ages in zip(*self._past, strict=True)))


def _with(state: T, columns: Iterable[NDArray]) -> T:
    return type(state)(*columns)  # a named tuple takes its fields one by one


def _where(rows: NDArray[np.bool_], new: NDArray, old: NDArray) -> NDArray:
    return np.where(rows.reshape(-1, *[1] * (new.ndim - 1)), new, old)
