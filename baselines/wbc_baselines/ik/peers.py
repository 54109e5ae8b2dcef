"""Pink and mink on the program of `placo_ik`, to be timed beside it.

Both ship neither a support polygon nor a foot constraint without roll and yaw, which are added here through
their public interfaces, as a limit and a task. What keeps arm and body apart is soft in `placo_ik` and hard
in these two, whose limits have no slack.
"""

from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin
import qpsolvers
from numpy.typing import NDArray

from wbc_baselines.ik.clearance import Clearance
from wbc_baselines.ik.config import Weights
from wbc_baselines.ik.controller import PERIOD
from wbc_baselines.ik.model import ARM_LINKS, BODY_LINKS, Pose, WholeBodyModel
from wbc_baselines.ik.stance import half_planes
from wbc_bench.robot import JOINT_NAMES, Robot
from wbc_bench.rotations import wxyz_from_matrix

Array = NDArray[np.float64]
POSITION_AND_PITCH = [0, 1, 2, 4]  # of a foot's twist in its own frame
QP_SOLVERS = ("daqp", "quadprog", "proxqp", "osqp")  # for Pink and mink: the fastest here first


class BenchProblem(NamedTuple):
    """What stays the same in all steps: the robot stands in its default posture on flat ground."""

    robot: Robot
    weights: Weights
    q: Array  # (21,) to start from, in Pinocchio's order
    soles: list[Pose]
    hull: Array  # (V, 2) [m]


class Solver(Protocol):
    """A package under test; its configurations q are in its own order."""

    package: str
    qp: str

    def start(self, q: Array) -> Array:
        """Its configuration of Pinocchio's."""
        ...

    def step(self, q: Array, ee: Pose) -> Array | None:
        """One step, all of which is timed: kinematics at q, targets, program, solution, integration."""
        ...

    def to_pinocchio(self, q: Array) -> Array:
        """The inverse of `start`."""
        ...


def make_pink(problem: BenchProblem) -> Solver:
    """Raises: ImportError: Pink is not installed."""
    import pink  # pyright: ignore[reportMissingImports]
    from pink.limits import ConfigurationLimit, Limit, VelocityLimit  # pyright: ignore[reportMissingImports]
    from pink.tasks import ComTask, FrameTask, PostureTask  # pyright: ignore[reportMissingImports]

    robot, weights = problem.robot, problem.weights
    model = WholeBodyModel(robot).model
    model.lowerPositionLimit[7:] = robot.lower + weights.joint_margin
    model.upperPositionLimit[7:] = robot.upper - weights.joint_margin
    model.velocityLimit[:6] = np.inf
    model.velocityLimit[6:] = weights.speed_fraction * robot.velocity
    normal, offset = half_planes(problem.hull)
    clearance = Clearance(robot, model, weights.collision_trigger)

    class PositionPitchTask(FrameTask):
        def compute_error(self, configuration):
            return super().compute_error(configuration)[POSITION_AND_PITCH]

        def compute_jacobian(self, configuration):
            return super().compute_jacobian(configuration)[POSITION_AND_PITCH]

    class PolygonLimit(Limit):
        def compute_qp_inequalities(self, configuration, dt):
            jacobian = pin.jacobianCenterOfMass(configuration.model, configuration.data)[:2]
            room = offset - weights.com_margin - normal @ configuration.data.com[0][:2]
            return normal @ jacobian, room

    class ClearanceLimit(Limit):
        def compute_qp_inequalities(self, configuration, dt):
            closing, distance = clearance.rows(configuration.data)
            return (closing, distance - weights.collision_margin) if len(distance) else None

    class Pink:
        package, qp = "pin-pink", _qp_solver()

        def __init__(self) -> None:
            self._configuration = pink.Configuration(model, model.createData(), problem.q)
            self._ee = FrameTask("tcp", np.sqrt(weights.ee_position), np.sqrt(weights.ee_orientation))
            left, right = FrameTask("sole_L", 1.0, 1.0), PositionPitchTask("sole_R", 1.0, 1.0)
            flat = FrameTask("sole_R", 0.0, np.sqrt(weights.foot_flat))
            upright = FrameTask("base_Link", 0.0, np.sqrt(weights.upright))
            upright.set_target(pin.SE3.Identity())
            com = ComTask(np.sqrt(weights.com) * np.array([1.0, 1.0, 0.0]))
            posture = PostureTask(float(np.sqrt(weights.planning_posture)))
            for task, (pos, rot) in zip((left, right, flat), [*problem.soles, problem.soles[1]], strict=True):
                task.set_target(pin.SE3(rot, pos))
            com.set_target(np.array([*problem.hull.mean(axis=0), 0.0]))
            posture.set_target(problem.q)
            self._tasks, self._hard = [self._ee, flat, upright, com, posture], [left, right]
            self._limits = [
                ConfigurationLimit(model, 1.0),
                VelocityLimit(model),
                PolygonLimit(),
                ClearanceLimit(),
            ]

        def start(self, q: Array) -> Array:
            return q

        to_pinocchio = start

        def step(self, q: Array, ee: Pose) -> Array | None:
            self._configuration.update(q)
            self._ee.set_target(pin.SE3(ee[1], ee[0]))
            try:
                velocity = pink.solve_ik(
                    self._configuration,
                    self._tasks,
                    PERIOD,
                    self.qp,
                    damping=weights.regularization,
                    limits=self._limits,
                    constraints=self._hard,
                    safety_break=False,
                )
            except pink.exceptions.NoSolutionFound:
                return None
            return self._configuration.integrate(velocity, PERIOD)

    return Pink()


def make_mink(problem: BenchProblem) -> Solver:
    """Raises: ImportError: mink is not installed."""
    import mink  # pyright: ignore[reportMissingImports]
    import mujoco

    robot, weights = problem.robot, problem.weights
    model = robot.model()
    normal, offset = half_planes(problem.hull)

    class PositionPitchTask(mink.FrameTask):
        def compute_error(self, configuration):
            return super().compute_error(configuration)[POSITION_AND_PITCH]

        def compute_jacobian(self, configuration):
            return super().compute_jacobian(configuration)[POSITION_AND_PITCH]

    class PolygonLimit(mink.Limit):
        def compute_qp_inequalities(self, configuration, dt):
            jacobian = np.empty((3, model.nv))
            mujoco.mj_jacSubtreeCom(model, configuration.data, jacobian, 1)
            room = offset - weights.com_margin - normal @ configuration.data.subtree_com[1][:2]
            return mink.Constraint(normal @ jacobian[:2], room)

    class Mink:
        package, qp = "mink", _qp_solver()

        def __init__(self) -> None:
            self._configuration = mink.Configuration(model)
            costs = np.sqrt(weights.ee_position), np.sqrt(weights.ee_orientation)
            self._ee = mink.FrameTask("tcp", "site", *costs)
            left = mink.FrameTask("sole_L", "site", 1.0, 1.0)
            right = PositionPitchTask("sole_R", "site", 1.0, 1.0)
            flat = mink.FrameTask("sole_R", "site", 0.0, np.sqrt(weights.foot_flat))
            upright = mink.FrameTask("base_Link", "body", 0.0, np.sqrt(weights.upright))
            upright.set_target(mink.SE3.identity())
            com = mink.ComTask(np.sqrt(weights.com) * np.array([1.0, 1.0, 0.0]))
            posture = mink.PostureTask(model, float(np.sqrt(weights.planning_posture)))
            for task, pose in zip((left, right, flat), [*problem.soles, problem.soles[1]], strict=True):
                task.set_target(_se3(pose))
            com.set_target(np.array([*problem.hull.mean(axis=0), 0.0]))
            posture.set_target(self.start(problem.q))
            self._tasks, self._hard = [self._ee, flat, upright, com, posture], [left, right]
            speed = weights.speed_fraction * robot.velocity
            self._limits = [
                mink.ConfigurationLimit(model, 1.0, weights.joint_margin),
                mink.VelocityLimit(model, dict(zip(JOINT_NAMES, speed, strict=True))),
                PolygonLimit(),
                mink.CollisionAvoidanceLimit(
                    model,
                    [(_geoms(ARM_LINKS), _geoms(BODY_LINKS))],
                    gain=1.0,
                    minimum_distance_from_collisions=weights.collision_margin,
                    collision_detection_distance=weights.collision_trigger,
                ),
            ]

        def start(self, q: Array) -> Array:
            return np.concatenate([q[:3], q[[6, 3, 4, 5]], q[7:]])

        def to_pinocchio(self, q: Array) -> Array:
            return np.concatenate([q[:3], q[[4, 5, 6, 3]], q[7:]])

        def step(self, q: Array, ee: Pose) -> Array | None:
            self._configuration.update(q)
            self._ee.set_target(_se3(ee))
            try:
                velocity = mink.solve_ik(
                    self._configuration,
                    self._tasks,
                    PERIOD,
                    self.qp,
                    damping=weights.regularization,
                    limits=self._limits,
                    constraints=self._hard,
                )
            except mink.NoSolutionFound:
                return None
            return self._configuration.integrate(velocity, PERIOD)

    def _geoms(bodies: tuple[str, ...]) -> list[int]:
        ids = [model.body(body).id for body in bodies]
        return np.flatnonzero(np.isin(model.geom_bodyid, ids)).tolist()

    def _se3(pose: Pose):
        return mink.SE3(np.concatenate([wxyz_from_matrix(pose[1]), pose[0]]))

    return Mink()


def _qp_solver() -> str:
    return next(name for name in QP_SOLVERS if name in qpsolvers.available_solvers)
