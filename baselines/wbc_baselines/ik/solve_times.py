"""Solve time of one step of whole-body IK: DAQP, PlaCo and OSQP beside Pink and mink, on the same problem.

It is the program of planning, whose posture hardly pulls at the hand. DAQP solves all targets at once, as the
controller does the episodes of a shard: its times are those of a call by its number of programs.
"""

import time
from collections.abc import Callable
from importlib.metadata import version
from typing import NamedTuple

import numpy as np
import pandas as pd
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.config import TUNED
from wbc_baselines.ik.controller import PERIOD
from wbc_baselines.ik.daqp_ik import DaqpIK
from wbc_baselines.ik.geometry import Pose as Poses
from wbc_baselines.ik.kinematics import Configuration, Kinematics
from wbc_baselines.ik.model import Pose, WholeBodyModel, configuration
from wbc_baselines.ik.osqp_ik import OsqpIK
from wbc_baselines.ik.peers import BenchProblem, Solver, make_mink, make_pink
from wbc_baselines.ik.placo_ik import PlacoIK
from wbc_baselines.ik.reference import SLEW
from wbc_baselines.ik.stance import Hull, Stance, base_from_stance, measured_stance
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.errors import missing_extra
from wbc_bench.robot import load_robot
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_xyzw

Array = NDArray[np.float64]


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


MAKERS: dict[str, Callable[[BenchProblem], Solver]] = {
    "placo": make_placo,
    "osqp": make_osqp,
    "pin-pink": make_pink,
    "mink": make_mink,
}
BATCHED = "daqp"


class Walk(NamedTuple):
    """One package on the way to one target."""

    times: list[float]  # [ms] of processor time of each step
    failed: int  # steps without a solution
    error: tuple[float, float, float]  # at the end: hand [m], hand [rad], worse sole [m]


def solve_times(targets: int, steps: int) -> pd.DataFrame:
    """One row a package: processor times of a step in this process, and the errors left at the end.

    Every package walks from the default posture to the same arm and posture targets of a tuning manifest,
    which arrive after `SLEW` of the steps; the packages take turns at every target, so that a load that comes
    and goes meets all of them. Errors are those of the last configuration: the median of the hand, the worst
    sole. A package that is not installed is a row that says so.
    """
    problem = _problem()
    model, batched = WholeBodyModel(problem.robot), DaqpIK(problem.robot, problem.weights, PERIOD)
    solvers, rows = {}, {}
    for name, make in MAKERS.items():
        try:
            solvers[name] = make(problem)
        except ImportError as error:
            rows[name] = {"package": name, "note": missing_extra("this row", "bench", error)}
    goals = _goals(problem, targets)
    walks = {name: [] for name in solvers}
    together: list[Walk] = []
    for goal in [goals[0], *goals]:
        for name, solver in solvers.items():
            walks[name].append(_walk(problem, model, solver, goal, steps))
        together += _walk_together(problem, model, batched, goals, steps)
    # the first warmed up
    walks[BATCHED] = together[len(goals) :]
    rows[BATCHED] = _row(BATCHED, f"daqp, {len(goals)} at once", walks[BATCHED])
    rows |= {name: _row(name, solvers[name].qp, walks[name][1:]) for name in solvers}
    for name in (BATCHED, *solvers):
        rows[name]["times daqp"] = rows[name]["median [ms]"] / rows[BATCHED]["median [ms]"]
    return pd.DataFrame([rows[name] for name in (BATCHED, *MAKERS)])


def _walk(problem: BenchProblem, model: WholeBodyModel, solver: Solver, goal: Pose, steps: int) -> Walk:
    start = model.ee_of(problem.q)
    turning = pin.log3(start[1].T @ goal[1])
    q, times, failed = solver.start(problem.q), [], 0
    for k in range(steps):
        part = min(1.0, (k + 1) / SLEW)
        ee = start[0] + part * (goal[0] - start[0]), start[1] @ pin.exp3(part * turning)
        begin = time.process_time()
        found = solver.step(q, ee)
        times.append(1e3 * (time.process_time() - begin))
        if found is None:
            failed += 1
        else:
            q = found
    return Walk(times, failed, _errors(model, solver.to_pinocchio(q), goal, problem.soles))


def _walk_together(
    problem: BenchProblem, model: WholeBodyModel, solver: DaqpIK, goals: list[Pose], steps: int
) -> list[Walk]:
    """The same ways with the batched solver, which is at all targets in each step."""
    count = len(goals)
    start = model.ee_of(problem.q)
    pos, rot = np.array([goal[0] for goal in goals]), np.array([goal[1] for goal in goals])
    turning = np.array([pin.log3(start[1].T @ turned) for turned in rot])
    q = np.tile(problem.q, (count, 1))
    at = Configuration(Poses(q[:, :3], matrix_from_wxyz(wxyz_from_xyzw(q[:, 3:7]))), q[:, 7:])
    soles = np.tile([place[:2] for place, _ in problem.soles], (count, 1, 1))
    stance = Stance(soles, np.zeros((count, 2)))  # the default posture stands straight
    hull = Hull.of(np.tile(problem.hull, (count, 1, 1)))
    posture = np.tile(problem.robot.default_q, (count, 1))
    weight, limit = np.full(count, problem.weights.planning_posture), np.ones(count, dtype=bool)
    times, failed = [], np.zeros(count, dtype=np.int64)
    for k in range(steps):
        part = min(1.0, (k + 1) / SLEW)
        turned = np.array([start[1] @ pin.exp3(part * way) for way in turning])
        hand = Poses(start[0] + part * (pos - start[0]), turned)
        begin = time.process_time()
        step, found = solver.step(at, hand, stance, hull, posture, weight, limit)
        times.append(1e3 * (time.process_time() - begin) / count)
        at.put(found, step.take(found))
        failed += ~found
    walks = []
    for i, goal in enumerate(goals):
        reached = configuration(at.base.pos[i], at.base.rot[i], at.joints[i])
        walks.append(Walk(times, int(failed[i]), _errors(model, reached, goal, problem.soles)))
    return walks


def _row(name: str, qp: str, walks: list[Walk]) -> dict:
    times = np.concatenate([walk.times for walk in walks])
    position, orientation, sole = np.array([walk.error for walk in walks]).T
    return {
        "package": f"{name} {version(name)}",
        "QP solver": qp,
        "median [ms]": float(np.median(times)),
        "P99 [ms]": float(np.percentile(times, 99)),
        "times daqp": np.nan,  # set when all are known
        "steps": len(times),
        "no solution": sum(walk.failed for walk in walks),
        "hand [mm]": 1e3 * float(np.median(position)),
        "hand [deg]": float(np.degrees(np.median(orientation))),
        "worst sole [mm]": 1e3 * float(sole.max()),
        "note": "",
    }


def _problem() -> BenchProblem:
    robot = load_robot()
    kinematics, model = Kinematics(robot), WholeBodyModel(robot)
    bodies = kinematics.at(robot.default_q[None])
    base = base_from_stance(bodies, np.array([[0.0, 0.0, 1.0]]), None)
    stance = measured_stance(base, bodies)
    q = configuration(base.pos[0], base.rot[0], robot.default_q)
    soles = list(zip(stance.pos()[0], stance.rot()[0], strict=True))
    return BenchProblem(robot, TUNED.weights, q, soles, stance.hull(model.corners).corners(0))


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
