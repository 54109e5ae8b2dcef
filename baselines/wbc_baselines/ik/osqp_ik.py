"""The quadratic program of `placo_ik`, written out on Pinocchio Jacobians and solved with OSQP."""

import warnings
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import qpsolvers
from numpy.typing import NDArray
from scipy import sparse

from wbc_baselines.ik.model import Pose, WholeBodyModel
from wbc_baselines.ik.settings import Weights
from wbc_bench.robot import Robot

Array = NDArray[np.float64]
BASE = 6  # tangent coordinates of the free base, before those of the joints

# Close enough for the active set to be right; polishing then solves it to machine precision. rho adapts by
# iterations, not by the clock, which would make the answer depend on the load of the machine.
OPTIONS = {
    "eps_abs": 1e-6,
    "eps_rel": 1e-6,
    "eps_prim_inf": 1e-6,
    "max_iter": 10_000,
    "polishing": True,
    "adaptive_rho": 1,
    "adaptive_rho_interval": 50,
}


class Row(NamedTuple):
    """A linearised task J dq = e: a step dq that obeys it removes the error to first order."""

    jacobian: Array  # (k, 20)
    error: Array  # (k,) target minus present


class Program(NamedTuple):
    """Minimise 1/2 dq^T P dq + c^T dq under A dq = b, G dq <= h and lower <= dq <= upper."""

    p: Array  # (20, 20)
    c: Array  # (20,)
    a: Array  # (10, 20)
    b: Array  # (10,)
    g: Array  # (V, 20)
    h: Array  # (V,) [m]
    lower: Array  # (20,)
    upper: Array  # (20,)


class OsqpIK:
    """One step of differential inverse kinematics over the floating base.

    Stateless between steps, like `PlacoIK`: every solve starts from a step of zero.
    """

    def __init__(self, robot: Robot, weights: Weights, period: float) -> None:
        self._model = WholeBodyModel(robot)
        self._weights = weights
        self._lower = robot.lower + weights.joint_margin  # (14,) [rad]
        self._upper = robot.upper - weights.joint_margin
        self._stride = period * weights.speed_fraction * robot.velocity  # (14,) [rad] in one step
        self._select = np.eye(self._model.model.nv)[BASE:]  # (14, 20) joints out of a step

    def step(
        self,
        q: Array,
        ee: Pose,
        soles: list[Pose],
        hull: Array,
        posture: Array,
        limit_speed: bool = True,
    ) -> Array | None:
        """The configuration (21,) one step on, or None when the program has no solution.

        q: (21,) configuration to start from; ee, soles: poses asked for; hull: (V, 2) support polygon,
        counter-clockwise; posture: (14,) joint positions preferred. All in the anchor frame.
        """
        program = self.program(q, ee, soles, hull, posture, limit_speed)
        if (program.lower > program.upper).any():  # OSQP takes crossed bounds for a malformed problem
            return None
        dq = solve(program)
        return None if dq is None else pin.integrate(self._model.model, q, dq)

    def program(
        self, q: Array, ee: Pose, soles: list[Pose], hull: Array, posture: Array, limit_speed: bool = True
    ) -> Program:
        """The quadratic program of one step; arguments as of `step`.

        Weights act as in PlaCo: a soft task adds weight / 2 |J dq - e|^2.
        Source: Escande, Mansard & Wieber 2014 (least-squares tasks under hard ones).
        """
        weights, model = self._weights, self._model
        model.update(q)
        com_jacobian = pin.jacobianCenterOfMass(model.model, model.data)[:2]
        com_pos = model.data.com[0][:2]
        left, right = model.soles
        soft = [
            (weights.ee_position, self.position(model.tcp, ee[0])),
            (weights.ee_orientation, self.orientation(model.tcp, ee[1])),
            (weights.foot_flat, self.orientation(right, soles[1][1])),
            (weights.com, Row(com_jacobian, hull.mean(axis=0) - com_pos)),
            (weights.posture, Row(self._select, posture - q[7:])),
            (weights.regularization, Row(self._select, np.zeros(len(posture)))),
        ]
        # Two hard 6-D feet have rank 10 of 12 on these 4-DoF legs: the right one gives up roll and yaw.
        turning = self.orientation(right, soles[1][1])
        axis = soles[1][1][:, 1]  # of the ankle
        hard = [
            self.position(left, soles[0][0]),
            self.orientation(left, soles[0][1]),
            self.position(right, soles[1][0]),
            Row(axis[None] @ turning.jacobian, axis[None] @ turning.error),
        ]
        normal, offset = half_planes(hull)
        lower = np.full(model.model.nv, -np.inf)
        upper = np.full(model.model.nv, np.inf)
        lower[BASE:], upper[BASE:] = self._lower - q[7:], self._upper - q[7:]
        if limit_speed:
            lower[BASE:] = np.maximum(lower[BASE:], -self._stride)
            upper[BASE:] = np.minimum(upper[BASE:], self._stride)
        jacobian = np.concatenate([np.sqrt(weight) * row.jacobian for weight, row in soft])
        error = np.concatenate([np.sqrt(weight) * row.error for weight, row in soft])
        return Program(
            p=jacobian.T @ jacobian,
            c=-jacobian.T @ error,
            a=np.concatenate([row.jacobian for row in hard]),
            b=np.concatenate([row.error for row in hard]),
            g=normal @ com_jacobian,
            h=offset - weights.com_margin - normal @ com_pos,
            lower=lower,
            upper=upper,
        )

    def position(self, frame: int, target: Array) -> Row:
        """Move a frame's origin to (3,) [m], in world axes."""
        return Row(self._model.jacobian(frame)[:3], target - self._model.data.oMf[frame].translation)

    def orientation(self, frame: int, target: Array) -> Row:
        """Turn a frame to a rotation (3, 3); the error is the rotation vector [rad] in world axes."""
        rot = self._model.data.oMf[frame].rotation
        return Row(self._model.jacobian(frame)[3:], pin.log3(target @ rot.T))


def half_planes(hull: Array) -> tuple[Array, Array]:
    """Outward unit normals (V, 2) and offsets (V,) [m] of a counter-clockwise polygon: normal x <= offset."""
    edge = np.roll(hull, -1, axis=0) - hull
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    return normal, (normal * hull).sum(axis=1)


def solve(program: Program) -> Array | None:
    """The minimiser (20,), or None when OSQP does not find one."""
    problem = qpsolvers.Problem(
        P=sparse.csc_matrix(np.triu(program.p)),
        q=program.c,
        G=sparse.csc_matrix(program.g),
        h=program.h,
        A=sparse.csc_matrix(program.a),
        b=program.b,
        lb=program.lower,
        ub=program.upper,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # qpsolvers warns of what `found` says already
        solution = qpsolvers.solve_problem(problem, solver="osqp", **OPTIONS)
    return solution.x if solution.found else None
