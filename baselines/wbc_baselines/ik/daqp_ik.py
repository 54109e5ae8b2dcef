"""The whole-body inverse kinematics as one quadratic program, for many episodes at once, solved by DAQP.

The program is that of `placo_ik`. It is written in the frame of the base, where its Jacobians need no
orientation: rows that pull alike in all directions may be turned. Unknown are the motions of the 14 joints
and the twist of the base in its own frame. Source: Escande, Mansard & Wieber 2014 (least-squares tasks under
hard ones); Arnström, Bemporad & Axehill 2022 (DAQP).
"""

import daqp
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.clearance import Clearance, Proximity
from wbc_baselines.ik.config import Weights
from wbc_baselines.ik.geometry import Pose, dot, log3, rotate, skew, transposed
from wbc_baselines.ik.kinematics import Bodies, Configuration, Kinematics
from wbc_baselines.ik.model import WholeBodyModel
from wbc_baselines.ik.rows import Mask
from wbc_baselines.ik.stance import Hull, Stance
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot

Array = NDArray[np.float64]
SIZE = NUM_JOINTS + 6  # unknowns
JOINTS, LINEAR, ANGULAR = slice(0, NUM_JOINTS), slice(NUM_JOINTS, NUM_JOINTS + 3), slice(NUM_JOINTS + 3, SIZE)
CHAINS = slice(NUM_LEG_JOINTS, NUM_JOINTS), slice(0, 4), slice(4, 8)  # joints of hand, left and right sole
PLACES, TURNS, COM = slice(0, 9), slice(9, 18), slice(18, 20)  # rows of the Jacobian, three each for a frame
EQUALITIES = 8
FREE = 1e30  # DAQP's infinity
TOLERANCE = 1e-9  # of a constraint
DAMPING = 1e-8  # PlaCo's, on every unknown: the steps are the same


class DaqpIK:
    """One step of differential inverse kinematics over the floating base, see `BatchIK`."""

    lanes = 32

    def __init__(self, robot: Robot, weights: Weights, period: float) -> None:
        self._kinematics, self._weights = Kinematics(robot), weights
        self._pin = WholeBodyModel(robot)  # for the few that come near
        self._clearance = Clearance(robot, self._pin.model, weights.collision_trigger)
        self._proximity = Proximity(self._kinematics, self._clearance)
        self._lower = robot.lower + weights.joint_margin  # (14,) [rad]
        self._upper = robot.upper - weights.joint_margin
        self._stride = period * weights.speed_fraction * robot.velocity  # (14,) [rad] in one step
        # what no configuration changes: the base carries everything along
        self._jacobian = np.zeros((20, SIZE))
        self._jacobian[PLACES, LINEAR] = self._jacobian[TURNS, ANGULAR] = np.tile(np.eye(3), (3, 1))
        w = weights  # places of the soles are hard
        self._soft = np.repeat([w.ee_position, 0.0, w.ee_orientation, w.foot_flat, w.com], [3, 6, 3, 6, 2])[
            :, None
        ]
        self._diagonal = np.full(SIZE, DAMPING)
        self._diagonal[JOINTS] += w.regularization
        self._diagonal[ANGULAR] += w.upright

    def step(
        self,
        q: Configuration,
        hand: Pose,
        stance: Stance,
        hull: Hull,
        posture: Array,
        posture_weight: Array,
        limit_speed: Mask,
    ) -> tuple[Configuration, Mask]:
        """See `BatchIK.step`."""
        count, w = len(posture), self._weights
        bodies = self._kinematics.at(q.joints)
        near = self._proximity.near(count)
        jacobian = self._jacobians(q, bodies)

        # how far hand and soles are from where they should be, and the base from upright, seen from the base
        back, soles = transposed(q.base.rot)[:, None], stance.rot()
        wanted = np.concatenate([hand.rot[:, None], soles], axis=1)
        wanted = np.concatenate([back @ wanted, back], axis=1)
        turning = wanted.copy()
        turning[:, :3] = wanted[:, :3] @ transposed(bodies.rot)
        turning = log3(turning)  # (N, 4, 3)
        places = np.concatenate([hand.pos[:, None], stance.pos()], axis=1) - q.base.pos[:, None]
        com = q.com(bodies)[:, :2]
        error = np.empty((count, 20))
        error[:, PLACES] = (rotate(back, places) - bodies.pos).reshape(count, 9)
        error[:, TURNS] = turning[:, :3].reshape(count, 9)
        error[:, COM] = hull.centre - com

        # soft tasks, each weight / 2 |J x - e|^2
        weighted = self._soft * jacobian
        hessian, slope = transposed(weighted) @ jacobian, -(error[:, None] @ weighted)[:, 0]
        pull = posture_weight[:, None]
        hessian.reshape(count, -1)[:, :: SIZE + 1] += self._diagonal
        hessian.reshape(count, -1)[:, : SIZE * NUM_JOINTS : SIZE + 1] += pull
        slope[:, JOINTS] -= pull * (posture - q.joints)
        slope[:, ANGULAR] -= w.upright * turning[:, 3]

        # position and pitch of both soles, since legs without an ankle roll give no more; then the polygon
        ankle = wanted[:, 1:3, None, :, 1]  # (N, 2, 1, 3)
        turns = jacobian[:, 12:18].reshape(count, 2, 3, SIZE)
        rows = np.concatenate(
            [jacobian[:, 3:9], (ankle @ turns)[:, :, 0], hull.normal @ jacobian[:, COM]], axis=1
        )
        stride = np.where(limit_speed[:, None], self._stride, FREE)
        pitch = dot(ankle[:, :, 0], turning[:, 1:3])
        room = np.minimum(hull.offset - w.com_margin - rotate(hull.normal, com), FREE)
        lowest = np.maximum(self._lower - q.joints, -stride)
        highest = np.minimum(self._upper - q.joints, stride)
        upper = np.concatenate([highest, error[:, 3:9], pitch, room], axis=1)
        lower = np.concatenate([lowest, error[:, 3:9], pitch, np.full_like(room, -FREE)], axis=1)

        sense = np.zeros(upper.shape[1], dtype=np.intc)
        sense[NUM_JOINTS : NUM_JOINTS + EQUALITIES] = 5  # DAQP's mark of an equality
        step, found = np.zeros((count, SIZE)), np.zeros(count, dtype=bool)
        for i in range(count):
            program = hessian[i], slope[i], rows[i], upper[i], lower[i], sense
            if near[i].any():
                program = self._kept_apart(program, q.joints[i], np.flatnonzero(near[i]))
            x, _, flag, _ = daqp.solve(*program, primal_tol=TOLERANCE)
            if flag > 0:
                step[i], found[i] = x[:SIZE], True
        return Configuration(q.base.moved(step[:, NUM_JOINTS:]), q.joints + step[:, JOINTS]), found

    def _jacobians(self, q: Configuration, bodies: Bodies) -> Array:
        """Of the frames' places and turns in the base and the centre of mass over the ground, (N, 20, 20)."""
        count = len(q.joints)
        jacobian = self._jacobian[None].repeat(count, axis=0)
        for frame, chain in enumerate(CHAINS):
            jacobian[:, 3 * frame : 3 * frame + 3, chain] = transposed(bodies.linear[:, chain])
            jacobian[:, 9 + 3 * frame : 12 + 3 * frame, chain] = transposed(bodies.axis[:, chain])
        jacobian[:, PLACES, ANGULAR] = skew(-bodies.pos).reshape(count, 9, 3)
        level = q.base.rot[:, :2]
        jacobian[:, COM, JOINTS] = level @ transposed(bodies.com_linear)
        jacobian[:, COM, LINEAR] = level
        jacobian[:, COM, ANGULAR] = level @ skew(-bodies.com)
        return jacobian

    def _kept_apart(self, program: tuple, joints: Array, pairs: NDArray[np.int64]) -> tuple:
        """The program of one robot with the pairs that are near: each may come nearer at a cost."""
        model, weights = self._pin, self._weights
        pin.computeJointJacobians(model.model, model.data, model.at(joints))
        closing, room = self._clearance.rows(model.data, pairs)
        if not len(room):
            return program
        hessian, slope, rows, upper, lower, sense = program
        count, more = len(rows), len(room)
        whole = np.zeros((SIZE + more, SIZE + more))
        whole[:SIZE, :SIZE] = hessian
        whole[range(SIZE, SIZE + more), range(SIZE, SIZE + more)] = weights.collision
        stacked = np.zeros((count + more, SIZE + more))
        stacked[:count, :SIZE] = rows
        stacked[count:, JOINTS] = closing[:, 6:]  # a twist of the base moves both
        stacked[range(count, count + more), range(SIZE, SIZE + more)] = -1.0
        return (
            whole,
            np.concatenate([slope, np.zeros(more)]),
            stacked,
            np.concatenate([upper, room - weights.collision_margin]),
            np.concatenate([lower, np.full(more, -FREE)]),
            np.concatenate([sense, np.zeros(more, dtype=np.intc)]),
        )
