"""The quadratic program of `placo_ik`, written out on Pinocchio Jacobians and solved with OSQP."""

import functools
import warnings
from typing import NamedTuple

import numpy as np
import osqp
import pinocchio as pin
import qpsolvers
from numpy.typing import NDArray
from scipy import sparse

from wbc_baselines.ik.clearance import Clearance
from wbc_baselines.ik.config import Weights
from wbc_baselines.ik.model import Pose, WholeBodyModel
from wbc_baselines.ik.stance import half_planes
from wbc_bench.robot import NUM_JOINTS, Robot

Array = NDArray[np.float64]
BASE = 6  # tangent coordinates of the free base, before those of the joints

# Otherwise every solve looks for OSQP's builds on CUDA and MKL first, and takes them where there are any.
osqp.interface.OSQP_ALGEBRA_BACKEND = "builtin"
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
    """Minimise 1/2 dq^T P dq + c^T dq under A dq = b, G dq <= h and bounds on the joints.

    The last S inequalities are soft: they may be exceeded by s, which costs weight / 2 |s|^2.
    """

    p: Array  # (20, 20)
    c: Array  # (20,)
    a: Array  # (10, 20)
    b: Array  # (10,)
    g: Array  # (V + S, 20) of V edges of the polygon and S pairs of bodies
    h: Array  # (V + S,) [m]
    lower: Array  # (14,) [rad]
    upper: Array  # (14,) [rad]
    soft: int  # S
    weight: float


class OsqpIK:
    """One step of differential inverse kinematics over the floating base.

    Stateless between steps, like `PlacoIK`: every solve starts from a step of zero.
    """

    def __init__(self, robot: Robot, weights: Weights, period: float) -> None:
        self._model = WholeBodyModel(robot)
        self._clearance = Clearance(robot, self._model.model, weights.collision_trigger)
        self._base = self._model.model.getFrameId("base_Link")
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
        posture_weight: float,
        limit_speed: bool = True,
    ) -> Array | None:
        """The configuration (21,) one step on, or None when the program has no solution.

        q: (21,) configuration to start from; ee, soles: poses asked for; hull: (V, 2) support polygon,
        counter-clockwise; posture: (14,) joint positions preferred, by a weight. All in the anchor frame.
        """
        program = self.program(q, ee, soles, hull, posture, posture_weight, limit_speed)
        if (program.lower > program.upper).any():  # OSQP takes crossed bounds for a malformed problem
            return None
        dq = solve(program)
        return None if dq is None else pin.integrate(self._model.model, q, dq)

    def program(
        self,
        q: Array,
        ee: Pose,
        soles: list[Pose],
        hull: Array,
        posture: Array,
        posture_weight: float,
        limit_speed: bool = True,
    ) -> Program:
        """The quadratic program of one step; arguments as of `step`.

        Weights act as in PlaCo: a soft task adds weight / 2 |J dq - e|^2.
        Source: Escande, Mansard & Wieber 2014 (least-squares tasks under hard ones).
        """
        weights, model = self._weights, self._model
        model.update(q)
        com_jacobian = pin.jacobianCenterOfMass(model.model, model.data)[:2]
        com_pos = model.data.com[0][:2]
        feet = list(zip(model.soles, soles, strict=True))
        flat = [self.orientation(sole, rot) for sole, (_, rot) in feet]
        soft = [
            (weights.ee_position, self.position(model.tcp, ee[0])),
            (weights.ee_orientation, self.orientation(model.tcp, ee[1])),
            *((weights.foot_flat, turning) for turning in flat),
            (weights.com, Row(com_jacobian, hull.mean(axis=0) - com_pos)),
            (weights.upright, self.orientation(self._base, np.eye(3))),
            (posture_weight, Row(self._select, posture - q[7:])),
            (weights.regularization, Row(self._select, np.zeros(len(posture)))),
        ]
        hard = []  # position and pitch of both feet: see `placo_ik`
        for (sole, (pos, rot)), turning in zip(feet, flat, strict=True):
            axis = rot[:, 1]  # of the ankle
            hard += [self.position(sole, pos), Row(axis[None] @ turning.jacobian, axis[None] @ turning.error)]
        normal, offset = half_planes(hull)
        closing, room = self._clearance.rows(model.data)
        lower, upper = self._lower - q[7:], self._upper - q[7:]
        if limit_speed:
            lower, upper = np.maximum(lower, -self._stride), np.minimum(upper, self._stride)
        jacobian = np.concatenate([np.sqrt(weight) * row.jacobian for weight, row in soft])
        error = np.concatenate([np.sqrt(weight) * row.error for weight, row in soft])
        return Program(
            p=jacobian.T @ jacobian,
            c=-jacobian.T @ error,
            a=np.concatenate([row.jacobian for row in hard]),
            b=np.concatenate([row.error for row in hard]),
            g=np.concatenate([normal @ com_jacobian, closing]),
            h=np.concatenate(
                [offset - weights.com_margin - normal @ com_pos, room - weights.collision_margin]
            ),
            lower=lower,
            upper=upper,
            soft=len(room),
            weight=weights.collision,
        )

    def position(self, frame: int, target: Array) -> Row:
        """Move a frame's origin to (3,) [m], in world axes."""
        return Row(self._model.jacobian(frame)[:3], target - self._model.data.oMf[frame].translation)

    def orientation(self, frame: int, target: Array) -> Row:
        """Turn a frame to a rotation (3, 3); the error is the rotation vector [rad] in world axes."""
        rot = self._model.data.oMf[frame].rotation
        return Row(self._model.jacobian(frame)[3:], pin.log3(target @ rot.T))


def solve(program: Program) -> Array | None:
    """The minimiser (20,), or None when OSQP does not find one."""
    n, soft = len(program.c), program.soft
    joints = np.eye(n)[BASE:]
    p = np.zeros((n + soft, n + soft))
    p[:n, :n] = program.p
    p[range(n, n + soft), range(n, n + soft)] = program.weight
    # the bounds as rows: qpsolvers takes longer to stack them below than OSQP to solve them
    g = np.zeros((len(program.h) + 2 * len(joints), n + soft))
    g[:, :n] = np.concatenate([joints, -joints, program.g])
    g[len(g) - soft :, n:] = -np.eye(soft)  # no s < 0: it would cost more than 0 and gain nothing
    a = np.zeros((len(program.b), n + soft))
    a[:, :n] = program.a
    patterns = _patterns(len(program.b), len(program.h) - soft, soft)
    problem = qpsolvers.Problem(
        P=_csc(p, patterns[0]),
        q=np.concatenate([program.c, np.zeros(soft)]),
        G=_csc(g, patterns[1]),
        h=np.concatenate([program.upper, -program.lower, program.h]),
        A=_csc(a, patterns[2]),
        b=program.b,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # qpsolvers warns of what `found` says already
        solution = qpsolvers.solve_problem(problem, solver="osqp", **OPTIONS)
    return solution.x[:n] if solution.found and solution.x is not None else None


class Pattern(NamedTuple):
    """The entries of a matrix that can differ from zero: SciPy's own search for them takes too long."""

    matrix: sparse.csc_matrix
    transposed: NDArray[np.bool_]


def _csc(dense: Array, pattern: Pattern) -> sparse.csc_matrix:
    matrix = pattern.matrix.copy()
    matrix.data = dense.T[pattern.transposed]
    return matrix


@functools.cache
def _patterns(equalities: int, edges: int, soft: int) -> list[Pattern]:
    """Of the upper triangle of P, of G and of A in `solve`."""
    n = BASE + NUM_JOINTS
    joints = np.eye(n)[BASE:]
    slack = np.zeros((2 * NUM_JOINTS + edges + soft, soft))
    slack[len(slack) - soft :] = np.eye(soft)
    rows = np.concatenate([joints, joints, np.ones((edges + soft, n))])
    p = np.zeros((n + soft, n + soft))
    p[:n, :n] = np.triu(np.ones((n, n)))
    p[n:, n:] = np.eye(soft)
    a = np.concatenate([np.ones((equalities, n)), np.zeros((equalities, soft))], axis=1)
    masks = p, np.concatenate([rows, slack], axis=1), a
    return [Pattern(sparse.csc_matrix(mask), mask.T > 0) for mask in masks]
