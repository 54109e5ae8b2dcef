"""The follower: where it sends a walking base, and that the arm reaches the target from there."""

import numpy as np
import pytest

from wbc_bench.policies.follower import REACHED, Follower
from wbc_bench.robot import Robot, RobotConfig, load_robot
from wbc_bench.robot.kinematics import ArmKinematics
from wbc_bench.rotations import geodesic_angle, matrix_from_rotvec, matrix_from_rpy

PERIOD = 0.02  # [s]


def follower(robot: Robot, gain: float = 1.0, tolerance: tuple[float, float] = (0.0, 0.0)) -> Follower:
    return Follower(robot, gain, (0.5, 0.3, 0.6), tolerance)


def targets(robot: Robot, seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Hand poses of an arm whose base stands up to 3 m away, turned anyhow, at the present height."""
    rng = np.random.default_rng(seed)
    spread = np.array([0.4, 0.3, 0.3, 0.3, 0.3, 0.3])
    q = robot.default_q[8:] + rng.uniform(-spread, spread, (count, 6))
    pos, rot = ArmKinematics(robot).pose(q)
    yaw = rng.uniform(-np.pi, np.pi, count)
    turn = matrix_from_rpy(np.column_stack([0 * yaw, 0 * yaw, yaw]))
    place = np.column_stack([rng.uniform(-3, 3, (count, 2)), np.zeros(count)])
    return np.einsum("nij,nj->ni", turn, pos) + place, turn @ rot


def walk(one: Follower, pos: np.ndarray, rot: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """The targets as an ideal walker sees them at last, in its heading frame."""
    one.start(pos, rot)
    for _ in range(round(seconds / PERIOD)):
        step = PERIOD * one.command(pos, rot)
        back = matrix_from_rpy(-step * np.array([0.0, 0.0, 1.0]))
        pos = np.einsum("nij,nj->ni", back, pos - step * np.array([1.0, 1.0, 0.0]))
        rot = back @ rot
    return pos, rot


@pytest.mark.parametrize("robot", [RobotConfig(), RobotConfig(variant="paper")], ids=lambda c: c.variant)
def test_a_walker_arrives_where_the_arm_reaches(robot: RobotConfig) -> None:
    here = load_robot(robot)
    arm, (pos, rot) = ArmKinematics(here), targets(here, 0, 30)
    pos, rot = walk(follower(here), pos, rot, 25.0)
    q = arm.solve(np.tile(here.default_q[8:], (30, 1)), pos, rot, 80, 0.05)
    got, turned = arm.pose(q)
    reached = np.linalg.norm(got - pos, axis=1) < 2 * REACHED[0]
    assert (reached & (geodesic_angle(turned, rot) < 2 * REACHED[1])).mean() > 0.9
    assert (np.linalg.norm(pos[:, :2] - arm.root[:2], axis=1) < 0.75).all()


def test_a_target_in_reach_asks_for_no_step() -> None:
    robot = load_robot()
    pos, rot = ArmKinematics(robot).pose(robot.default_q[None, 8:])
    one = follower(robot)
    one.start(pos, rot)
    np.testing.assert_allclose(one.command(pos, rot), 0.0, atol=1e-12)
    # the base drifted 0.1 m forward and turned by 0.2 rad: back, by hand
    turn = matrix_from_rotvec(np.array([[0.0, 0.0, -0.2]]))
    drifted = np.einsum("nij,nj->ni", turn, pos - [0.1, 0.0, 0.0])
    expected = [[-0.1 * np.cos(0.2), 0.1 * np.sin(0.2), -0.2]]
    np.testing.assert_allclose(one.command(drifted, turn @ rot), expected, atol=1e-12)
    still = follower(robot, tolerance=(0.2, 0.3))
    still.start(pos, rot)
    np.testing.assert_array_equal(still.command(drifted, turn @ rot), 0.0)
    np.testing.assert_allclose(
        still.command(pos + np.array([2.0, 0.0, 0.0]), rot), [[0.5, 0.0, 0.0]], atol=1e-12
    )


def test_robots_do_not_depend_on_each_other() -> None:
    robot = load_robot()
    pos, rot = targets(robot, 1, 12)
    together, alone = follower(robot), follower(robot)
    together.start(pos, rot)
    all_of_them = together.command(pos, rot)
    for k in range(12):
        alone.start(pos[k : k + 1], rot[k : k + 1])
        np.testing.assert_array_equal(alone.command(pos[k : k + 1], rot[k : k + 1])[0], all_of_them[k])
