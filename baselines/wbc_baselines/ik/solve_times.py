"""Solve time of one step of whole-body IK: PlaCo and OSQP beside Pink and mink, on one and the same problem.

Pink and mink ship neither a support polygon nor a foot constraint without roll and yaw; both are added here
through their public interfaces, as a limit and a task. What keeps arm and body apart is soft in `placo_ik`
and hard in these two, whose limits have no slack; otherwise all solve the same program. It is the one of
planning, whose posture hardly pulls at the hand.
"""

import time
from collections.abc import Callable
from importlib.metadata import version
from typing import NamedTuple, Protocol

import numpy as np
import pandas as pd
import pinocchio as pin
import qpsolvers
from numpy.typing import NDArray

from wbc_baselines.ik.config import TUNED, Weights
from wbc_baselines.ik.model import ARM_LINKS, BODY_LINKS, Pose, WholeBodyModel, configuration
from wbc_baselines.ik.osqp_ik import Clearance, OsqpIK
from wbc_baselines.ik.placo_ik import PlacoIK
from wbc_baselines.ik.stance import base_from_stance, half_planes, measured_stance
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.errors import missing_extra
from wbc_bench.robot import JOINT_NAMES, Robot, load_robot
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_matrix

Array = NDArray[np.float64]
PERIOD = 0.02  # [s]
SLEW = 35  # steps until the target has arrived, as in `reference.plan_goal_posture`
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


class Ours:
    """A solver of this package."""

    def __init__(self, ik: PlacoIK | OsqpIK, package: str, qp: str, problem: BenchProblem) -> None:
        self._ik, self._problem = ik, problem
        self.package, self.qp = package, qp

    def start(self, q: Array) -> Array:
        return q

    to_pinocchio = start

    def step(self, q: Array, ee: Pose) -> Array | None:
        problem = self._problem
        default, weight = problem.robot.default_q, problem.weights.planning_posture
        return self._ik.step(q, ee, problem.soles, problem.hull, default, weight)


def make_placo(problem: BenchProblem) -> Solver:
    return Ours(PlacoIK(problem.robot, problem.weights, PERIOD), "placo", "eiquadprog", problem)


def make_osqp(problem: BenchProblem) -> Solver:
    return Ours(OsqpIK(problem.robot, problem.weights, PERIOD), "osqp", "osqp", problem)


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


MAKERS: dict[str, Callable[[BenchProblem], Solver]] = {
    "placo": make_placo,
    "osqp": make_osqp,
    "pin-pink": make_pink,
    "mink": make_mink,
}


class Walk(NamedTuple):
    """One package on the way to one target."""

    times: list[float]  # [ms] of each step
    failed: int  # steps without a solution
    error: tuple[float, float, float]  # at the end: hand [m], hand [rad], worse sole [m]


def solve_times(targets: int, steps: int) -> pd.DataFrame:
    """One row a package: times of a step in this process and thread, and the errors left at the end.

    Every package walks from the default posture to the same arm and posture targets of a tuning manifest,
    which arrive after `SLEW` of the steps; the packages take turns at every target, so that a load that comes
    and goes meets all of them. Errors are those of the last configuration: the median of the hand, the worst
    sole. A package that is not installed is a row that says so.
    """
    problem = _problem()
    solvers, rows = {}, {}
    for name, make in MAKERS.items():
        try:
            solvers[name] = make(problem)
        except ImportError as error:
            rows[name] = {"package": name, "note": missing_extra("this row", "bench", error)}
    goals = _goals(problem, targets)
    walks = {name: [] for name in solvers}
    for goal in [goals[0], *goals]:
        for name, solver in solvers.items():
            walks[name].append(_walk(problem, solver, goal, steps))
    rows |= {name: _row(name, solvers[name].qp, walks[name][1:]) for name in solvers}  # the first warmed up
    for name in solvers:
        rows[name]["times placo"] = rows[name]["median [ms]"] / rows["placo"]["median [ms]"]
    return pd.DataFrame([rows[name] for name in MAKERS])


def _walk(problem: BenchProblem, solver: Solver, goal: Pose, steps: int) -> Walk:
    model = WholeBodyModel(problem.robot)
    start = model.ee_of(problem.q)
    turning = pin.log3(start[1].T @ goal[1])
    q, times, failed = solver.start(problem.q), [], 0
    for k in range(steps):
        part = min(1.0, (k + 1) / SLEW)
        ee = start[0] + part * (goal[0] - start[0]), start[1] @ pin.exp3(part * turning)
        begin = time.perf_counter()
        found = solver.step(q, ee)
        times.append(1e3 * (time.perf_counter() - begin))
        if found is None:
            failed += 1
        else:
            q = found
    return Walk(times, failed, _errors(model, solver.to_pinocchio(q), goal, problem.soles))


def _row(name: str, qp: str, walks: list[Walk]) -> dict:
    times = np.concatenate([walk.times for walk in walks])
    position, orientation, sole = np.array([walk.error for walk in walks]).T
    return {
        "package": f"{name} {version(name)}",
        "QP solver": qp,
        "median [ms]": float(np.median(times)),
        "P99 [ms]": float(np.percentile(times, 99)),
        "times placo": np.nan,  # set when all are known
        "steps": len(times),
        "no solution": sum(walk.failed for walk in walks),
        "hand [mm]": 1e3 * float(np.median(position)),
        "hand [deg]": float(np.degrees(np.median(orientation))),
        "worst sole [mm]": 1e3 * float(sole.max()),
        "note": "",
    }


def _problem() -> BenchProblem:
    robot = load_robot()
    model = WholeBodyModel(robot)
    soles_b = model.soles_in_base(robot.default_q)
    pos, rot = base_from_stance(soles_b, np.array([0.0, 0.0, 1.0]), None)
    stance = measured_stance([(pos + rot @ p, rot @ r) for p, r in soles_b])
    q = configuration(pos, rot, robot.default_q)
    return BenchProblem(robot, TUNED.weights, q, stance.poses(), stance.hull(model.corners))


def _goals(problem: BenchProblem, count: int) -> list[Pose]:
    protocol, path = find_protocol("tuning_nominal_v1")
    manifest, _ = read_manifest(protocol, manifest_path(path))
    rows = np.flatnonzero(np.isin(manifest.stratum.astype(str), ("arm", "posture")))[:count]
    shift = np.array([*problem.q[:2], 0.0])  # the base stands over the world's origin at reset
    return [(manifest.target_pos_w[i] + shift, matrix_from_wxyz(manifest.target_quat_w[i])) for i in rows]


def _errors(model: WholeBodyModel, q: Array, goal: Pose, soles: list[Pose]) -> tuple[float, float, float]:
    """Of the hand [m], [rad] and of the worse sole [m]."""
    model.update(q)
    pos, rot = model.pose(model.tcp)
    turning = pin.log3(rot.T @ goal[1])
    slips = [model.pose(frame)[0] - asked for frame, (asked, _) in zip(model.soles, soles, strict=True)]
    return (
        float(np.linalg.norm(pos - goal[0])),
        float(np.linalg.norm(turning)),
        float(np.linalg.norm(slips, axis=1).max()),
    )


def _qp_solver() -> str:
    return next(name for name in QP_SOLVERS if name in qpsolvers.available_solvers)
