"""The robot as Pinocchio sees it: kinematics of the soles, the end-effector and the centre of mass."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from wbc_bench.robot import JOINT_NAMES, Robot

Array = NDArray[np.float64]
GRAVITY = 9.81  # [m/s^2]
SIDES = ("L", "R")


class WholeBodyModel:
    """Pinocchio model and data of a robot with a free base; q is (21,): position, quaternion xyzw, joints.

    The world of this class is the *anchor*: the ground frame of the stance feet, x forward, z up.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.model = pin.buildModelFromXML(robot.urdf(), pin.JointModelFreeFlyer())
        assert tuple(self.model.names)[2:] == JOINT_NAMES
        self.model.armature[6:] = robot.armature  # URDF has no field for it
        self.data = self.model.createData()
        self.tcp = self.model.getFrameId("tcp")
        self.soles = [self.model.getFrameId(f"sole_{side}") for side in SIDES]
        self.mass = pin.computeTotalMass(self.model)
        foot = robot.facts.foot
        self.corners = np.array([(x, y, 0.0) for x in foot.x for y in foot.y])  # in the sole frame [m]

    def update(self, q: Array) -> None:
        """Kinematics, Jacobians and centre of mass at q."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        pin.jacobianCenterOfMass(self.model, self.data, False)

    def pose(self, frame: int) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) of a frame after `update`; copies."""
        placement = self.data.oMf[frame]
        return placement.translation.copy(), placement.rotation.copy()

    def jacobian(self, frame: int) -> Array:
        """Jacobian (6, 20), linear over angular, world-aligned, after `update`."""
        return pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)
