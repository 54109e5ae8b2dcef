"""A cabinet whose door stands open: what the hand is to push shut.

The panel's frame has its origin on the hinge, at the panel's middle height: x into the closed cabinet, at
right angles to the panel; y along the panel towards the hinge; z up. A door with its hinge on the left, seen
from the robot: opening by an angle turns the panel by minus that angle about z.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.static_solver import StaticSolver
from wbc_bench.episodes.targets import classify, solver_of
from wbc_bench.errors import SourceError
from wbc_bench.randomness import stream
from wbc_bench.robot.mjcf import BODY
from wbc_bench.rotations import matrix_from_rpy, wxyz_from_matrix
from wbc_bench.sources.slew import Pose

Array = NDArray[np.float64]

# Choices: the door of a kitchen wall unit.
WIDTH, HEIGHT, THICKNESS, DEPTH = 0.30, 0.40, 0.02, 0.30  # [m]
MASS = 2.0  # [kg] of the panel: chipboard of 830 kg/m^3
DAMPING = 0.5  # [N m s/rad]
FRICTION = 0.2  # [N m]: the door stays where it is left
MAX_ANGLE = 1.75  # [rad] stop of the hinge
CLOSED = 0.05  # [rad] below which a door counts as closed: 1.5 cm at its edge

GRIP = 0.20  # [m] from the hinge to where the hand pushes
STANDOFF = 0.08  # [m] of the hand before it touches; the hand's own start is as far from the panel's plane

# Where doors may stand, about the robot's start. Choice: in reach of the arm or of a lean.
HINGE_X = (0.60, 0.74)  # [m]
HINGE_Y = (0.00, 0.20)  # [m]
CENTRE_Z = (0.95, 1.25)  # [m] of the panel's middle
YAW = (-0.3, 0.3)  # [rad]
ANGLE = (0.35, 0.87)  # [rad] 20 to 50 degrees
MAX_ATTEMPTS = 2000  # one in three is taken
ARC = 5  # angles at which the push must be within reach


class Door(NamedTuple):
    """Where a door stands and how far it is open."""

    x: float  # [m] of the hinge in the world
    y: float  # [m]
    z: float  # [m] of the panel's middle
    yaw: float  # [rad] of the cabinet; zero faces the robot
    angle: float  # [rad] at the start

    def panel(self, angle: float) -> Pose:
        """The panel's frame in the world when the door is open by `angle` [rad]."""
        return Pose(
            np.array([self.x, self.y, self.z]), matrix_from_rpy(np.array([0.0, 0.0, self.yaw - angle]))
        )

    def hand(self, angle: float, standoff: float = 0.0) -> Pose:
        """The hand in the world, at right angles to the panel and `standoff` [m] in front of it."""
        pos, rot = self.panel(angle)
        return Pose(pos + rot @ [-standoff, -GRIP, 0.0], rot)


class DoorScene:
    """The cabinet of a door; its one joint is the hinge, [rad], zero when closed."""

    def __init__(self, door: Door) -> None:
        self.door = door

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """See `Scene`."""
        door = self.door
        solid = {"type": mujoco.mjtGeom.mjGEOM_BOX, "contype": BODY, "conaffinity": BODY}
        cabinet = spec.worldbody.add_body(name="cabinet", pos=[door.x, door.y, door.z], quat=_turn(door.yaw))
        gap = 0.005  # [m] behind the closed panel, so that the hinge's stop and not the cabinet holds it
        cabinet.add_geom(
            name="cabinet",
            size=[DEPTH / 2, WIDTH / 2, HEIGHT / 2],
            pos=[THICKNESS + gap + DEPTH / 2, -WIDTH / 2, 0],
            rgba=[0.86, 0.82, 0.75, 1],
            **solid,
        )
        # built open: the model's reference, where every episode begins, is then the opening angle
        panel = cabinet.add_body(name="door", quat=_turn(-door.angle))
        panel.add_joint(
            name="door",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, -1],
            ref=door.angle,
            range=[0, MAX_ANGLE],
            damping=[DAMPING, 0, 0],
            frictionloss=FRICTION,
        )
        panel.add_geom(
            name="door",
            size=[THICKNESS / 2, WIDTH / 2, HEIGHT / 2],
            pos=[THICKNESS / 2, -WIDTH / 2, 0],
            mass=MASS,
            rgba=[0.62, 0.45, 0.30, 1],
            **solid,
        )
        spec.add_exclude(name="cabinet:door", bodyname1="cabinet", bodyname2="door")


def draw_door(protocol: EvalProtocol, seed: int, episode: int) -> Door:
    """A door whose whole push is within reach of the robot of a protocol, from its default posture.

    Every pose of the hand, from the first touch to the closed door, is of stratum `arm` or `posture`, and the
    hand starts on the side of the panel that it will push.

    Raises: SourceError when none of MAX_ATTEMPTS draws is.
    """
    rng, solver = stream(seed, "door", episode), solver_of(protocol)
    hand_pos_w = _default_hand(solver)
    low, high = np.transpose([HINGE_X, HINGE_Y, CENTRE_Z, YAW, ANGLE])
    for _ in range(MAX_ATTEMPTS):
        door = Door(*rng.uniform(low, high).tolist())
        pos, rot = door.panel(door.angle)
        in_front = -float(rot[:, 0] @ (hand_pos_w - pos))  # [m]
        poses = [door.hand(door.angle, STANDOFF), *map(door.hand, np.linspace(door.angle, 0.0, ARC))]
        if in_front > STANDOFF and all(classify(solver, *pose) is not None for pose in poses):
            return door
    raise SourceError(f"seed {seed}, episode {episode}: none of {MAX_ATTEMPTS} doors is within reach")


def _default_hand(solver: StaticSolver) -> Array:
    """Position (3,) [m] of the hand in the default posture."""
    data = mujoco.MjData(solver.model)
    data.qpos[:] = [0, 0, solver.default_height, 1, 0, 0, 0, *solver.robot.default_q]
    mujoco.mj_kinematics(solver.model, data)
    return data.site("tcp").xpos.copy()


def _turn(yaw: float) -> Array:
    """Quaternion (4,) wxyz of a turn [rad] about the vertical."""
    return wxyz_from_matrix(matrix_from_rpy(np.array([0.0, 0.0, yaw])))
