"""Left and right exchanged: the robot is its own mirror image about the plane y = 0 of its base.

Positions and directions change the sign of y, rotation vectors those of x and z, a rotation R becomes M R M
with M = diag(1, -1, 1), and the legs change places. The second column of M R M is that of R with the signs of
x and z changed, like a rotation vector.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_baselines.learned.policy.inputs import COMMAND_LAYOUT, OBSERVATION_LAYOUT, PRIVILEGED_LAYOUT, width
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot

POLAR, AXIAL = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)  # signs of x, y, z
SAME = (1.0,)


class Mirror(NamedTuple):
    """The mirror image of vectors x (..., K) is `x[..., place] * sign`."""

    place: NDArray[np.int64]  # (K,)
    sign: NDArray[np.float32]  # (K,)

    def __call__(self, x: NDArray[np.floating]) -> NDArray[np.float32]:
        return np.asarray(x[..., self.place] * self.sign, dtype=np.float32)


def joint_mirror(robot: Robot) -> Mirror:
    """Return the mirror of joint angles, velocities and actions (..., 14), derived from the joint axes."""
    model = robot.model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # at joint angles of zero
    axes = data.xaxis[1:]  # after the free joint
    half = NUM_LEG_JOINTS // 2
    legs, arm = np.roll(np.arange(NUM_LEG_JOINTS), half), np.arange(NUM_LEG_JOINTS, NUM_JOINTS)
    place = np.concatenate([legs, arm])
    sign = np.round((axes[place] * AXIAL * axes).sum(axis=1))
    return Mirror(place, sign.astype(np.float32))


def input_mirror(robot: Robot) -> Mirror:
    """Return the mirror of the inputs of a policy without a context, observation and command (..., 67)."""
    joints, pose = joint_mirror(robot), (POLAR, POLAR, AXIAL)  # position, first and second column
    mirror = _side_by_side(AXIAL, POLAR, joints, joints, joints, *pose, SAME, *pose)
    assert len(mirror.place) == width(OBSERVATION_LAYOUT) + width(COMMAND_LAYOUT)
    return mirror


def privileged_mirror(robot: Robot) -> Mirror:
    """Return the mirror of the privileged vector (..., 107); world-frame entries about the plane y = 0."""
    joints = joint_mirror(robot)
    factors = Mirror(joints.place, np.ones_like(joints.sign))
    feet = Mirror(np.roll(np.arange(6), 3), np.array(2 * POLAR, np.float32))
    mirror = _side_by_side(
        *(POLAR, joints, joints, SAME, POLAR, AXIAL, feet),  # velocity to soles
        *(factors, factors, SAME, SAME, feet),  # gains, mass, friction, forces
        # payload and its place, motor strength, encoders, IMU about x and y, delays, odometry
        *(SAME, POLAR, SAME, joints, AXIAL[:2], 3 * SAME, POLAR),
    )
    assert len(mirror.place) == width(PRIVILEGED_LAYOUT)
    return mirror


def critic_mirror(robot: Robot) -> Mirror:
    """Return the mirror of the critic's inputs without a context (..., 174)."""
    return _side_by_side(input_mirror(robot), privileged_mirror(robot))


def _side_by_side(*parts: Mirror | tuple[float, ...]) -> Mirror:
    """Of vectors whose neighbouring columns have these mirrors, or keep their places and have these signs."""
    mirrors = [
        part if isinstance(part, Mirror) else Mirror(np.arange(len(part)), np.array(part, np.float32))
        for part in parts
    ]
    starts = np.cumsum([0, *(len(mirror.place) for mirror in mirrors)])
    return Mirror(
        np.concatenate([start + m.place for start, m in zip(starts[:-1], mirrors, strict=True)]),
        np.concatenate([m.sign for m in mirrors]),
    )
