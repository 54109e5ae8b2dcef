"""The message of the stream, field by field in STREAM.md, and what makes one unfit whatever was before it."""

import enum
import math
from typing import Annotated, Literal

import msgspec
import numpy as np

from wbc_bench.errors import SourceError
from wbc_bench.sources.interface import Frame, StampedTarget, unit

MAX_BYTES = 1024  # a message has about 150
MAX_TIME = 1e11  # [s] of any clock: the year 5138; today's milliseconds are more
MAX_POSITION = 100.0  # [m] from any origin; far beyond it the motion of a device drowns in rounding
Natural = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class MessageStatus(enum.StrEnum):
    """What became of a message; each has exactly one, so that counts add up to the messages received."""

    ACCEPTED = "accepted"
    MALFORMED = (
        "malformed"  # not this message: undecodable, a field missing, unknown, of a wrong type or range
    )
    NOT_FINITE = "not_finite"  # NaN or infinity in a number
    NOT_UNIT = "not_unit"  # a quaternion of another length than 1
    LATE = "late"  # sent too long ago
    EARLY = "early"  # sent in the future, as far as the sender's clock is known
    CLOCK_UNKNOWN = "clock_unknown"  # sent by another clock, of which too little has been seen yet
    REPLAYED = "replayed"  # a sequence number, or a session, that has been before
    OCCUPIED = "occupied"  # another session is being followed
    FAR = "far"  # too far from the robot, from where the target is, or from the origin


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One target on its way; a map in msgpack."""

    version: Literal[1]
    session: Natural  # drawn at random by a client when it starts
    sequence: Natural  # goes up with every message of a session
    time: float  # [s] of sending, on any clock that all messages of a session share
    frame: Frame
    pos: tuple[float, float, float]  # [m]
    quat_wxyz: tuple[float, float, float, float]  # unit
    engaged: bool = True  # the clutch: the target stays where it is while this is false
    relative: bool = False  # the pose is a device's; its motion moves the target along the axes at engaging

    @property
    def target(self) -> StampedTarget:
        """As every source gives it."""
        return StampedTarget(self.time, self.frame, np.array(self.pos), unit(np.array(self.quat_wxyz)))


_DECODER = msgspec.msgpack.Decoder(Message)


def encode(
    target: StampedTarget, session: int, sequence: int, engaged: bool = True, relative: bool = False
) -> bytes:
    """The bytes of a target; `target.time` is when it is sent, on any clock of the sender."""
    message = Message(
        version=1,
        session=session,
        sequence=sequence,
        time=target.time,
        frame=target.frame,
        pos=(float(target.pos[0]), float(target.pos[1]), float(target.pos[2])),
        quat_wxyz=tuple(map(float, target.quat_wxyz)),  # pyright: ignore[reportArgumentType]
        engaged=engaged,
        relative=relative,
    )
    return msgspec.msgpack.encode(message)


def decode(parts: list[bytes]) -> Message | MessageStatus:
    """The message in the parts of one transmission, or why it is none. Never raises."""
    if len(parts) != 1 or len(parts[0]) > MAX_BYTES:
        return MessageStatus.MALFORMED
    try:
        message = _DECODER.decode(parts[0])
    except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError):
        return MessageStatus.MALFORMED
    if not all(map(math.isfinite, (message.time, *message.pos, *message.quat_wxyz))):
        return MessageStatus.NOT_FINITE
    if not 0 <= message.time <= MAX_TIME:
        return MessageStatus.MALFORMED
    try:
        unit(np.array(message.quat_wxyz))
    except SourceError:
        return MessageStatus.NOT_UNIT
    return MessageStatus.FAR if max(map(abs, message.pos)) > MAX_POSITION else message
