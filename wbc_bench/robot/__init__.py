"""The robot: facts in one file, and the MuJoCo model and URDF that are built from it."""

import hashlib
from dataclasses import dataclass
from functools import cache

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.robot.facts import (
    Facts,
    RobotConfig,
    effort_of,
    gain_of,
    load_facts,
    mount_of,
    tcp_of,
    without_sources,
)
from wbc_bench.robot.mjcf import build_model, build_spec
from wbc_bench.robot.scene import Scene
from wbc_bench.robot.urdf import build_urdf

__all__ = [
    "JOINT_NAMES",
    "NUM_JOINTS",
    "NUM_LEG_JOINTS",
    "Facts",
    "Robot",
    "RobotConfig",
    "Scene",
    "build_model",
    "build_spec",
    "build_urdf",
    "load_facts",
    "load_robot",
    "mount_of",
    "tcp_of",
    "without_sources",
]

JOINT_NAMES = tuple(joint.name for joint in load_facts().joints)  # legs L, R from abad to ankle, then J1..J6
NUM_JOINTS = len(JOINT_NAMES)
NUM_LEG_JOINTS = sum(name.endswith("_Joint") for name in JOINT_NAMES)


@dataclass(frozen=True)
class Robot:
    """A configured robot: the joint-space constants that all share, and its two models."""

    facts: Facts
    config: RobotConfig
    default_q: NDArray[np.float64]  # (14,) [rad]
    action_scale: NDArray[np.float64]  # (14,) [rad]
    lower: NDArray[np.float64]  # (14,) [rad]
    upper: NDArray[np.float64]  # (14,) [rad]
    effort: NDArray[np.float64]  # (14,) [N m]
    velocity: NDArray[np.float64]  # (14,) [rad/s]
    kp: NDArray[np.float64]  # (14,) [N m/rad]
    kd: NDArray[np.float64]  # (14,) [N m s/rad]
    armature: NDArray[np.float64]  # (14,) [kg m^2]

    @property
    def digest(self) -> str:
        """SHA-256 over everything the robot is built of, whatever named it; remarks on sources aside."""
        facts = self.facts
        built = [facts.base, facts.nominal_base_height, facts.fixed, facts.foot, facts.friction, facts.frames]
        built += [facts.links, facts.joints, facts.variant.motor, facts.variant.joint_friction]
        built += [mount_of(facts, self.config), tcp_of(facts, self.config)]
        built += [self.default_q.tolist(), self.action_scale.tolist()]
        built += [self.kp.tolist(), self.kd.tolist(), self.effort.tolist()]
        text = msgspec.json.encode(without_sources(msgspec.to_builtins(built)), order="deterministic")
        return hashlib.sha256(text).hexdigest()

    def model(self, timestep: float = 0.002, scene: Scene | None = None) -> mujoco.MjModel:
        """The MuJoCo model, in a scene if one is given."""
        return build_model(self.facts, self.config, timestep, scene)

    def urdf(self) -> str:
        """The URDF text."""
        return build_urdf(self.facts, self.config)

    def action_of(self, q: NDArray[np.float64]) -> NDArray[np.float64]:
        """Normalised actions (..., 14) of joint commands (..., 14) [rad]. Source: paper eq. 1."""
        return (q - self.default_q) / self.action_scale

    def command_of(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Joint commands (..., 14) [rad] of normalised actions (..., 14). Source: paper eq. 1."""
        return self.default_q + self.action_scale * action


@cache
def load_robot(config: RobotConfig = RobotConfig()) -> Robot:  # noqa: B008  (frozen)
    """The robot of a configuration.

    Raises:
        UnknownNameError: a variant, mount or end-effector that the facts do not have.
    """
    facts = load_facts(config.variant)
    mount_of(facts, config)
    tcp_of(facts, config)
    joints = facts.joints
    gains = np.array([gain_of(facts, joint, config) for joint in joints])
    scale = facts.action_scale
    robot = Robot(
        facts=facts,
        config=config,
        default_q=np.array([facts.default_qpos.get(joint.name, 0.0) for joint in joints]),
        action_scale=np.array([scale.leg] * NUM_LEG_JOINTS + list(scale.arm)),
        lower=np.array([joint.range[0] for joint in joints]),
        upper=np.array([joint.range[1] for joint in joints]),
        effort=np.array([effort_of(joint, config) for joint in joints]),
        velocity=np.array([joint.velocity for joint in joints]),
        kp=gains[:, 0],
        kd=gains[:, 1],
        armature=np.array([joint.armature for joint in joints]),
    )
    for value in vars(robot).values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False  # one robot serves every controller of a process
    return robot
