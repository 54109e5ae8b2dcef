"""From messages to targets, without a socket: what is refused, the clutch, the speed limit, and silence."""

import enum
import time as clocks
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.rotations import geodesic_angle, matrix_from_wxyz, wxyz_from_matrix
from wbc_bench.sources.clock_offset import ClockOffset
from wbc_bench.sources.interface import Frame, Seen, StampedTarget, frame_pose, from_world, to_world
from wbc_bench.sources.message import Message, MessageStatus, decode
from wbc_bench.sources.slew import Limits, Pose, slew

Array = NDArray[np.float64]


class StreamConfig(NamedTuple):
    """Choices, all of them: slow enough for a person to step in, wide enough for the workspace of the arm."""

    limits: Limits = Limits()  # of the target
    retreat: Limits = Limits(0.1, 0.4)  # [m/s], [rad/s] on the way to the safe pose
    hold_after: float = 0.25  # [s] of silence, until the target stays where it is
    retreat_after: float = 5.0  # [s] of silence, until it goes back to where the hand began; inf: never
    max_age: float = 0.25  # [s] between sending and receiving, beyond that of the quickest message
    max_lead: float = 0.05  # [s] a stamp may be ahead of what is known of the sender's clock
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


class _Anchor(NamedTuple):
    """Where a device was engaged: what its motion is measured from, and the axes along which that counts."""

    frame: Frame  # that the device speaks of
    device: Pose  # in that frame
    axes_w: Array  # (3, 3) of that frame when the device was engaged
    start_w: Pose  # the target's


class StreamFilter:
    """The latest good message wins. Silence is measured by when messages come, not by what they say of it.

    A target that no message moves stays where it is in the world, wherever the robot goes: one that stayed on
    a base that is led by it would be chased for ever.
    """

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
        self._offset = self._new_offset()  # of the session that is followed
        self._stranger: tuple[int, ClockOffset] | None = None  # of the latest other one
        self._sent = np.nan  # [s] stamp of the latest message that has not yet been used
        # [s] from sending to the latest call of `target`, both on one clock; NaN when nothing new had come
        self.latency = np.nan

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
        self._anchor: _Anchor | None = None

    def take(self, parts: list[bytes], seen: Seen) -> MessageStatus:
        """Take in one transmission. Only an accepted one changes more than the counters and the estimate of
        its sender's clock."""
        message = decode(parts)
        status = message if isinstance(message, MessageStatus) else self._judge(message, seen)
        self._counts[status] += 1
        return status

    def target(self, time: float, seen: Seen) -> StampedTarget:
        """The target at `time` [s] of the episode."""
        silence = self._clock() - self._received  # [s]
        limits = self._s.limits
        if self.status is not Status.WAITING and silence > self._s.retreat_after:
            if self.status is not Status.RETREATING:  # to a place in the world, or the robot's drift moves it
                self.status, self._anchor = Status.RETREATING, None
                self._goal = _Goal("world", self._in_world(self._safe, seen))
            limits = self._s.retreat
        elif self.status in (Status.FOLLOWING, Status.DISENGAGED) and silence > self._s.hold_after:
            self.status, self._anchor, self._goal = Status.HOLDING, None, self._stay()
        frame, goal = self._goal
        now = slew(Pose(*from_world(*self._now_w, frame, seen)), goal, time - self._time, limits)
        target = StampedTarget(time, frame, now.pos, wxyz_from_matrix(now.rot))
        self._time, self._now_w = time, Pose(*to_world(target, seen))
        self.latency, self._sent = self._unix_time() - self._sent, np.nan
        return target

    def _judge(self, message: Message, seen: Seen) -> MessageStatus:
        fresh = message.session != self._session
        if message.session in self._ended or (not fresh and message.sequence <= self._sequence):
            return MessageStatus.REPLAYED
        offset = self._offset_of(message.session)
        untimely = offset.judge(message.time, self._unix_time())
        if untimely:
            return MessageStatus(untimely)
        now = self._clock()
        if fresh and now - self._received <= self._s.hold_after:
            return MessageStatus.OCCUPIED
        goal, anchor = self._aim(message, self._anchor if not fresh else None, seen)
        if message.engaged and self._far(goal, seen):
            return MessageStatus.FAR
        if fresh:
            if self._session is not None:
                self._ended.add(self._session)
            self._offset, self._stranger = offset, None
        self._session, self._sequence, self._received = message.session, message.sequence, now
        self._goal, self._anchor, self._sent = goal, anchor, message.time
        self.status = Status.FOLLOWING if message.engaged else Status.DISENGAGED
        return MessageStatus.ACCEPTED

    def _new_offset(self) -> ClockOffset:
        return ClockOffset(self._s.max_age, self._s.max_lead)

    def _offset_of(self, session: int) -> ClockOffset:
        if session == self._session:
            return self._offset
        if self._stranger is None or self._stranger[0] != session:
            self._stranger = session, self._new_offset()
        return self._stranger[1]

    def _aim(self, message: Message, anchor: _Anchor | None, seen: Seen) -> tuple[_Goal, _Anchor | None]:
        """Where a message leads, and what its motion is measured from."""
        target = message.target
        device = Pose(target.pos, matrix_from_wxyz(target.quat_wxyz))
        if not message.engaged:
            return self._stay(), None
        if not message.relative:
            return _Goal(target.frame, device), None
        if anchor is None or anchor.frame != target.frame:
            _, axes_w = frame_pose(target.frame, seen)
            anchor = _Anchor(target.frame, device, axes_w, self._now_w)
        moved_w = anchor.axes_w @ (device.pos - anchor.device.pos)
        turned_w = anchor.axes_w @ device.rot @ anchor.device.rot.T @ anchor.axes_w.T
        start = anchor.start_w
        return _Goal("world", Pose(start.pos + moved_w, turned_w @ start.rot)), anchor

    def _stay(self) -> _Goal:
        return _Goal("world", self._now_w)

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
