"""Stepping: the capture point, where a foot is put, how it swings there, and what a step is worth."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

from wbc_baselines.ik import make
from wbc_baselines.ik.config import TUNED
from wbc_baselines.ik.controller import PERIOD
from wbc_baselines.ik.estimation import ComFilter
from wbc_baselines.ik.model import GRAVITY, WholeBodyModel, configuration
from wbc_baselines.ik.stance import Stance, base_from_sole, measured_stance, yaw_matrix
from wbc_baselines.ik.stepping import (
    Swing,
    center_of_pressure,
    choose_swing_foot,
    outside,
    plan_foothold,
    solve_leg,
)
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.outcomes import TERMINATED
from wbc_bench.robot import load_robot

ROBOT = load_robot()
MODEL = WholeBodyModel(ROBOT)
STANCE = Stance(np.array([[0.0, 0.1], [0.0, -0.1]]), np.zeros(2))
RATE = 4.0  # [1/s]


def test_a_pendulum_over_its_capture_point_comes_to_rest() -> None:
    """x'' = omega^2 (x - p) with its foot p at the capture point, integrated numerically."""
    com = ComFilter(PERIOD, 0.003, 1.0, 0.3, np.array([0.02, -0.01, 0.6]))
    com.vel = np.array([0.4, -0.2, 0.0])
    capture, rate = com.capture_point()
    assert rate == pytest.approx(np.sqrt(GRAVITY / 0.6))
    start = np.concatenate([com.pos[:2], com.vel[:2]])
    way = solve_ivp(
        lambda _, x: np.concatenate([x[2:], rate**2 * (x[:2] - capture)]),
        (0, 2),
        start,
        rtol=1e-9,
        atol=1e-12,
    )
    np.testing.assert_allclose(way.y[:2, -1], capture, atol=1e-3)
    np.testing.assert_allclose(way.y[2:, -1], 0.0, atol=1e-3)


def test_distance_outside_a_square() -> None:
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    assert outside(np.array([0.5, 0.9]), square) == pytest.approx(-0.1)
    assert outside(np.array([1.2, 0.5]), square) == pytest.approx(0.2)


def test_pressure_is_the_nearest_point_of_the_sole() -> None:
    xy, yaw = np.array([0.3, -0.1]), 0.4
    grid = np.stack(np.meshgrid(np.linspace(-0.077, 0.09, 400), np.linspace(-0.017, 0.017, 100)), axis=-1)
    sole = xy + grid.reshape(-1, 2) @ yaw_matrix(yaw)[:2, :2].T
    for point in np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2)):
        nearest = sole[np.argmin(np.linalg.norm(sole - point, axis=1))]
        np.testing.assert_allclose(center_of_pressure(point, xy, yaw, MODEL.corners), nearest, atol=1e-3)


def test_the_foot_lands_where_the_capture_point_will_be() -> None:
    """Ahead of the toes of the standing foot the capture point runs away as in the integrated pendulum."""
    capture, left = np.array([0.12, 0.0]), 0.2
    p = center_of_pressure(capture, STANCE.xy[1], 0.0, MODEL.corners)
    run = solve_ivp(lambda _, xi: RATE * (xi - p), (0, left), capture, rtol=1e-9).y[:, -1]
    where = plan_foothold(TUNED, STANCE, 0, capture, RATE, left, MODEL.corners)
    middle = MODEL.corners[:, 0].mean()
    np.testing.assert_allclose(where.xy, run + np.array([-middle, TUNED.step_beside]), atol=1e-6)
    assert where.miss == 0.0


def test_landing_stays_in_reach_and_says_what_it_misses() -> None:
    where = plan_foothold(TUNED, STANCE, 0, np.array([0.5, 0.0]), RATE, 0.25, MODEL.corners)
    assert where.xy[0] == pytest.approx(TUNED.step_length)
    assert where.miss > 0.1
    crossed = plan_foothold(TUNED, STANCE, 0, np.array([0.1, -0.3]), RATE, 0.25, MODEL.corners)
    assert crossed.xy[1] - STANCE.xy[1, 1] == pytest.approx(TUNED.step_width[0])


def test_landing_turns_with_the_stance() -> None:
    turn = yaw_matrix(0.7)[:2, :2]
    turned = Stance(STANCE.xy @ turn.T, STANCE.yaw + 0.7)
    capture = np.array([0.13, 0.02])
    for side in (0, 1):
        here = plan_foothold(TUNED, STANCE, side, capture, RATE, 0.25, MODEL.corners)
        there = plan_foothold(TUNED, turned, side, turn @ capture, RATE, 0.25, MODEL.corners)
        np.testing.assert_allclose(there.xy, turn @ here.xy, atol=1e-12)


def test_the_mirror_image_steps_with_the_other_foot() -> None:
    for capture in np.array([(0.15, 0.03), (-0.12, 0.05), (0.1, 0.08)]):
        side = choose_swing_foot(TUNED, STANCE, capture, RATE, MODEL.corners)
        assert choose_swing_foot(TUNED, STANCE, capture * [1, -1], RATE, MODEL.corners) == 1 - side
        here = plan_foothold(TUNED, STANCE, side, capture, RATE, 0.25, MODEL.corners)
        there = plan_foothold(TUNED, STANCE, 1 - side, capture * [1, -1], RATE, 0.25, MODEL.corners)
        np.testing.assert_allclose(there.xy, here.xy * [1, -1], atol=1e-12)


def test_swing_starts_and_ends_at_rest_and_its_rates_are_derivatives() -> None:
    start, goal, raised = np.random.default_rng(1).uniform(-1, 1, (3, 4))
    swing, h = Swing(0, 0.25, start), 1e-6

    def at(time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        swing.time = time
        return swing.follow(goal, raised)

    np.testing.assert_allclose(at(0.0)[0], start)
    np.testing.assert_allclose(at(0.25)[0], goal)
    np.testing.assert_allclose(at(0.125)[0], raised)
    for time in (0.0, 0.25):
        np.testing.assert_allclose(at(time)[1], 0.0, atol=1e-12)
    for time in (0.05, 0.1, 0.2):
        slope = (at(time + h)[0] - at(time - h)[0]) / (2 * h)
        bend = (at(time + h)[1] - at(time - h)[1]) / (2 * h)
        np.testing.assert_allclose(at(time)[1], slope, atol=1e-6)
        np.testing.assert_allclose(at(time)[2], bend, atol=1e-5)


@pytest.mark.parametrize("side", [0, 1])
def test_leg_reaches_a_near_place(side: int) -> None:
    rng = np.random.default_rng(2)
    leg = slice(4 * side, 4 * side + 4)
    for _ in range(10):
        joints = ROBOT.default_q.copy()
        joints[leg] += rng.uniform(-0.3, 0.3, 4)
        pos, rot = MODEL.soles_in_base(joints)[side]
        start = ROBOT.default_q.copy()
        start[leg] = joints[leg] + rng.uniform(-0.2, 0.2, 4)
        found = start.copy()
        found[leg] = solve_leg(MODEL, start, side, (pos, rot))
        reached, turned = MODEL.soles_in_base(found)[side]
        assert np.linalg.norm(reached - pos) < 2e-3  # damped, four iterations
        assert abs((turned @ pin.log3(turned.T @ rot)) @ turned[:, 1]) < 5e-3


def test_base_pose_is_recovered_from_one_sole() -> None:
    rng = np.random.default_rng(3)
    for _ in range(10):
        joints = ROBOT.default_q + rng.uniform(-0.2, 0.2, 14)
        soles_b = MODEL.soles_in_base(joints)
        flat = soles_b[1][1]  # the standing sole is flat: its frame gives the vertical
        xy, yaw = rng.uniform(-1, 1, 2), rng.uniform(-1, 1)
        pos, rot = base_from_sole(soles_b[1], flat[:, 2], xy, yaw)
        np.testing.assert_allclose(pos + rot @ soles_b[1][0], [*xy, 0.0], atol=1e-12)
        np.testing.assert_allclose(rot @ flat, yaw_matrix(yaw), atol=1e-12)


def test_torques_are_those_of_the_equations_of_motion() -> None:
    """M a + g of the joints' rows, from the mass matrix and the gravity torques."""
    rng = np.random.default_rng(4)
    q = configuration(np.zeros(3), pin.exp3(rng.uniform(-0.3, 0.3, 3)), ROBOT.default_q)
    base, joints = rng.uniform(-2, 2, 3), rng.uniform(-5, 5, 14)
    rot = pin.Quaternion(q[3:7]).toRotationMatrix()
    inertia = pin.crba(MODEL.model, MODEL.data, q)
    inertia = np.triu(inertia) + np.triu(inertia, 1).T
    moved = inertia @ np.concatenate([rot.T @ base, np.zeros(3), joints]) + MODEL.gravity_torques(q)
    np.testing.assert_allclose(MODEL.torques(q, base, joints), moved[6:], atol=1e-9)


def test_width_and_moved_stance() -> None:
    turn = yaw_matrix(0.5)[:2, :2]
    stance = Stance(np.array([[0.3, 0.12], [-0.1, -0.08]]) @ turn.T, np.full(2, 0.5))
    assert stance.width() == pytest.approx(0.2)
    moved = stance.moved(0, np.array([1.0, 2.0]))
    np.testing.assert_allclose(moved.xy, [[1.0, 2.0], stance.xy[1]])
    assert measured_stance(moved.poses()).yaw == pytest.approx([0.5, 0.5])


def test_steps_save_pushed_episodes() -> None:
    """Of the tuning episodes whose push no standing robot absorbs, fewer fall with steps than without."""
    protocol, path = find_protocol("tuning_v1")
    manifest, _ = read_manifest(protocol, manifest_path(path))
    pushed = (np.abs(manifest.push_vel[:, 0]) > 0.35) & (np.abs(manifest.push_vel[:, 1]) < 0.25)
    rows = manifest.take(np.flatnonzero(pushed & (manifest.stratum == "arm"))[:8])
    falls = []
    for variant in ("standing", ""):
        controller = make(ROBOT, variant)
        falls.append(int(np.isin(rollout(controller, protocol, rows).outcome, TERMINATED).sum()))
    assert falls[1] <= falls[0] - 2
