"""The robot as Pinocchio sees it: kinematics of the soles, the end-effector and the centre of mass."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_bench.robot import JOINT_NAMES, Robot

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # position (3,) [m], rotation (3, 3)
GRAVITY = 9.81  # [m/s^2]
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

    def soles_in_base(self, joints: Array) -> list[Pose]:
        """Sole poses in the base frame at joint positions (14,) [rad]."""
        self._q[7:] = joints
        pin.framesForwardKinematics(self.model, self.data, self._q)
        return [self.pose(sole) for sole in self.soles]

    def arm_in_base(self, joints: Array) -> tuple[Pose, Array]:
        """End-effector pose in the base frame, and its Jacobian (6, 6) by the arm joints, base-aligned."""
        self._q[7:] = joints
        pin.computeJointJacobians(self.model, self.data, self._q)
        pin.updateFramePlacement(self.model, self.data, self.tcp)
        return self.pose(self.tcp), self.jacobian(self.tcp)[:, 14:]

    def leg_in_base(self, joints: Array, side: int) -> tuple[Pose, Array]:
        """Pose of a sole in the base frame, and its Jacobian (6, 4) by the leg's joints, base-aligned."""
        self._q[7:] = joints
        pin.computeJointJacobians(self.model, self.data, self._q)
        pin.updateFramePlacement(self.model, self.data, self.soles[side])
        return self.pose(self.soles[side]), self.jacobian(self.soles[side])[:, 6:][:, leg_of(side)]

    def torques(self, q: Array, base_acceleration: Array, joint_acceleration: Array) -> Array:
        """Joint torques (14,) [N m] that accelerate base (3,) [m/s^2] and joints (14,) from rest at q."""
        rot = pin.Quaternion(q[3:7]).toRotationMatrix()
        acceleration = np.concatenate([rot.T @ base_acceleration, np.zeros(3), joint_acceleration])
        return pin.rnea(self.model, self.data, q, np.zeros(20), acceleration)[6:]

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


def leg_of(side: int) -> slice:
    """The joints of the left (0) or the right (1) leg."""
    return slice(4 * side, 4 * side + 4)


def configuration(pos: Array, rot: Array, joints: Array) -> Array:
    """Pinocchio's q (21,) of a base pose and joint positions (14,)."""
    return np.concatenate([pos, pin.Quaternion(rot).coeffs(), joints])


def turn(rot: Array, target: Array, fraction: float) -> Array:
    """The rotation a fraction of the way from one (3, 3) to another along the geodesic."""
    return rot @ pin.exp3(fraction * pin.log3(rot.T @ target))
