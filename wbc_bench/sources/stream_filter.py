"""From messages to targets, without a socket: what is refused, the clutch, the speed limit, and silence."""

import enum
import time as clocks
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz, wxyz_from_matrix
from wbc_bench.sources.interface import Frame, Seen, StampedTarget, from_world, to_world
from wbc_bench.sources.message import Message, MessageStatus, decode
from wbc_bench.sources.slew import Limits, Pose, slew


class StreamConfig(NamedTuple):
    """Choices, all of them: slow enough for a person to step in, wide enough for the workspace of the arm."""

    limits: Limits = Limits()  # of the target
    retreat: Limits = Limits(0.1, 0.4)  # [m/s], [rad/s] on the way to the safe pose
    hold_after: float = 0.25  # [s] of silence, until the target stays where it is
    retreat_after: float = 5.0  # [s] of silence, until it goes back to where the hand was at the start
    max_age: float = 0.25  # [s] between sending and receiving
    max_lead: float = 0.05  # [s] a sender's clock may be ahead
    max_distance: float = 1.6  # [m] from the base: legs and arm stretched
    max_jump: float = 0.5  # [m] between a message and the one before it
    max_turn: float = 1.6  # [rad] likewise, a little more than a quarter turn


class Status(enum.StrEnum):
    """What the target is doing."""

    WAITING = "waiting"  # no message yet
    FOLLOWING = "following"
    DISENGAGED = "disengaged"  # the clutch is out
    HOLDING = "holding"  # silence
    RETREATING = "retreating"  # a long silence


class _Goal(NamedTuple):
    frame: Frame
    pose: Pose


class StreamFilter:
    """The latest good message wins. Silence is measured by when messages come, not by what they say of it."""

    def __init__(
        self,
        config: StreamConfig = StreamConfig(),  # noqa: B008  (immutable)
        clock: Callable[[], float] = clocks.monotonic,
        unix_time: Callable[[], float] = clocks.time,
    ) -> None:
        self._s, self._clock, self._unix_time = config, clock, unix_time
        self._counts = dict.fromkeys(MessageStatus, 0)
        self._session: int | None = None
        self._ended: set[int] = set()
        self._sequence = -1
        self._sent = np.nan  # [s] Unix time of the latest message that has not yet been used
        self.latency = (
            np.nan
        )  # [s] from sending to the latest call of `target`; NaN when nothing new had come

    @property
    def counters(self) -> Mapping[str, int]:
        """Messages by what became of them."""
        return {str(status): count for status, count in self._counts.items()}

    def reset(self, seen: Seen) -> None:
        """Begin where the hand is; messages of the past stay refused."""
        self._time = 0.0
        self._now_w = Pose(seen.ee_pos_w, seen.ee_rot_w)
        self._goal = _Goal("world", self._now_w)
        self._safe = _Goal("base", Pose(*from_world(*self._now_w, "base", seen)))
        self.status = Status.WAITING
        self._received = -np.inf
        self._anchor: tuple[_Goal, Pose] | None = (
            None  # target and device at engaging, in the message's frame
        )

    def take(self, parts: list[bytes], seen: Seen) -> MessageStatus:
        """Take in one transmission. Only an accepted one changes anything but the counters."""
        message = decode(parts)
        status = message if isinstance(message, MessageStatus) else self._judge(message, seen)
        self._counts[status] += 1
        return status

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """The target at `time` [s] of the episode."""
        silence = self._clock() - self._received  # [s]
        limits = self._s.limits
        if self.status is not Status.WAITING and silence > self._s.retreat_after:
            self.status, self._goal, self._anchor = Status.RETREATING, self._safe, None
            limits = self._s.retreat
        elif self.status in (Status.FOLLOWING, Status.DISENGAGED) and silence > self._s.hold_after:
            self.status, self._anchor = Status.HOLDING, None
            self._goal = self._stay(self._goal.frame, seen)
        frame, goal = self._goal
        now = slew(Pose(*from_world(*self._now_w, frame, seen)), goal, time - self._time, limits)
        if self.status in (Status.WAITING, Status.DISENGAGED, Status.HOLDING):
            now = goal  # staying is not on the way to anywhere: in a moving frame it moves along
        target = StampedTarget(time, frame, now.pos, wxyz_from_matrix(now.rot))
        self._time, self._now_w = time, Pose(*to_world(target, seen))
        self.latency, self._sent = self._unix_time() - self._sent, np.nan
        return target

    def _judge(self, message: Message, seen: Seen) -> MessageStatus:
        s, age = self._s, self._unix_time() - message.time
        if age > s.max_age:
            return MessageStatus.LATE
        if age < -s.max_lead:
            return MessageStatus.EARLY
        now = self._clock()
        fresh = message.session != self._session
        if message.session in self._ended or (not fresh and message.sequence <= self._sequence):
            return MessageStatus.REPLAYED
        if fresh and now - self._received <= s.hold_after:
            return MessageStatus.OCCUPIED
        goal, anchor = self._aim(message, self._anchor if not fresh else None, seen)
        if message.engaged and self._far(goal, seen):
            return MessageStatus.FAR
        if fresh and self._session is not None:
            self._ended.add(self._session)
        self._session, self._sequence, self._received = message.session, message.sequence, now
        self._goal, self._anchor, self._sent = goal, anchor, message.time
        self.status = Status.FOLLOWING if message.engaged else Status.DISENGAGED
        return MessageStatus.ACCEPTED

    def _aim(self, message: Message, anchor, seen: Seen) -> tuple[_Goal, tuple[_Goal, Pose] | None]:
        """Where a message leads, and what its motion is measured from."""
        target = message.target
        device = Pose(target.pos, matrix_from_wxyz(target.quat_wxyz))
        if not message.engaged:
            return self._stay(target.frame, seen), None
        if not message.relative:
            return _Goal(target.frame, device), None
        if anchor is None or anchor[0].frame != target.frame:
            anchor = self._stay(target.frame, seen), device
        (frame, start), origin = anchor
        moved = Pose(start.pos + (device.pos - origin.pos), device.rot @ origin.rot.T @ start.rot)
        return _Goal(frame, moved), anchor

    def _stay(self, frame: Frame, seen: Seen) -> _Goal:
        return _Goal(frame, Pose(*from_world(*self._now_w, frame, seen)))

    def _far(self, goal: _Goal, seen: Seen) -> bool:
        pos_w, rot_w = self._in_world(goal, seen)
        following = self.status is Status.FOLLOWING
        before = self._in_world(self._goal, seen) if following else self._now_w
        return bool(
            np.linalg.norm(pos_w - seen.base_pos_w) > self._s.max_distance
            or np.linalg.norm(pos_w - before.pos) > self._s.max_jump
            or geodesic_angle(rot_w, before.rot) > self._s.max_turn
        )

    def _in_world(self, goal: _Goal, seen: Seen) -> Pose:
        pose = goal.pose
        return Pose(*to_world(StampedTarget(0.0, goal.frame, pose.pos, wxyz_from_matrix(pose.rot)), seen))
