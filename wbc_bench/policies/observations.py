"""Observation groups (N, dim) of a card, with their history."""

from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import Signal
from wbc_bench.errors import ControllerError
from wbc_bench.policies.card import GroupCard, PolicyCard, TermCard
from wbc_bench.policies.terms import TERMS, Seen
from wbc_bench.robot import JOINT_NAMES

Array = NDArray[np.float64]
T = TypeVar("T")


class Column:
    """One term of a group, from what is seen to its numbers."""

    def __init__(self, card: TermCard, policy: PolicyCard, actions: int, where: str) -> None:
        term = TERMS[card.term]
        self.card, self._term = card, term
        names = (card.joints or policy.joints) if term.kind == "joints" else ()
        self.labels = list(names)
        self._columns = [JOINT_NAMES.index(name) for name in names]
        size = len(names) if term.kind == "joints" else term.size
        if card.term == "last_action":
            size = actions
        elif card.term == "gait_phase":
            size = 2 * len(card.phases)
        elif self.follows:
            size = 3
        elif size is None:
            size = len(card.value)
            if not size:
                raise ControllerError(f"{where}: {card.term} has no `value`, valid: at least one number")
        self.size = size
        self._scale, self._offset = (
            numbers(part, size, f"{where}: {card.term}.{name}")
            for name, part in (("scale", card.scale), ("offset", card.offset))
        )

    @property
    def follows(self) -> bool:
        """Whether it is what the card's follower commands."""
        return self.card.term == "velocity_commands" and not self.card.value

    @property
    def signals(self) -> set[Signal]:
        """What it reads."""
        needed = set(self._term.signals)
        if self._term.kind == "pose" and self.card.frame == "world":
            needed.add("base_pose")
        if self.card.frame == "heading" or self.follows:
            needed.add("proprioception")
        return needed

    def compute(self, seen: Seen) -> Array:
        """Its numbers (N, size)."""
        value = self._term.compute(seen, self.card)
        if self._term.kind == "joints":
            value = value[:, self._columns]
        value = value - self._offset
        if self.card.clip is not None:
            value = np.clip(value, *self.card.clip)
        return value * self._scale


class Group:
    """A vector that goes into a network; the frames of its history are kept here."""

    def __init__(self, card: GroupCard, policy: PolicyCard, actions: int, where: str) -> None:
        self.card, self.name = card, card.name
        where = f"{where}: observation '{card.name}'"
        self.columns = [Column(term, policy, actions, where) for term in card.terms]
        self._lengths = [term.history or card.history for term in card.terms]
        self.frame = sum(column.size for column in self.columns)
        self.size = sum(n * column.size for n, column in zip(self._lengths, self.columns, strict=True))
        self._past: list[list[Array]] = []  # frames of each term, the newest first

    def labels(self) -> list[tuple[str, str]]:
        """(term, element) of each number, in the order in which the policy gets them."""
        frames = [
            [self._frame_labels(column, age) for age in range(n)]
            for n, column in zip(self._lengths, self.columns, strict=True)
        ]
        parts = self._ordered(frames)
        return [label for part in parts for label in part]

    def _frame_labels(self, column: Column, age: int) -> list[tuple[str, str]]:
        when = f", {age} before" if age else ""
        names = column.labels or [str(k) for k in range(column.size)]
        return [(f"{column.card.term}{when}", name) for name in names]

    def _ordered(self, frames: list[list[T]]) -> list[T]:
        """Frames of each term, the newest first, in the order in which the policy gets them."""
        if self.card.history_order == "oldest_first":
            frames = [past[::-1] for past in frames]
        if self.card.history_layout == "frame":
            frames = [list(parts) for parts in zip(*frames, strict=True)]
        return [part for parts in frames for part in parts]

    def reset(self) -> None:
        """Forget the frames."""
        self._past = []

    def compute(self, seen: Seen) -> Array:
        """The vector (N, size) of the present step, which becomes the newest frame."""
        newest = [column.compute(seen) for column in self.columns]
        if not self._past:
            zeros = self.card.history_start == "zeros"
            self._past = [
                [value, *[np.zeros_like(value) if zeros else value] * (n - 1)]
                for value, n in zip(newest, self._lengths, strict=True)
            ]
        else:
            self._past = [[value, *past[:-1]] for value, past in zip(newest, self._past, strict=True)]
        return np.concatenate(self._ordered(self._past), axis=1)


def numbers(value: float | Iterable[float], size: int, where: str) -> Array:
    """One number for all or one each, as (size,). Raises: ControllerError, another count."""
    array = np.array(value, dtype=np.float64)
    if array.shape not in ((), (size,)):
        raise ControllerError(f"{where} has {array.size} numbers, valid: 1 or {size}")
    return np.broadcast_to(array, (size,))
