"""Controller poses of four public stacks as targets: pure functions, one a message layout.

Each takes the message as the builtins its own decoder gives (JSON, rosbridge) and returns what the sender
held; `message.encode(..., relative=True)` then sends it as the motion of a device, which moves the target in
the world along the axes of the base as it was when the clutch was engaged. Two conventions occur:

- ROS, and ours: x forward, y left, z up. Source: REP 103.
- OpenXR and WebXR: x right, y up, z backward. Source: WebXR Device API, section "Spaces".

A pose is carried over by a change of basis C on both sides, pos' = C pos and rot' = C rot C^T, so that a hand
held level and straight ahead is the identity in both.
"""

import itertools
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import SourceError
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_matrix, wxyz_from_xyzw
from wbc_bench.sources.interface import Frame, StampedTarget, unit
from wbc_bench.sources.slew import Pose, between

Array = NDArray[np.float64]
Side = Literal["left", "right"]
ENGAGED = 0.5  # of the grip's travel; choice

# rows are our axes in those of OpenXR: forward is -z, left is -x, up is y
ROS_FROM_XR = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# columns are the axes of UMI's tool frame (x right, y down, z forward) in the hand's
EE_FROM_UMI_TCP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Reading(NamedTuple):
    """What a device says."""

    target: StampedTarget  # pose of the device, stamped by its own clock
    engaged: bool  # the grip is held: the clutch is in


# ---- vuer --------------------------------------------------------------------------------------------------


class _VuerState(msgspec.Struct):
    squeezeValue: float


Matrix4 = Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]


class _Vuer(msgspec.Struct):
    left: Matrix4 | None = None
    right: Matrix4 | None = None
    leftState: _VuerState | None = None
    rightState: _VuerState | None = None


def vuer(value: Any, time: float, side: Side = "right") -> Reading:
    """`event.value` of vuer's CONTROLLER_MOVE: 16 numbers a hand, a 4x4 transform by columns, WebXR axes.

    The event's value carries no time: `time` [s] is that of receiving. Engaged while the grip is squeezed.
    Source: vuer-ai/vuer@0f4b82a docs/examples/20_motion_controllers.md, "Matrix format".

    Raises: SourceError naming the field.
    """
    event = _convert(value, _Vuer, "vuer")
    matrix, state = getattr(event, side), getattr(event, f"{side}State")
    if matrix is None or state is None:
        raise SourceError(f"vuer message has no '{side}' controller, valid: both {side} and {side}State")
    transform = np.reshape(matrix, (4, 4), order="F")
    rot = transform[:3, :3]
    if not np.allclose(rot @ rot.T, np.eye(3), atol=1e-3) or np.linalg.det(rot) < 0:
        raise SourceError(f"vuer message: $.{side} is not a rotation and a translation")
    return _from_xr(transform[:3, 3], rot, time, state.squeezeValue)


# ---- XRoboToolkit ------------------------------------------------------------------------------------------


class _XRoboHand(msgspec.Struct):
    pose: str
    grip: float


class _XRoboHands(msgspec.Struct):
    left: _XRoboHand | None = None
    right: _XRoboHand | None = None


class _XRobo(msgspec.Struct):
    timeStampNs: int
    Controller: _XRoboHands


def xrobotoolkit(value: Any, side: Side = "right") -> Reading:
    """XRoboToolkit's tracking JSON: pose "x,y,z,qx,qy,qz,qw" a hand, OpenXR axes, time stamp in ns.

    Engaged while the grip is squeezed. Source: XR-Robotics/XRoboToolkit-Unity-Client TrackingData.cs (layout;
    "right-handed, X right, Y up, Z in"). Which way "in" is, its own teleoperation says:
    XRoboToolkit-Teleop-Sample-Python's R_HEADSET_TO_WORLD is `ROS_FROM_XR`.

    Raises: SourceError naming the field.
    """
    tracking = _convert(value, _XRobo, "XRoboToolkit")
    hand = getattr(tracking.Controller, side)
    if hand is None:
        raise SourceError(f"XRoboToolkit message has no $.Controller.{side}")
    try:
        pos, quat = np.split(np.array([float(number) for number in hand.pose.split(",")]), [3])
    except ValueError as error:
        raise SourceError(f"XRoboToolkit message: {error} - at `$.Controller.{side}.pose`") from error
    rot = _matrix(wxyz_from_xyzw(quat), "XRoboToolkit", f"$.Controller.{side}.pose")
    return _from_xr(pos, rot, tracking.timeStampNs * 1e-9, hand.grip)


# ---- Quest2ROS ---------------------------------------------------------------------------------------------


class _Xyz(msgspec.Struct):
    x: float
    y: float
    z: float


class _Xyzw(_Xyz):
    w: float


class _Pose(msgspec.Struct):
    position: _Xyz
    orientation: _Xyzw


class _Stamp(msgspec.Struct):
    secs: int  # ROS 1, as Quest2ROS
    nsecs: int


class _Header(msgspec.Struct):
    stamp: _Stamp


class _PoseStamped(msgspec.Struct):
    header: _Header
    pose: _Pose


class _Inputs(msgspec.Struct):
    press_middle: float


def quest2ros(pose: Any, inputs: Any) -> Reading:
    """PoseStamped of /q2r_*_hand_pose and OVR2ROSInputs of /q2r_*_hand_inputs, as rosbridge gives them.

    The operator lines the controller up with the robot's base and presses both buttons (A+B or X+Y), which
    makes that the frame of what follows: the base frame, ROS axes. Engaged while the middle finger presses.
    Source: Quest2ROS/quest2ros@10c81e7 README.md "Cordinate frame allignment", msg/OVR2ROSInputs.msg@891b264.

    Raises: SourceError naming the field.
    """
    stamped, buttons = (
        _convert(pose, _PoseStamped, "Quest2ROS pose"),
        _convert(inputs, _Inputs, "Quest2ROS inputs"),
    )
    position, orientation, stamp = stamped.pose.position, stamped.pose.orientation, stamped.header.stamp
    quat_xyzw = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    target = _target(
        stamp.secs + stamp.nsecs * 1e-9,
        "base",
        np.array([position.x, position.y, position.z]),
        _matrix(wxyz_from_xyzw(quat_xyzw), "Quest2ROS", "$.pose.orientation"),
    )
    return Reading(target, buttons.press_middle > ENGAGED)


# ---- UMI-on-Legs -------------------------------------------------------------------------------------------


TICKS = 1 << 32  # the counter of milliseconds begins anew after 49.7 days


class _EefState(msgspec.Struct):
    tick: Annotated[int, msgspec.Meta(ge=0, lt=TICKS)]
    eef_pose: Annotated[tuple[float, ...], msgspec.Meta(min_length=7, max_length=7)]


class _EefTraj(msgspec.Struct):
    traj: Annotated[tuple[_EefState, ...], msgspec.Meta(min_length=1)]


def umi_on_legs(value: Any) -> Sequence[StampedTarget]:
    """robot_state/EEFTraj of go2_arx5/eef_traj: frames of x, y, z, qw, qx, qy, qz in the world, tick in ms.

    The pose is that of UMI's tool frame, whose z points forward and y down; ours points x forward and z up.
    The frames are a plan, most of them in the future: `due` says which one to send when. A tick counts from
    when the robot's board was started; times [s] go on rising where it begins anew inside of a plan.
    Source: real-stanford/umi-on-legs@9992f32 real-wbc/ros2/robot_state/msg/EEFState.msg (order),
    real-wbc/modules/wbc_node.py (tcp2ee, tick / 1000).

    Raises: SourceError naming the field.
    """
    frames, time = [], 0.0
    for k, state in enumerate(_convert(value, _EefTraj, "UMI-on-Legs").traj):
        pos, quat = np.split(np.array(state.eef_pose), [3])
        rot = _matrix(quat, "UMI-on-Legs", f"$.traj[{k}].eef_pose") @ EE_FROM_UMI_TCP.T
        before, time = time, state.tick * 1e-3
        if frames and time < before - TICKS * 0.5e-3:
            time += TICKS * 1e-3
        if frames and not time > before:
            raise SourceError(f"UMI-on-Legs message: tick {state.tick} does not rise - at `$.traj[{k}].tick`")
        frames.append(_target(time, "world", pos, rot))
    return frames


def due(frames: Sequence[StampedTarget], time: float) -> StampedTarget:
    """The pose of a plan at `time` [s] of its own clock, on straight lines and geodesics between its frames.

    Before the first frame it is that of the first, after the last that of the last.
    """
    for before, after in itertools.pairwise(frames):
        if before.time <= time < after.time:
            part = (time - before.time) / (after.time - before.time)
            a, b = (Pose(frame.pos, matrix_from_wxyz(frame.quat_wxyz)) for frame in (before, after))
            pos, rot = between(a, b, part)
            return StampedTarget(time, before.frame, pos, wxyz_from_matrix(rot))
    return (frames[0] if time < frames[0].time else frames[-1])._replace(time=time)


# ---- shared ------------------------------------------------------------------------------------------------


def _convert(value: Any, kind: Any, stack: str) -> Any:
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise SourceError(f"{stack} message: {error}") from error


def _matrix(quat_wxyz: Array, stack: str, where: str) -> Array:
    try:
        return matrix_from_wxyz(unit(quat_wxyz))
    except (SourceError, ValueError) as error:
        raise SourceError(f"{stack} message: {error} - at `{where}`") from error


def _from_xr(pos: Array, rot: Array, time: float, grip: float) -> Reading:
    pos, rot = ROS_FROM_XR @ pos, ROS_FROM_XR @ rot @ ROS_FROM_XR.T
    return Reading(_target(time, "base", pos, rot), grip > ENGAGED)


def _target(time: float, frame: Frame, pos: Array, rot: Array) -> StampedTarget:
    if not np.isfinite([time, *pos, *rot.ravel()]).all():
        raise SourceError(f"pose {pos.tolist()} at {time} is not finite")
    return StampedTarget(time, frame, pos, wxyz_from_matrix(rot))
