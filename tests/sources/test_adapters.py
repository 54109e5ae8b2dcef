"""Constructed messages of four public stacks; the axes are checked by motions whose meaning is plain."""

import copy

import numpy as np
import pytest

from wbc_bench.errors import SourceError
from wbc_bench.rotations import matrix_from_rpy, matrix_from_wxyz, wxyz_from_matrix, xyzw_from_wxyz
from wbc_bench.sources.adapters import Reading, quest2ros, umi_on_legs, vuer, xrobotoolkit

# a hand 0.3 m ahead, 0.2 m to the left and 1.1 m up, in OpenXR's axes: right, up, backward
XR_POS = [-0.2, 1.1, -0.3]
OUR_POS = [0.3, 0.2, 1.1]


def about(axis: int, angle: float) -> np.ndarray:
    """Rotation about a coordinate axis, written out."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rot = np.eye(3)
    rot[i, i] = rot[j, j] = c
    rot[i, j], rot[j, i] = -s, s
    return rot


# a turn to the left is about up, a nod down about left, a roll to the right about forward
TURNS = [  # (in OpenXR, in ours)
    (about(1, 0.3), matrix_from_rpy(np.array([0.0, 0.0, 0.3]))),
    (about(0, -0.3), matrix_from_rpy(np.array([0.0, 0.3, 0.0]))),
    (about(2, -0.3), matrix_from_rpy(np.array([0.3, 0.0, 0.0]))),
    (np.eye(3), np.eye(3)),
]


def vuer_message(rot: np.ndarray, squeeze: float = 1.0) -> dict:
    """As CONTROLLER_MOVE brings it: 16 numbers by columns."""
    columns = [[*rot[:, 0], 0.0], [*rot[:, 1], 0.0], [*rot[:, 2], 0.0], [*XR_POS, 1.0]]
    state = {"trigger": False, "squeeze": squeeze > 0.5, "triggerValue": 0.0, "squeezeValue": squeeze}
    return {"right": [float(x) for column in columns for x in column], "rightState": state}


def xrobotoolkit_message(rot: np.ndarray, grip: float = 1.0) -> dict:
    quat = xyzw_from_wxyz(wxyz_from_matrix(rot))
    hand = {"axisX": 0.0, "axisY": 0.0, "axisClick": False, "grip": grip, "trigger": 0.0}
    hand["pose"] = ",".join(repr(float(x)) for x in [*XR_POS, *quat])
    return {
        "predictTime": 1.25e9,
        "appState": {"focus": True},
        "Controller": {"left": hand | {"pose": "0,0,0,0,0,0,1"}, "right": hand},
        "timeStampNs": 1_700_000_000_250_000_000,
        "Input": 1,
    }


def quest2ros_message(rot: np.ndarray, press: float = 1.0) -> tuple[dict, dict]:
    quat = xyzw_from_wxyz(wxyz_from_matrix(rot))
    header = {"seq": 3, "stamp": {"secs": 1_700_000_000, "nsecs": 250_000_000}, "frame_id": ""}
    position = dict(zip("xyz", OUR_POS, strict=True))
    orientation = dict(zip("xyzw", map(float, quat), strict=True))
    inputs = {"button_upper": False, "button_lower": False, "press_index": 0.0, "press_middle": press}
    return {"header": header, "pose": {"position": position, "orientation": orientation}}, inputs


def check(reading: Reading, rot: np.ndarray) -> None:
    np.testing.assert_allclose(reading.target.pos, OUR_POS, atol=1e-12)
    np.testing.assert_allclose(matrix_from_wxyz(reading.target.quat_wxyz), rot, atol=1e-9)
    assert reading.target.frame == "base" and reading.engaged


@pytest.mark.parametrize(("xr", "ours"), TURNS, ids=["left", "down", "roll", "none"])
def test_axes(xr: np.ndarray, ours: np.ndarray) -> None:
    check(vuer(vuer_message(xr), time=5.0), ours)
    check(xrobotoolkit(xrobotoolkit_message(xr)), ours)
    check(quest2ros(*quest2ros_message(ours)), ours)


def test_umi_tool_frame() -> None:
    """A tool whose z points forward and y down is a level gripper; scalar-first quaternions, ticks in ms."""
    forward_down = np.array(
        [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    )  # columns: right, down, forward
    frames = [np.eye(3), matrix_from_rpy(np.array([0.2, 0.4, -0.3]))]
    message = {
        "traj": [
            {
                "tick": 1200 + 100 * k,
                "system_time": 9.5,
                "eef_pose": [0.5, -0.1, 0.9 + k, *wxyz_from_matrix(rot @ forward_down).tolist()],
                "gripper_pos": 0.04,
            }
            for k, rot in enumerate(frames)
        ]
    }
    targets = umi_on_legs(message)
    assert [target.time for target in targets] == pytest.approx([1.2, 1.3])
    for k, (target, rot) in enumerate(zip(targets, frames, strict=True)):
        assert target.frame == "world"
        np.testing.assert_allclose(target.pos, [0.5, -0.1, 0.9 + k])
        np.testing.assert_allclose(matrix_from_wxyz(target.quat_wxyz), rot, atol=1e-9)


def test_times_and_clutches() -> None:
    assert vuer(vuer_message(np.eye(3)), time=5.0).target.time == 5.0
    assert xrobotoolkit(xrobotoolkit_message(np.eye(3))).target.time == pytest.approx(1_700_000_000.25)
    assert quest2ros(*quest2ros_message(np.eye(3))).target.time == pytest.approx(1_700_000_000.25)
    assert not vuer(vuer_message(np.eye(3), squeeze=0.1), time=5.0).engaged
    assert not xrobotoolkit(xrobotoolkit_message(np.eye(3), grip=0.1)).engaged
    assert not quest2ros(*quest2ros_message(np.eye(3), press=0.1)).engaged


def changed(message: dict, value: object, *path: str | int) -> dict:
    """A copy with one thing in it replaced."""
    message = copy.deepcopy(message)
    place = message
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value  # pyright: ignore[reportArgumentType]
    return message


def test_what_is_wrong_is_named() -> None:
    good, nan = vuer_message(np.eye(3)), float("nan")
    with pytest.raises(SourceError, match="no 'left' controller"):
        vuer(good, time=0.0, side="left")
    with pytest.raises(SourceError, match=r"\$\.right"):
        vuer(changed(good, good["right"][:15], "right"), time=0.0)
    with pytest.raises(SourceError, match=r"\$\.right is not a rotation"):
        vuer(changed(good, 2.0, "right", 0), time=0.0)
    with pytest.raises(SourceError, match="not finite"):
        vuer(changed(good, nan, "right", 12), time=0.0)
    tracking = xrobotoolkit_message(np.eye(3))
    for pose in ("1,2,3", "a,0,0,0,0,0,1", "0,0,0,0,0,0,2", ""):
        with pytest.raises(SourceError, match=r"\$\.Controller\.right\.pose"):
            xrobotoolkit(changed(tracking, pose, "Controller", "right", "pose"))
    with pytest.raises(SourceError, match=r"\$\.timeStampNs"):
        xrobotoolkit(changed(tracking, "now", "timeStampNs"))
    pose, inputs = quest2ros_message(np.eye(3))
    with pytest.raises(SourceError, match=r"\$\.pose\.orientation"):
        quest2ros(changed(pose, 0.0, "pose", "orientation", "w"), inputs)
    with pytest.raises(SourceError, match=r"press_middle"):
        quest2ros(pose, {})
    frame = {"tick": 1, "eef_pose": [0.0] * 6}
    with pytest.raises(SourceError, match=r"\$\.traj\[0\]\.eef_pose"):
        umi_on_legs({"traj": [frame]})
    with pytest.raises(SourceError, match=r"\$\.traj"):
        umi_on_legs({"traj": []})
    standing = [{"tick": tick, "eef_pose": [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]} for tick in (7, 7)]
    with pytest.raises(SourceError, match=r"tick 7 does not rise - at `\$\.traj\[1\]\.tick`"):
        umi_on_legs({"traj": standing})
    with pytest.raises(SourceError, match=r"\$\.traj\[0\]\.tick"):
        umi_on_legs({"traj": [standing[0] | {"tick": 1 << 32}]})
