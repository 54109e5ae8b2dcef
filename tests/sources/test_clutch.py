"""A hand held still, and a stream that is silent, while the robot walks: the target stays where it is."""

from collections.abc import Callable

import numpy as np
import pytest

from robot_states import seen_at
from stream_wire import HAND, PERIOD, QUICK, SEEN, Wire, offset, wire
from wbc_bench.rotations import matrix_from_rpy, wxyz_from_matrix
from wbc_bench.sources import Frame, Seen, from_world
from wbc_bench.sources.adapters import Reading, quest2ros, vuer, xrobotoolkit
from wbc_bench.sources.message import MessageStatus, encode
from wbc_bench.sources.stream_filter import Status

STAMP = 1000


def xr(_: float) -> Reading:
    hand = {"pose": "-0.2,1.1,-0.3,0,0,0,1", "grip": 1.0}
    return xrobotoolkit({"timeStampNs": 0, "Controller": {"right": hand}})


def webxr(time: float) -> Reading:
    columns = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [-0.2, 1.1, -0.3, 1]]
    matrix = [float(x) for column in columns for x in column]
    return vuer({"right": matrix, "rightState": {"squeezeValue": 1.0}}, time)


def quest(_: float) -> Reading:
    position, orientation = {"x": 0.3, "y": 0.2, "z": 1.1}, {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    header = {"stamp": {"secs": STAMP, "nsecs": 0}}
    return quest2ros(
        {"header": header, "pose": {"position": position, "orientation": orientation}}, {"press_middle": 1.0}
    )


def walked(seen: Seen, target_w: np.ndarray) -> Seen:
    """A controller whose base backs away from a target that it finds too near, and turns as it does so."""
    wanted_b = np.array([0.42, 0.0, 0.31])  # [m] where it likes its target
    error_b = seen.base_rot_w.T @ (target_w - seen.base_pos_w) - wanted_b
    forward = seen.base_rot_w @ [error_b[0], error_b[1], 0.0]
    yaw = np.arctan2(seen.base_rot_w[1, 0], seen.base_rot_w[0, 0]) + 0.1 * PERIOD
    base = seen.base_pos_w + 2.0 * PERIOD * forward
    return seen_at(yaw, (base[0], base[1], base[2]))


def led(w: Wire, adapter: Callable[[float], Reading], steps: int) -> tuple[np.ndarray, Seen]:
    """Targets (steps, 3) [m] in the world of a hand that is held still, and where the robot is then."""
    seen, targets = SEEN, []
    for k in range(steps):
        reading = adapter(w.now)
        w.raw(encode(reading.target._replace(time=w.now), 7, k, reading.engaged, relative=True), seen=seen)
        targets.append(w.step(seen=seen)[0])
        seen = walked(seen, targets[-1])
    return np.array(targets), seen


@pytest.mark.parametrize("adapter", [xr, webxr, quest])
def test_a_hand_held_still_keeps_the_target_still_while_the_base_moves(
    adapter: Callable[[float], Reading],
) -> None:
    """Closed loop of 20 s: a target that went with the base would be fled from for ever."""
    w = wire()
    targets, seen = led(w, adapter, 1000)
    assert w.filter.counters["accepted"] == 1000
    assert np.linalg.norm(seen.base_pos_w - SEEN.base_pos_w) > 0.02
    np.testing.assert_allclose(targets, np.tile(HAND, (1000, 1)), atol=1e-9)


def test_motion_counts_along_the_axes_at_engaging() -> None:
    """A base that looks along +y when engaged and along +x later: forward of the hand stays +y."""
    w, before, after = wire(), seen_at(np.pi / 2), seen_at(0.0)
    w.filter.reset(before)
    assert w.send((0.0, 0.0, 0.0), frame="base", relative=True, seen=before) is MessageStatus.ACCEPTED
    start, start_rot = w.step(seen=before)
    w.send((0.1, 0.0, 0.02), rpy=(0.3, 0.0, 0.0), frame="base", relative=True, seen=after)
    pos, rot = w.step(seen=after)
    np.testing.assert_allclose(pos, start + np.array([0.0, 0.1, 0.02]), atol=1e-12)
    about_y = matrix_from_rpy(np.array([0.0, 0.3, 0.0]))  # a roll about forward, which is +y
    np.testing.assert_allclose(rot, about_y @ start_rot, atol=1e-12)


@pytest.mark.parametrize("frame", ["base", "arm_mount"])
@pytest.mark.parametrize("how", ["silence", "clutch"])
def test_a_drifting_robot_does_not_drag_a_target_that_rests(frame: Frame, how: str) -> None:
    w, seen = wire(), SEEN
    pos_b, rot_b = from_world(offset(x=0.1), np.eye(3), frame, SEEN)
    quat = wxyz_from_matrix(rot_b).tolist()
    assert w.send(pos_b, frame=frame, quat_wxyz=quat) is MessageStatus.ACCEPTED
    held, _ = w.step()
    if how == "silence":
        w.step(0.3)
    for k in range(100):
        seen = seen_at(0.002 * k, (-0.005 * k, 0.0, 0.84))
        if how == "clutch":
            w.send(pos_b, frame=frame, quat_wxyz=quat, engaged=False, seen=seen)
        pos, _ = w.step(seen=seen)
        np.testing.assert_allclose(pos, held, atol=1e-9)
    assert w.status is (Status.HOLDING if how == "silence" else Status.DISENGAGED)


def test_the_way_home_ends_where_home_was_when_it_began() -> None:
    w = wire()
    w.send(offset(x=0.1))
    w.step()
    w.step(10.0)
    assert w.status is Status.RETREATING
    way = [w.step(0.1, seen=seen_at(0.0, (-0.02 * k, 0.0, 0.84)))[0] for k in range(200)]
    np.testing.assert_allclose(way[-1], HAND, atol=1e-9)


def test_it_can_stay_for_ever() -> None:
    w = wire(QUICK._replace(retreat_after=np.inf))
    w.send(offset(x=0.1))
    w.step()
    for k in range(100):
        pos, _ = w.step(1.0, seen=seen_at(0.0, (-0.02 * k, 0.0, 0.84)))
        np.testing.assert_allclose(pos, offset(x=0.1), atol=1e-12)
    assert w.status is Status.HOLDING
