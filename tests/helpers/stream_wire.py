"""The filter of a stream with clocks of the test's own, and a client of it."""

import dataclasses
from collections.abc import Sequence

import msgspec
import numpy as np

from robot_states import seen_at
from wbc_bench.rotations import matrix_from_rpy, wxyz_from_matrix
from wbc_bench.sources import to_world
from wbc_bench.sources.message import MessageStatus
from wbc_bench.sources.slew import Limits
from wbc_bench.sources.stream_filter import Status, StreamConfig, StreamFilter

PERIOD = 0.02  # [s]
SEEN = seen_at()
HAND = SEEN.ee_pos_w
QUICK = StreamConfig(limits=Limits(1e6, 1e6))  # arrives within a step


@dataclasses.dataclass
class Wire:
    """A filter with clocks that the test sets, and a client that numbers its messages."""

    filter: StreamFilter
    now: float = 1000.0  # [s] of both clocks
    time: float = 0.0  # [s] of the episode
    sequence: int = 0

    def send(
        self, pos: Sequence[float] | np.ndarray = HAND, rpy=(0.0, 0.0, 0.0), seen=SEEN, **fields
    ) -> MessageStatus:
        self.sequence += 1
        return self.raw(msgspec.msgpack.encode(self.message(pos, rpy) | fields), seen=seen)

    def message(self, pos: Sequence[float] | np.ndarray = HAND, rpy=(0.0, 0.0, 0.0)) -> dict:
        quat = wxyz_from_matrix(matrix_from_rpy(np.array(rpy, dtype=float)))
        head = {"version": 1, "session": 7, "sequence": self.sequence, "time": self.now, "frame": "world"}
        return head | {"pos": [float(x) for x in pos], "quat_wxyz": quat.tolist()}

    def raw(self, *parts: bytes, seen=SEEN) -> MessageStatus:
        return self.filter.take(list(parts), seen)

    def step(self, seconds: float = PERIOD, seen=SEEN) -> tuple[np.ndarray, np.ndarray]:
        """Let time pass; the target in the world then."""
        self.now += seconds
        self.time += seconds
        return to_world(self.filter.target(self.time, seen), seen)

    @property
    def status(self) -> Status:
        return self.filter.status


def wire(config: StreamConfig = QUICK) -> Wire:
    made = Wire(StreamFilter(config, lambda: made.now, lambda: made.now))
    made.filter.reset(SEEN)
    return made


def offset(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return HAND + np.array([x, y, z])
