"""Stepping: the capture point, where a foot is put, how it swings there, and what a step is worth."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp

from wbc_baselines.ik import make
from wbc_baselines.ik.config import TUNED
from wbc_baselines.ik.controller import PERIOD
from wbc_baselines.ik.estimation import ComFilter
from wbc_baselines.ik.geometry import Pose
from wbc_baselines.ik.kinematics import GRAVITY, Kinematics
from wbc_baselines.ik.model import WholeBodyModel, configuration
from wbc_baselines.ik.stance import Hull, Stance, base_from_sole
from wbc_baselines.ik.stepping import (
    Swing,
    center_of_pressure,
    choose_swing_foot,
    plan_foothold,
    solve_leg,
)
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.outcomes import TERMINATED
from wbc_bench.robot import load_robot
from wbc_bench.rotations import yaw_matrix

ROBOT = load_robot()
MODEL = WholeBodyModel(ROBOT)
KINEMATICS = Kinematics(ROBOT)
STANCE = Stance(np.array([[[0.0, 0.1], [0.0, -0.1]]]), np.zeros((1, 2)))
RATE = 4.0  # [1/s]


def foothold(stance: Stance, side: int, capture: np.ndarray, left: float) -> tuple[np.ndarray, float]:
    """Place (2,) and miss of one foot."""
    xy, miss = plan_foothold(
        TUNED, stance, np.array([side]), capture[None], np.array([RATE]), np.array([left]), MODEL.corners
    )
    return xy[0], float(miss[0])


def chosen_foot(capture: np.ndarray) -> int:
    return int(choose_swing_foot(TUNED, STANCE, capture[None], np.array([RATE]), MODEL.corners)[0])


def pressure(point: np.ndarray, xy: np.ndarray, yaw: float) -> np.ndarray:
    return center_of_pressure(point[None], xy[None], np.array([yaw]), MODEL.corners)[0]


def test_a_pendulum_over_its_capture_point_comes_to_rest() -> None:
    """x'' = omega^2 (x - p) with its foot p at the capture point, integrated numerically."""
    com = ComFilter(PERIOD, 0.003, 1.0, 0.3).start(np.array([[0.02, -0.01, 0.6]]))
    com.vel = np.array([[0.4, -0.2, 0.0]])
    (capture,), (rate,) = com.capture_point()
    assert rate == pytest.approx(np.sqrt(GRAVITY / 0.6))
    start = np.concatenate([com.pos[0, :2], com.vel[0, :2]])
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
    square = Hull.of(np.array([[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]] * 2))
    np.testing.assert_allclose(square.outside(np.array([[0.5, 0.9], [1.2, 0.5]])), [-0.1, 0.2])
    moved = square.moved(np.array([[1.0, 0.0], [0.0, 2.0]]))
    np.testing.assert_allclose(moved.outside(np.array([[1.5, 0.9], [1.2, 2.5]])), [-0.1, 0.2])


def test_pressure_is_the_nearest_point_of_the_sole() -> None:
    xy, yaw = np.array([0.3, -0.1]), 0.4
    grid = np.stack(np.meshgrid(np.linspace(-0.077, 0.09, 400), np.linspace(-0.017, 0.017, 100)), axis=-1)
    sole = xy + grid.reshape(-1, 2) @ yaw_matrix(yaw)[:2, :2].T
    for point in np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2)):
        nearest = sole[np.argmin(np.linalg.norm(sole - point, axis=1))]
        np.testing.assert_allclose(pressure(point, xy, yaw), nearest, atol=1e-3)


def test_the_foot_lands_where_the_capture_point_will_be() -> None:
    """Ahead of the toes of the standing foot the capture point runs away as in the integrated pendulum."""
    capture, left = np.array([0.12, 0.0]), 0.2
    p = pressure(capture, STANCE.xy[0, 1], 0.0)
    run = solve_ivp(lambda _, xi: RATE * (xi - p), (0, left), capture, rtol=1e-9).y[:, -1]
    where, miss = foothold(STANCE, 0, capture, left)
    middle = MODEL.corners[:, 0].mean()
    np.testing.assert_allclose(where, run + np.array([-middle, TUNED.step_beside]), atol=1e-6)
    assert miss == 0.0


def test_landing_stays_in_reach_and_says_what_it_misses() -> None:
    where, miss = foothold(STANCE, 0, np.array([0.5, 0.0]), 0.25)
    assert where[0] == pytest.approx(TUNED.step_length)
    assert miss > 0.1
    crossed, _ = foothold(STANCE, 0, np.array([0.1, -0.3]), 0.25)
    assert crossed[1] - STANCE.xy[0, 1, 1] == pytest.approx(TUNED.step_width[0])


def test_landing_turns_with_the_stance() -> None:
    turn = yaw_matrix(0.7)[:2, :2]
    turned = Stance(STANCE.xy @ turn.T, STANCE.yaw + 0.7)
    capture = np.array([0.13, 0.02])
    for side in (0, 1):
        here, _ = foothold(STANCE, side, capture, 0.25)
        there, _ = foothold(turned, side, turn @ capture, 0.25)
        np.testing.assert_allclose(there, turn @ here, atol=1e-12)


def test_the_mirror_image_steps_with_the_other_foot() -> None:
    for capture in np.array([(0.15, 0.03), (-0.12, 0.05), (0.1, 0.08)]):
        side = chosen_foot(capture)
        assert chosen_foot(capture * [1, -1]) == 1 - side
        here, _ = foothold(STANCE, side, capture, 0.25)
        there, _ = foothold(STANCE, 1 - side, capture * [1, -1], 0.25)
        np.testing.assert_allclose(there, here * [1, -1], atol=1e-12)


def test_swing_starts_and_ends_at_rest_and_its_rates_are_derivatives() -> None:
    start, goal, raised = np.random.default_rng(1).uniform(-1, 1, (3, 1, 4))
    swing, h = Swing(np.zeros(1, dtype=int), np.zeros(1), np.full((1, 2), np.nan), start), 1e-6

    def at(time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        swing.time[:] = time
        return swing.follow(0.25, goal, raised)

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
    rng, count = np.random.default_rng(2), 10
    leg = slice(4 * side, 4 * side + 4)
    joints = np.tile(ROBOT.default_q, (count, 1))
    joints[:, leg] += rng.uniform(-0.3, 0.3, (count, 4))
    goal = KINEMATICS.at(joints)
    pos, rot = goal.pos[:, 1 + side], goal.rot[:, 1 + side]
    found = np.tile(ROBOT.default_q, (count, 1))
    found[:, leg] = joints[:, leg] + rng.uniform(-0.2, 0.2, (count, 4))
    found[:, leg] = solve_leg(KINEMATICS, found, np.full(count, side), pos, rot)
    reached = KINEMATICS.at(found)
    for i in range(count):
        turned = reached.rot[i, 1 + side]
        assert np.linalg.norm(reached.pos[i, 1 + side] - pos[i]) < 2e-3  # damped, four iterations
        assert abs((turned @ pin.log3(turned.T @ rot[i])) @ turned[:, 1]) < 5e-3


def test_base_pose_is_recovered_from_one_sole() -> None:
    rng, count = np.random.default_rng(3), 10
    bodies = KINEMATICS.at(ROBOT.default_q + rng.uniform(-0.2, 0.2, (count, 14)))
    sole = Pose(bodies.pos[:, 2], bodies.rot[:, 2])
    flat = sole.rot  # the standing sole is flat: its frame gives the vertical
    xy, yaw = rng.uniform(-1, 1, (count, 2)), rng.uniform(-1, 1, count)
    base = base_from_sole(sole, flat[:, :, 2], xy, yaw)
    back = base.at(sole.pos, sole.rot)
    np.testing.assert_allclose(back.pos, np.pad(xy, ((0, 0), (0, 1))), atol=1e-12)
    np.testing.assert_allclose(back.rot, yaw_matrix(yaw), atol=1e-12)


def test_swing_torques_are_those_of_the_equations_of_motion() -> None:
    """M a + g of the swinging leg's joints, from Pinocchio's mass matrix and gravity torques."""
    rng, controller = np.random.default_rng(4), make(ROBOT)
    for side in (0, 1):
        leg = np.arange(4 * side, 4 * side + 4)
        raw = (ROBOT.default_q + rng.uniform(-0.2, 0.2, 14))[None]
        rot = pin.exp3(rng.uniform(-0.3, 0.3, 3))
        base, joints = rng.uniform(-2, 2, 3), np.zeros(14)
        joints[leg] = rng.uniform(-5, 5, 4)
        q = configuration(np.zeros(3), rot, raw[0])
        inertia = pin.crba(MODEL.model, MODEL.data, q)
        inertia = np.triu(inertia) + np.triu(inertia, 1).T
        moved = inertia @ np.concatenate([rot.T @ base, np.zeros(3), joints]) + MODEL.gravity_torques(q)
        lifted = controller._lifting(base[None], Pose(np.zeros((1, 3)), rot[None]), KINEMATICS.at(raw))
        found = lifted[0, leg] + KINEMATICS.leg_inertia(raw, leg[None])[0] @ joints[leg]
        np.testing.assert_allclose(found, moved[6:][leg], atol=1e-9)


def test_width_and_moved_stance() -> None:
    turn = yaw_matrix(0.5)[:2, :2]
    stance = Stance((np.array([[0.3, 0.12], [-0.1, -0.08]]) @ turn.T)[None], np.full((1, 2), 0.5))
    assert stance.width() == pytest.approx([0.2])
    moved = stance.moved(np.zeros(1, dtype=int), np.array([[1.0, 2.0]]))
    np.testing.assert_allclose(moved.xy, [[[1.0, 2.0], stance.xy[0, 1]]])
    assert moved.yaw[0] == pytest.approx([0.5, 0.5])
    np.testing.assert_allclose(moved.pos()[0], [[1.0, 2.0, 0.0], [*stance.xy[0, 1], 0.0]])


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
