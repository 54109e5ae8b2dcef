"""Where the joints of N robots put their parts, in the base frame, from MuJoCo's batch API."""

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from wbc_baselines.ik.geometry import Pose, cross, rotate
from wbc_baselines.ik.rows import Rows
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot

Array = NDArray[np.float64]
BASE = 6  # degrees of freedom of the base, which come first in MuJoCo
GRAVITY = 9.81  # [m/s^2]
TCP, SOLES = 0, (1, 2)  # of `Bodies.pos` and `Bodies.rot`
# the frame at the end of each joint's chain: left sole, right sole, hand
_CHAIN = np.repeat([1, 2, 0], [NUM_LEG_JOINTS // 2, NUM_LEG_JOINTS // 2, NUM_JOINTS - NUM_LEG_JOINTS])
_OFF = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
_STAGE = mujoco.mjtStage.mjSTAGE_POS


@dataclass
class Bodies(Rows):
    """Kinematics of N robots in the frames of their bases."""

    pos: Array  # (N, 3, 3) [m] of hand, left and right sole
    rot: Array  # (N, 3, 3, 3)
    axis: Array  # (N, 14, 3) of each joint: angular velocity of the frame at the end of its chain [rad/rad]
    linear: Array  # (N, 14, 3) velocity of that frame [m/rad]
    com: Array  # (N, 3) [m]
    com_linear: Array  # (N, 14, 3) velocity of the centre of mass [m/rad]


@dataclass
class Configuration(Rows):
    """Where N robots are and how they hold themselves."""

    base: Pose  # in the anchor frame
    joints: Array  # (N, 14) [rad]

    def hand(self, bodies: Bodies) -> Pose:
        """The end-effectors in the anchor frame, from the kinematics at these joints."""
        return self.base.at(bodies.pos[:, TCP], bodies.rot[:, TCP])

    def com(self, bodies: Bodies) -> Array:
        """The centres of mass (N, 3) [m] in the anchor frame, from the kinematics at these joints."""
        return self.base.pos + rotate(self.base.rot, bodies.com)


class Kinematics:
    """The model of one robot; its masses are the nominal ones."""

    def __init__(self, robot: Robot) -> None:
        self.model = model = robot.model()
        model.opt.disableflags |= _OFF
        base = model.body(robot.facts.base).id
        self.mass = float(model.body_subtreemass[base])  # [kg]
        self._base, self._links = base, model.jnt_bodyid[1:]
        self._share = model.body_subtreemass[self._links, None] / self.mass  # (14, 1)
        self._sites = [model.site(name).id for name in ("tcp", "sole_L", "sole_R")]
        # where the sparse inertia matrix keeps the entry of two joints of one chain
        self._entry = np.zeros((NUM_JOINTS, NUM_JOINTS), dtype=np.int64)
        for row in range(NUM_JOINTS):
            begin = model.M_rowadr[BASE + row]
            for k in range(begin, begin + model.M_rownnz[BASE + row]):
                if (column := model.M_colind[k] - BASE) >= 0:
                    self._entry[row, column] = self._entry[column, row] = k
        self._grow(1)

    def _grow(self, count: int) -> None:
        """Room for `count` robots, whose bases stay at the origin."""
        self._batch = batch = Batch(self.model, count, nthread=1)
        self._qpos = batch.bind("qpos")
        self._qpos[:, :7] = np.eye(7)[3]
        names = "site_xpos", "site_xmat", "xaxis", "xanchor", "subtree_com", "M", "geom_xpos", "geom_xmat"
        self._bound = [batch.bind(name) for name in names]

    def _forward(self, joints: Array) -> list[Array]:
        count = len(joints)
        if count > len(self._qpos):
            self._grow(count)
        self._qpos[:count, 7:] = joints
        self._batch.forward(np.arange(count), stage=_STAGE)
        return [field[:count] for field in self._bound]

    def at(self, joints: Array) -> Bodies:
        """Kinematics at joint positions (N, 14) [rad]."""
        site_pos, site_rot, axis, anchor, subtree_com, *_ = self._forward(joints)
        pos, axis, anchor = site_pos[:, self._sites], axis[:, 1:].copy(), anchor[:, 1:]
        return Bodies(
            pos=pos,
            rot=site_rot[:, self._sites].reshape(-1, 3, 3, 3),
            axis=axis,
            linear=cross(axis, pos[:, _CHAIN] - anchor),
            com=subtree_com[:, self._base].copy(),
            com_linear=cross(axis, self._share * (subtree_com[:, self._links] - anchor)),
        )

    def shapes(self, count: int, geoms: NDArray[np.int64]) -> tuple[Array, Array]:
        """Centres (N, G, 3) [m] and rotations (N, G, 3, 3) of geoms of the robots of the latest call."""
        pos, rot = self._bound[6], self._bound[7]
        return pos[:count, geoms], rot[:count, geoms].reshape(count, len(geoms), 3, 3)

    def leg_inertia(self, joints: Array, legs: NDArray[np.int64]) -> Array:
        """Inertia (N, 4, 4) [kg m^2] of leg joints (N, 4) among each other at positions (N, 14) [rad]."""
        inertia = self._forward(joints)[5]
        return inertia[np.arange(len(joints))[:, None, None], self._entry[legs[:, :, None], legs[:, None]]]
