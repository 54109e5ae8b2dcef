"""Left and right exchanged: the robot is its own mirror image about the plane y = 0 of its base.

Positions and directions change the sign of y, rotation vectors those of x and z, a rotation R becomes M R M
with M = diag(1, -1, 1), and the legs change places. The second column of M R M is that of R with the signs of
x and z changed, like a rotation vector.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_baselines.learned.inputs import COMMAND_LAYOUT, OBSERVATION_LAYOUT, width
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot

POLAR, AXIAL = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)  # signs of x, y, z


class Mirror(NamedTuple):
    """The mirror image of vectors x (..., K) is `x[..., place] * sign`."""

    place: NDArray[np.int64]  # (K,)
    sign: NDArray[np.float32]  # (K,)

    def __call__(self, x: NDArray[np.floating]) -> NDArray[np.float32]:
        return np.asarray(x[..., self.place] * self.sign, dtype=np.float32)


def joint_mirror(robot: Robot) -> Mirror:
    """Of joint angles, velocities and actions (..., 14), by the joints' axes."""
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
    """Of what a policy without context sees, observation and command (..., 67)."""
    joints = joint_mirror(robot)
    same = Mirror(np.arange(1), np.ones(1, np.float32))
    polar, axial = (Mirror(np.arange(3), np.array(signs, np.float32)) for signs in (POLAR, AXIAL))
    pose = (polar, polar, axial)  # position, first and second column
    parts = (axial, polar, joints, joints, joints, *pose, same, *pose)
    sizes = [len(part.place) for part in parts]
    assert sum(sizes) == width(OBSERVATION_LAYOUT) + width(COMMAND_LAYOUT)
    starts = np.cumsum([0, *sizes[:-1]])
    return Mirror(
        np.concatenate([start + part.place for start, part in zip(starts, parts, strict=True)]),
        np.concatenate([part.sign for part in parts]),
    )
