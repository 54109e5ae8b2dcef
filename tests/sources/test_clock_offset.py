"""Senders whose clocks are not this machine's: what is used of them, and what is still refused."""

import numpy as np
import pytest

from stream_wire import HAND, SEEN, Wire, offset, wire
from wbc_bench.rotations import wxyz_from_matrix
from wbc_bench.sources.adapters import EE_FROM_UMI_TCP, due, umi_on_legs, xrobotoolkit
from wbc_bench.sources.clock_offset import ClockOffset
from wbc_bench.sources.message import MessageStatus, encode
from wbc_bench.sources.stream_filter import StreamConfig

PERIOD = 1 / 90  # [s] of a headset
BOOTED = 81.234  # [s] on the clock of a board that was started a minute ago


def sent(w: Wire, shift: float, count: int = 200, delay: float = 0.005) -> dict[str, int]:
    """Counts of a session whose clock is ahead by `shift` [s]."""
    for _ in range(count):
        w.send(time=w.now + shift - delay)
        w.step(PERIOD)
    return {name: n for name, n in w.filter.counters.items() if n}


@pytest.mark.parametrize("shift", [0.0, 0.06, -0.3, 40.0, -40.0, BOOTED - 1000.0, 1.7e9])
def test_a_clock_that_is_another_costs_half_a_second(shift: float) -> None:
    counts = sent(wire(), shift)
    unknown = counts.pop("clock_unknown", 0)
    assert unknown in ((0,) if shift == 0.0 else (45, 46))  # of 90 messages per second
    assert counts == {"accepted": 200 - unknown}


@pytest.mark.parametrize("shift", [0.0, 40.0, -900.0])
def test_messages_that_waited_for_their_reader_are_never_fresh(shift: float) -> None:
    """A client that has sent for 20 s before anybody read, and goes on: what it says of then is refused."""
    w = wire()
    stamps = w.now + shift - 20.0 + 0.01 * np.arange(1970)  # the last of them is 0.3 s old
    found = [w.send(offset(x=0.1), sequence=k, time=t) for k, t in enumerate(stamps.tolist())]
    assert set(found) == {MessageStatus.CLOCK_UNKNOWN}
    for k in range(100):
        status = w.send(sequence=2000 + k, time=w.now + shift)
        known = shift == 0.0 or k > 50
        assert k == 50 or status is (MessageStatus.ACCEPTED if known else MessageStatus.CLOCK_UNKNOWN)
        w.step(0.01)


@pytest.mark.parametrize("pause", [0.0, 0.3])
def test_a_clock_needs_ten_messages_and_half_a_second(pause: float) -> None:
    clock = ClockOffset(max_age=0.25, max_lead=0.05)
    times = np.arange(9) * (0.4 / 8) if pause == 0.0 else np.arange(9) * pause
    assert {clock.judge(t - 30.0, t) for t in times.tolist()} == {"clock_unknown"}
    last = float(times[-1]) + (0.05 if pause == 0.0 else pause)
    assert (clock.judge(last - 30.0, last) is None) == (pause > 0.0)  # the tenth, after 0.45 s or 2.7 s


def test_a_headset_that_is_ahead_moves_the_target() -> None:
    """As its adapter gives it: a clock 0.06 s ahead, a hand that goes 0.2 m forward."""
    w = wire()
    for k in range(200):
        pose = f"0.2,1.1,{-0.3 - 0.001 * k},0,0,0,1"
        hand = {
            "timeStampNs": int((w.now + 0.06) * 1e9),
            "Controller": {"right": {"pose": pose, "grip": 1.0}},
        }
        reading = xrobotoolkit(hand)
        w.raw(encode(reading.target, 7, k, reading.engaged, relative=True))
        w.step(PERIOD)
    used = w.filter.counters["accepted"]
    assert used in (154, 155)  # engaged once its clock was known
    np.testing.assert_allclose(w.step()[0], offset(x=0.001 * (used - 1)), atol=1e-9)


@pytest.mark.parametrize("shift", [0.0, 40.0, -900.0])
def test_what_a_network_held_up_is_late_on_any_clock(shift: float) -> None:
    w = wire()
    sent(w, shift)
    stamps = [w.now + shift + 0.01 * k for k in range(100)]
    w.step(1.0)  # and then all at once; only the youngest are of use
    found = [w.send(offset(x=0.1), time=stamp) for stamp in stamps]
    assert found[:74] == [MessageStatus.LATE] * 74 and found[76:] == [MessageStatus.ACCEPTED] * 24


@pytest.mark.parametrize("shift", [0.0, 40.0])
def test_a_stamp_of_the_future_moves_nothing_and_a_clock_that_is_set_costs_one_message(
    shift: float,
) -> None:
    w = wire()
    sent(w, shift)
    assert w.send(offset(x=0.1), time=w.now + shift + 30.0) is MessageStatus.EARLY
    assert w.send(time=w.now + shift) is MessageStatus.ACCEPTED
    found = [w.send(time=w.now + shift + 30.0) for _ in range(3)]
    assert found == [MessageStatus.EARLY, MessageStatus.ACCEPTED, MessageStatus.ACCEPTED]


def test_clocks_that_run_apart_stay_together() -> None:
    """A quartz that loses 1e-4: after an hour it is 0.36 s behind, more than a message may be late."""
    clock = ClockOffset(max_age=0.25, max_lead=0.05)
    assert all(clock.judge(t - 1e-4 * t, t) is None for t in np.arange(0.0, 3600.0, 0.5).tolist())


def test_another_session_does_not_touch_the_clock_of_the_one_that_is_followed() -> None:
    w = wire()
    sent(w, 40.0)
    for _ in range(5):
        w.send(session=8, time=w.now - 500.0)
    assert w.send(time=w.now + 40.0) is MessageStatus.ACCEPTED
    for _ in range(5):
        w.send(session=9, time=w.now)
    assert w.send(time=w.now + 40.0) is MessageStatus.ACCEPTED
    assert (w.filter.counters["clock_unknown"], w.filter.counters["occupied"]) in ((50, 5), (51, 5))


def test_milliseconds_are_no_seconds() -> None:
    assert wire().send(time=1.7e12) is MessageStatus.MALFORMED
    assert wire().send(time=-1.0) is MessageStatus.MALFORMED


def plan(ticks: list[int]) -> dict:
    """A level hand that rises by 1 cm from frame to frame."""
    quat = wxyz_from_matrix(EE_FROM_UMI_TCP).tolist()
    frames = [offset(z=0.01 * k).tolist() + quat for k in range(len(ticks))]
    return {"traj": [{"tick": t, "eef_pose": pose} for t, pose in zip(ticks, frames, strict=True)]}


def test_a_plan_of_umi_on_legs_is_followed_frame_by_frame() -> None:
    """Ticks of milliseconds since the board was started, frames of the next 1.5 s: none is refused."""
    w, frames = wire(), umi_on_legs(plan([81_234 + 100 * k for k in range(16)]))
    known = sent(w, BOOTED - w.now - 60 * PERIOD, count=60)[
        "accepted"
    ]  # the hand rests until the plan begins
    rise = []
    for k in range(76):
        target = due(frames, BOOTED + 0.02 * k)
        assert w.raw(encode(target, 7, 1000 + k)) is MessageStatus.ACCEPTED
        rise.append(w.step()[0][2] - HAND[2])
    assert w.filter.counters["accepted"] == known + 76
    np.testing.assert_allclose(rise[1:], 0.1 * 0.02 * np.arange(1, 76), atol=1e-9)


def test_a_plan_holds_its_ends_and_outlives_the_counter() -> None:
    frames = umi_on_legs(plan([2**32 - 50, 50]))
    assert frames[1].time - frames[0].time == pytest.approx(0.1)
    np.testing.assert_allclose(due(frames, frames[0].time + 0.05).pos, offset(z=0.005))
    for time, end in ((0.0, frames[0]), (1e10, frames[1])):
        np.testing.assert_array_equal(due(frames, time).pos, end.pos)
        assert due(frames, time).time == time


def test_late_ones_of_a_young_session_are_refused_while_they_disagree() -> None:
    w = wire(StreamConfig())
    found = [w.send(offset(x=0.1), time=w.now - age, seen=SEEN) for age in (30.0, 20.0, 0.0)]
    unknown = MessageStatus.CLOCK_UNKNOWN
    assert found == [unknown, unknown, MessageStatus.ACCEPTED]
