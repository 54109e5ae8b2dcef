"""DAQP, PlaCo and OSQP solve one and the same inverse-kinematics program."""

import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest

from wbc_baselines.ik.batch_ik import OneByOne
from wbc_baselines.ik.clearance import Clearance, Proximity
from wbc_baselines.ik.config import Weights
from wbc_baselines.ik.daqp_ik import DaqpIK
from wbc_baselines.ik.geometry import Pose as Poses
from wbc_baselines.ik.kinematics import Configuration, Kinematics
from wbc_baselines.ik.model import Pose, WholeBodyModel, configuration
from wbc_baselines.ik.osqp_ik import OsqpIK
from wbc_baselines.ik.placo_ik import PlacoIK
from wbc_baselines.ik.stance import Hull, Stance, base_from_stance, half_planes, measured_stance
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.robot import load_robot
from wbc_bench.rotations import matrix_from_wxyz, wxyz_from_xyzw

PERIOD = 0.02  # [s]
# damped enough for a full Gauss-Newton step to come to rest beside the singularities of wrist and knees
WEIGHTS = Weights(regularization=1e-3)
POSTURE = WEIGHTS.planning_posture
ROBOT = load_robot()
MODEL = WholeBodyModel(ROBOT)
KINEMATICS = Kinematics(ROBOT)
BATCHED = DaqpIK(ROBOT, WEIGHTS, PERIOD)


class Single:
    """The batched solver for one episode."""

    def step(self, q, ee, soles, hull, posture, posture_weight, limit_speed=True) -> np.ndarray | None:
        yaw = [np.arctan2(rot[1, 0], rot[0, 0]) for _, rot in soles]
        found, solved = BATCHED.step(
            Configuration(Poses(q[None, :3], matrix_from_wxyz(wxyz_from_xyzw(q[None, 3:7]))), q[None, 7:]),
            Poses(ee[0][None], ee[1][None]),
            Stance(np.array([[pos[:2] for pos, _ in soles]]), np.array([yaw])),
            Hull.of(hull[None]),
            posture[None],
            np.array([posture_weight]),
            np.array([limit_speed]),
        )
        if not solved[0]:
            return None
        return configuration(found.base.pos[0], found.base.rot[0], found.joints[0])


SOLVERS = {
    "placo": PlacoIK(ROBOT, WEIGHTS, PERIOD),
    "osqp": OsqpIK(ROBOT, WEIGHTS, PERIOD),
    "daqp": Single(),
}


class Standing(NamedTuple):
    """The default posture on flat ground, in the anchor frame."""

    q: np.ndarray  # (21,)
    ee: Pose
    soles: list[Pose]
    hull: np.ndarray  # (V, 2) [m]


def _standing() -> Standing:
    bodies = KINEMATICS.at(ROBOT.default_q[None])
    base = base_from_stance(bodies, np.array([[0.0, 0.0, 1.0]]), None)
    stance = measured_stance(base, bodies)
    q = configuration(base.pos[0], base.rot[0], ROBOT.default_q)
    soles = list(zip(stance.pos()[0], stance.rot()[0], strict=True))
    return Standing(q, MODEL.ee_of(q), soles, stance.hull(MODEL.corners).corners(0))


START = _standing()


def _targets(count: int) -> list[Pose]:
    """Feasible targets that no table uses; the base stands over the world's origin at reset."""
    protocol, path = find_protocol("tuning_nominal_v1")
    manifest, _ = read_manifest(protocol, manifest_path(path))
    rows = [np.flatnonzero(manifest.stratum == name)[: count // 2] for name in ("arm", "posture")]
    shift = np.array([*START.q[:2], 0.0])
    return [
        (manifest.target_pos_w[i] + shift, matrix_from_wxyz(manifest.target_quat_w[i]))
        for i in np.concatenate(rows)
    ]


def _slew(target: Pose, steps: int = 70, limit_speed: bool = True) -> dict[str, np.ndarray]:
    """Configurations (steps + 1, 21) of each solver on the way to a target that takes 35 steps to arrive."""
    way, turning = target[0] - START.ee[0], pin.log3(START.ee[1].T @ target[1])
    paths = {}
    for name, solver in SOLVERS.items():
        path = [START.q]
        for k in range(steps):
            part = min(1.0, (k + 1) / 35)
            ee = START.ee[0] + part * way, START.ee[1] @ pin.exp3(part * turning)
            q = solver.step(path[-1], ee, START.soles, START.hull, ROBOT.default_q, POSTURE, limit_speed)
            assert q is not None, f"{name}: no solution at step {k}"
            path.append(q)
        paths[name] = np.array(path)
    return paths


@pytest.fixture(scope="module")
def paths() -> list[dict[str, np.ndarray]]:
    return [_slew(target) for target in _targets(12)]


@pytest.mark.parametrize(("name", "metres", "angle"), [("osqp", 1e-3, 2e-3), ("daqp", 1e-6, 1e-6)])
def test_solvers_reach_the_same_poses(paths, name, metres, angle):
    for path in paths:
        (pos_a, rot_a), (pos_b, rot_b) = (MODEL.ee_of(path[key][-1]) for key in ("placo", name))
        assert np.linalg.norm(pos_a - pos_b) < metres
        assert np.linalg.norm(pin.log3(rot_a.T @ rot_b)) < angle


@pytest.mark.parametrize(("name", "tolerance"), [("osqp", 1e-5), ("daqp", 1e-9)])
def test_solvers_take_the_same_steps(paths, name, tolerance):
    """From where PlaCo stands, so that differences do not add up along the way."""
    for path, target in zip(paths, _targets(12), strict=True):
        for q in path["placo"][::14]:
            program = target, START.soles, START.hull, ROBOT.default_q, POSTURE, False
            steps = [SOLVERS[key].step(q, *program) for key in ("placo", name)]
            # OSQP's program lacks PlaCo's own damping, of 1e-8
            np.testing.assert_allclose(steps[1], steps[0], atol=tolerance)


@pytest.mark.parametrize("name", SOLVERS)
def test_steps_respect_limits(paths, name):
    stride = PERIOD * WEIGHTS.speed_fraction * ROBOT.velocity
    for path in paths:
        joints = path[name][:, 7:]
        assert (joints[1:] > ROBOT.lower + WEIGHTS.joint_margin - 1e-6).all()
        assert (joints[1:] < ROBOT.upper - WEIGHTS.joint_margin + 1e-6).all()
        assert (np.abs(np.diff(joints, axis=0)) < stride + 1e-6).all()


@pytest.mark.parametrize("name", SOLVERS)
def test_mass_centre_stays_over_the_soles(paths, name):
    normal, offset = half_planes(START.hull)
    for path in paths:
        for q in path[name]:
            # the linearised margin holds up to the curvature of the motion
            assert (normal @ MODEL.com_of(q)[:2] <= offset - WEIGHTS.com_margin + 2e-3).all()


@pytest.mark.parametrize("name", SOLVERS)
def test_soles_stay_where_they_stand(paths, name):
    for path in paths:
        for before, q in pairwise(path[name]):
            MODEL.update(q)
            left, right = (MODEL.pose(sole) for sole in MODEL.soles)
            # a step removes the error to first order; what is left is its curvature, at most a metre of lever
            slack = 1e-4 + np.abs(pin.difference(MODEL.model, before, q)).max() ** 2
            for (pos, _), (pos_ref, _) in zip((left, right), START.soles, strict=True):
                assert np.linalg.norm(pos - pos_ref) < slack
            for _, rot in (left, right):  # the soles point ahead: pitch is hard, roll and yaw are soft
                assert abs(pin.log3(rot)[1]) < slack
                assert np.linalg.norm(pin.log3(rot)) < 0.1  # [rad]
        MODEL.update(path[name][-1])
        for sole, (pos_ref, _) in zip(MODEL.soles, START.soles, strict=True):
            assert np.linalg.norm(MODEL.pose(sole)[0] - pos_ref) < 1e-4


@pytest.mark.parametrize("name", SOLVERS)
def test_contradiction_has_no_solution(name):
    """A right sole to stand far ahead of the left one, or a stride ahead within one period."""
    left, (pos, rot) = START.soles
    for distance, limit_speed in ((8.0, False), (0.6, True)):
        soles = [left, (pos + np.array([distance, 0.0, 0.0]), rot)]
        step = SOLVERS[name].step(START.q, START.ee, soles, START.hull, ROBOT.default_q, POSTURE, limit_speed)
        assert step is None


@pytest.mark.parametrize("name", SOLVERS)
def test_joint_beyond_what_its_speed_allows_has_no_solution(name):
    q = START.q.copy()
    q[-1] = ROBOT.upper[-1] + 1.0  # [rad]
    assert SOLVERS[name].step(q, START.ee, START.soles, START.hull, ROBOT.default_q, POSTURE, True) is None


def _random_case(rng: np.random.Generator):
    """A configuration far from its targets, and the targets."""
    move = rng.uniform(-0.4, 0.4, MODEL.model.nv)
    q = pin.integrate(MODEL.model, START.q, move)
    soles = [
        (pos + rng.uniform(-0.1, 0.1, 3), rot @ pin.exp3(rng.uniform(-0.3, 0.3, 3)))
        for pos, rot in START.soles
    ]
    ee = START.ee[0] + rng.uniform(-0.3, 0.3, 3), START.ee[1] @ pin.exp3(rng.uniform(-1, 1, 3))
    return q, ee, soles, ROBOT.default_q + rng.uniform(-0.3, 0.3, 14)


def _cost(q, ee, soles, posture) -> float:
    """Half the weighted squared errors of the soft tasks, from forward kinematics alone."""
    MODEL.update(q)
    pos, rot = MODEL.pose(MODEL.tcp)
    com = MODEL.data.com[0][:2]
    flat = sum(
        np.sum(pin.log3(MODEL.pose(sole)[1].T @ rot) ** 2)
        for sole, (_, rot) in zip(MODEL.soles, soles, strict=True)
    )
    base = MODEL.pose(MODEL.model.getFrameId("base_Link"))[1]
    w = WEIGHTS
    return 0.5 * (
        w.ee_position * np.sum((pos - ee[0]) ** 2)
        + w.ee_orientation * np.sum(pin.log3(rot.T @ ee[1]) ** 2)
        + w.foot_flat * flat
        + w.com * np.sum((com - START.hull.mean(axis=0)) ** 2)
        + w.upright * np.sum(pin.log3(base) ** 2)
        + POSTURE * np.sum((q[7:] - posture) ** 2)
    )


def test_gradient_of_the_program_is_that_of_its_cost():
    """Exact however large the errors: the Jacobian of the logarithm maps a rotation vector to itself."""
    rng = np.random.default_rng(0)
    h = 1e-6
    for _ in range(5):
        q, ee, soles, posture = _random_case(rng)
        program = SOLVERS["osqp"].program(q, ee, soles, START.hull, posture, POSTURE)
        slope = [
            (
                _cost(pin.integrate(MODEL.model, q, d), ee, soles, posture)
                - _cost(pin.integrate(MODEL.model, q, -d), ee, soles, posture)
            )
            / (2 * h)
            for d in h * np.eye(MODEL.model.nv)
        ]
        np.testing.assert_allclose(program.c, slope, atol=1e-8)


def test_rows_are_derivatives_of_their_errors():
    """Foot constraints and polygon by finite differences, at feet that stand where they are asked to."""
    rng = np.random.default_rng(1)
    h = 1e-6
    for _ in range(5):
        q, ee, _, posture = _random_case(rng)
        MODEL.update(q)
        soles = [MODEL.pose(sole) for sole in MODEL.soles]

        def errors(q, ee=ee, soles=soles, posture=posture):
            program = SOLVERS["osqp"].program(q, ee, soles, START.hull, posture, POSTURE)
            return np.concatenate([program.b, program.h[: len(program.h) - program.soft]])

        program = SOLVERS["osqp"].program(q, ee, soles, START.hull, posture, POSTURE)
        rows = np.concatenate([program.a, program.g[: len(program.g) - program.soft]])
        slope = [
            (errors(pin.integrate(MODEL.model, q, d)) - errors(pin.integrate(MODEL.model, q, -d))) / (2 * h)
            for d in h * np.eye(MODEL.model.nv)
        ]
        np.testing.assert_allclose(-rows.T, slope, atol=1e-8)


HUGGING = [  # [m] from the base's place on the ground: under the arm's mount, beside the base, at a knee
    (0.15, 0.0, 0.75),
    (0.1, 0.2, 0.55),
    (0.2, -0.1, 0.6),
    (0.0, -0.2, 0.7),
]
BESIDE = np.array([*START.q[:2], 0.0])


@pytest.fixture(scope="module")
def hugging() -> list[np.ndarray]:
    """PlaCo's way, (61, 21), to hand positions inside or close to base and legs."""
    paths = []
    rot = START.ee[1] @ pin.exp3(np.array([0.0, 1.0, 0.0]))
    for place in HUGGING:
        pos, path = np.array(place) + BESIDE, [START.q]
        for k in range(60):
            ee = START.ee[0] + min(1.0, (k + 1) / 35) * (pos - START.ee[0]), rot
            q = SOLVERS["placo"].step(path[-1], ee, START.soles, START.hull, ROBOT.default_q, POSTURE)
            assert q is not None
            path.append(q)
        paths.append(np.array(path))
    return paths


def test_all_solvers_keep_arm_and_body_apart(hugging):
    clearance = Clearance(ROBOT, MODEL.model, WEIGHTS.collision_trigger)
    nearest = []
    for path, place in zip(hugging, HUGGING, strict=True):
        ee = np.array(place) + BESIDE, START.ee[1]
        for q in path:
            MODEL.update(q)
            nearest.append(min(clearance.rows(MODEL.data)[1], default=np.inf))
        for q in path[::6]:
            program = ee, START.soles, START.hull, ROBOT.default_q, POSTURE
            steps = {name: solver.step(q, *program) for name, solver in SOLVERS.items()}
            np.testing.assert_allclose(steps["osqp"], steps["placo"], atol=1e-5)
            np.testing.assert_allclose(steps["daqp"], steps["placo"], atol=1e-9)
    assert np.mean(np.array(nearest) < WEIGHTS.collision_trigger) > 0.5  # else this tests nothing
    assert min(nearest) > 0.5 * WEIGHTS.collision_margin


def test_distances_do_not_depend_on_what_was_measured_before(hugging):
    clearance = Clearance(ROBOT, MODEL.model, np.inf)
    joints = [q[7:] for path in hugging for q in path[::20]]

    def measured(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pin.computeJointJacobians(MODEL.model, MODEL.data, MODEL.at(q))
        return clearance.rows(MODEL.data)

    forth, back = [measured(q) for q in joints], [measured(q) for q in reversed(joints)]
    for one, other in zip(forth, reversed(back), strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_closing_rows_are_derivatives_of_their_distances(hugging):
    h = 1e-4  # distances come from iterations that stop at 1e-6 m
    clearance = Clearance(ROBOT, MODEL.model, np.inf)  # every pair, near or not

    def distances(q: np.ndarray) -> np.ndarray:
        MODEL.update(q)
        return clearance.rows(MODEL.data)[1]

    for path in hugging:
        MODEL.update(path[-1])
        closing, _ = clearance.rows(MODEL.data)
        slope = [
            (
                distances(pin.integrate(MODEL.model, path[-1], d))
                - distances(pin.integrate(MODEL.model, path[-1], -d))
            )
            / (2 * h)
            for d in h * np.eye(MODEL.model.nv)
        ]
        np.testing.assert_allclose(-closing.T, slope, atol=0.02)


def test_no_pair_that_is_near_is_passed_over(hugging):
    """The spheres say near at least where the shapes are."""
    clearance = Clearance(ROBOT, MODEL.model, WEIGHTS.collision_trigger)
    proximity = Proximity(KINEMATICS, clearance)
    joints = np.concatenate([path[:, 7:] for path in hugging])
    KINEMATICS.at(joints)
    near, found = proximity.near(len(joints)), 0
    for q, maybe in zip(joints, near, strict=True):
        pin.computeJointJacobians(MODEL.model, MODEL.data, MODEL.at(q))
        rows, distances = clearance.rows(MODEL.data)
        fewer = clearance.rows(MODEL.data, np.flatnonzero(maybe))
        np.testing.assert_array_equal(fewer[0], rows)
        np.testing.assert_array_equal(fewer[1], distances)
        found += len(distances)
    assert found > 100 and near.sum() < 0.5 * near.size
    # and of arms that are 20 cm away they say so of nothing
    every = Clearance(ROBOT, MODEL.model, np.inf)
    arms = np.tile(ROBOT.default_q, (200, 1))
    arms[:, 8:] = np.random.default_rng(3).uniform(ROBOT.lower[8:], ROBOT.upper[8:], (200, 6))
    KINEMATICS.at(arms)
    near, away = proximity.near(len(arms)), 0
    for q, maybe in zip(arms, near, strict=True):
        pin.computeJointJacobians(MODEL.model, MODEL.data, MODEL.at(q))
        if every.rows(MODEL.data)[1].min() > 0.2:
            away += 1
            assert not maybe.any()
    assert away > 5


def test_batched_steps_are_those_of_each_episode_alone(paths, hugging):
    """Among others near and far, solvable and not, the very bits; and PlaCo one by one solves the same."""
    rng = np.random.default_rng(2)
    starts = np.concatenate([path["placo"][::10] for path in paths] + [path[::6] for path in hugging])
    q = Configuration(Poses(starts[:, :3], matrix_from_wxyz(wxyz_from_xyzw(starts[:, 3:7]))), starts[:, 7:])
    count = len(starts)
    hand = Poses(START.ee[0] + rng.uniform(-0.2, 0.2, (count, 3)), np.tile(START.ee[1], (count, 1, 1)))
    stance = Stance(np.tile([pos[:2] for pos, _ in START.soles], (count, 1, 1)), np.zeros((count, 2)))
    stance.xy[::9, 1, 0] += 8.0  # nobody's leg is that long
    hull = stance.hull(MODEL.corners)
    part = q, hand, stance, hull
    rest = np.tile(ROBOT.default_q, (count, 1)), np.full(count, 1e-2), rng.uniform(size=count) < 0.5
    together, solved = BATCHED.step(*part, *rest)
    assert not solved[::9].any() and solved[1::9].all()
    for i in range(count):
        row = np.array([i])
        one = q.take(row), hand.take(row), stance.take(row), hull.take(row)
        alone, found = BATCHED.step(*one, rest[0][row], rest[1][row], rest[2][row])
        assert found[0] == solved[i]
        for mine, all_of_them in ((alone.joints, together.joints), (alone.base.pos, together.base.pos)):
            np.testing.assert_array_equal(mine[0], all_of_them[i])
    other, found = OneByOne(SOLVERS["placo"]).step(*part, *rest)
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_allclose(other.joints, together.joints, atol=1e-9)
    np.testing.assert_allclose(other.base.rot, together.base.rot, atol=1e-8)


def test_half_planes_of_a_square():
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])
    normal, offset = half_planes(square)
    np.testing.assert_allclose(normal, [[0, -1], [1, 0], [0, 1], [-1, 0]], atol=1e-15)
    np.testing.assert_allclose(offset, [0, 2, 1, 0], atol=1e-15)


def test_placo_keeps_nothing_of_the_polygons_that_it_is_given() -> None:
    """Its setter keeps every array for good: 0.5 KB a step, 39 MiB a shard, if it gets new ones."""
    standing, solver = START, SOLVERS["placo"]

    def resident() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**10

    def steps(count: int) -> None:
        for _ in range(count):
            hull = standing.hull.copy()
            assert (
                solver.step(standing.q, standing.ee, standing.soles, hull, ROBOT.default_q, POSTURE)
                is not None
            )

    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc here")
    steps(200)
    before = resident()
    steps(3000)
    assert resident() - before < 500  # [KiB]; it was 1500


def test_solvers_take_over_the_wrapper_of_one_that_is_gone_and_step_alike() -> None:
    """PlaCo never frees one; a solver on a used wrapper gives the very bytes of one on a new."""
    from wbc_baselines.ik import placo_ik

    def walk(solver: PlacoIK, height: float) -> list[bytes]:
        q, path = START.q, []
        for k in range(5):
            ee = START.ee[0] + np.array([0.0, 0.0, height * (k + 1)]), START.ee[1]
            q = solver.step(q, ee, START.soles, START.hull, ROBOT.default_q, POSTURE)
            assert q is not None
            path.append(q.tobytes())
        return path

    idle = placo_ik._IDLE.setdefault(ROBOT.urdf(), [])
    idle.clear()  # those of other tests
    first = PlacoIK(ROBOT, WEIGHTS, PERIOD)
    other = PlacoIK(ROBOT, WEIGHTS, PERIOD)
    assert first._robot is not other._robot and not idle  # two at a time share none
    wanted, used = walk(first, 0.004), first._robot
    del first
    strict = PlacoIK(ROBOT, replace(WEIGHTS, joint_margin=0.1, speed_fraction=0.5), PERIOD)
    assert strict._robot is used
    walk(strict, -0.003)
    del strict
    again = PlacoIK(ROBOT, WEIGHTS, PERIOD)
    assert again._robot is used and walk(again, 0.004) == wanted == walk(other, 0.004)
