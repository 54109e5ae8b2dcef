"""The robot as Pinocchio sees it: kinematics of the soles, the end-effector and the centre of mass."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_bench.robot import JOINT_NAMES, Robot

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # position (3,) [m], rotation (3, 3)
# parts that can meet: every one of the arm with every one of the body
ARM_LINKS = ("arm_link3", "arm_link5", "arm_link6")
BODY_LINKS = ("base_Link", "hip_L_Link", "knee_L_Link", "hip_R_Link", "knee_R_Link")


class WholeBodyModel:
    """Pinocchio model and data of a robot with a free base; q is (21,): position, quaternion xyzw, joints.

    The world of this class is the *anchor*: the ground frame of the stance feet, x forward, z up.
    """

    def __init__(self, robot: Robot) -> None:
        self.model = pin.buildModelFromXML(robot.urdf(), pin.JointModelFreeFlyer())
        assert tuple(self.model.names)[2:] == JOINT_NAMES
        self.model.armature[6:] = robot.armature  # URDF has no field for it
        self.data = self.model.createData()
        self.tcp = self.model.getFrameId("tcp")
        self.soles = [self.model.getFrameId(f"sole_{side}") for side in "LR"]
        self.mass = pin.computeTotalMass(self.model)
        foot = robot.facts.foot
        self.corners = np.array([(x, y, 0.0) for x in foot.x for y in foot.y])  # (4, 3) in the sole frame [m]
        self._q = pin.neutral(self.model)

    def at(self, joints: Array) -> Array:
        """The configuration (21,) of joint positions (14,) [rad] whose base is at the origin; overwritten."""
        self._q[7:] = joints
        return self._q

    def update(self, q: Array) -> None:
        """Kinematics, Jacobians and centre of mass at q."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        pin.centerOfMass(self.model, self.data, False)

    def com_of(self, q: Array) -> Array:
        """Centre of mass (3,) [m] at q."""
        return pin.centerOfMass(self.model, self.data, q).copy()

    def ee_of(self, q: Array) -> Pose:
        """End-effector pose at q."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return self.pose(self.tcp)

    def gravity_torques(self, q: Array) -> Array:
        """Generalised gravity forces (20,) at q, base rows world-aligned like the Jacobians' columns."""
        return pin.computeGeneralizedGravity(self.model, self.data, q)

    def pose(self, frame: int) -> Pose:
        """Pose of a frame after an update; copies."""
        placement = self.data.oMf[frame]
        return placement.translation.copy(), placement.rotation.copy()

    def jacobian(self, frame: int) -> Array:
        """Jacobian (6, 20), linear over angular, world-aligned, after `update`."""
        return pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)


def configuration(pos: Array, rot: Array, joints: Array) -> Array:
    """Pinocchio's q (21,) of a base pose and joint positions (14,)."""
    return np.concatenate([pos, pin.Quaternion(rot).coeffs(), joints])
