"""`ik:arm` on a base that is held: it reaches against weight and soft drives, and waits where it cannot."""

import numpy as np

from wbc_baselines.ik.arm_only import PERIOD, ArmController
from wbc_bench.controller import Observation, Proprioception, Target
from wbc_bench.robot import RobotConfig, load_robot
from wbc_bench.robot.kinematics import ArmKinematics
from wbc_bench.rotations import geodesic_angle

ROBOT = load_robot(RobotConfig(variant="paper"))


def seen(joint_pos: np.ndarray) -> Observation:
    count = len(joint_pos)
    flat = np.zeros((count, 3)), np.tile([0.0, 0.0, -1.0], (count, 1))
    rest = np.zeros((count, 14))
    body = Proprioception(*flat, joint_pos, rest, rest)
    return Observation(0.0, np.ones(count, dtype=bool), body, None, None, None)


def follow(target: Target, seconds: float, sag: np.ndarray) -> np.ndarray:
    """Joint positions (N, 14) at last, of drives that lag 60 ms behind and hang by `sag` (6,) [rad]."""
    count = len(target.pos_b)
    q = np.tile(ROBOT.default_q, (count, 1))
    controller = ArmController(ROBOT)
    controller.reset(np.arange(count), seen(q), target)
    for _ in range(round(seconds / PERIOD)):
        command = controller.act(seen(q), target).q
        np.testing.assert_array_equal(command[:, :8], np.tile(ROBOT.default_q[:8], (count, 1)))
        assert ((command >= ROBOT.lower) & (command <= ROBOT.upper)).all()
        wanted = command.copy()
        wanted[:, 8:] += sag
        q = q + (wanted - q) * PERIOD / 0.06
    return q


def test_it_reaches_although_the_arm_hangs() -> None:
    arm, rng = ArmKinematics(ROBOT), np.random.default_rng(0)
    q = ROBOT.default_q[8:] + rng.uniform(-0.4, 0.4, (20, 6))
    pos, rot = arm.pose(np.clip(q, ROBOT.lower[8:] + 0.3, ROBOT.upper[8:] - 0.3))
    last = follow(Target(pos, rot), 8.0, np.array([0.0, 0.1, -0.1, 0.15, 0.0, 0.0]))
    got, turned = arm.pose(last[:, 8:])
    assert np.linalg.norm(got - pos, axis=1).max() < 2e-3
    assert geodesic_angle(turned, rot).max() < 1e-2


def test_out_of_reach_it_waits_in_its_default_posture() -> None:
    far = Target(np.array([[2.0, 0.0, 0.3]]), np.eye(3)[None])
    last = follow(far, 4.0, np.zeros(6))
    np.testing.assert_allclose(last, ROBOT.default_q[None], atol=1e-6)


def test_a_simulation_that_diverged_spoils_no_other() -> None:
    arm = ArmKinematics(ROBOT)
    pos, rot = arm.pose(np.tile(ROBOT.default_q[8:] + 0.1, (3, 1)))
    pos[1], rot[1] = np.nan, np.nan
    q = np.tile(ROBOT.default_q, (3, 1))
    q[1, 9] = np.nan
    controller, alone = ArmController(ROBOT), ArmController(ROBOT)
    controller.reset(np.arange(3), seen(q), Target(pos, rot))
    alone.reset(np.arange(1), seen(q[:1]), Target(pos[:1], rot[:1]))
    for _ in range(3):
        command = controller.act(seen(q), Target(pos, rot)).q
        np.testing.assert_array_equal(command[[0]], alone.act(seen(q[:1]), Target(pos[:1], rot[:1])).q)
