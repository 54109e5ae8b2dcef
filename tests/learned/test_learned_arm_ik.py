"""The arm's inverse kinematics: against MuJoCo, finite differences, and targets made from joints."""

import mujoco
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from wbc_baselines.learned.training.arm_ik import (
    MARGIN,
    ArmKinematics,
    cross_matrix,
    rotation_about,
    rotation_vector,
)
from wbc_bench.robot import NUM_LEG_JOINTS, RobotConfig, load_robot

ROBOT = load_robot()
ARM = ArmKinematics(ROBOT)
LOWER, UPPER = (torch.tensor(x[NUM_LEG_JOINTS:], dtype=torch.float32) for x in (ROBOT.lower, ROBOT.upper))
DEFAULT = torch.tensor(ROBOT.default_q[NUM_LEG_JOINTS:], dtype=torch.float32)


def postures(count: int, spread: float = 1.0):
    draw = torch.Generator().manual_seed(0)
    unit = torch.rand(count, 6, generator=draw)
    around = DEFAULT + spread * (LOWER + MARGIN + unit * (UPPER - LOWER - 2 * MARGIN) - DEFAULT)
    return around.clamp(LOWER + MARGIN, UPPER - MARGIN)


def posed(q) -> mujoco.MjData:
    """MuJoCo's robot at rest, its base turned, its arm at joints q (6,)."""
    model = ROBOT.model()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0.3, -0.2, 0.9, *np.array([0.8, 0.1, -0.5, 0.3]) / np.sqrt(0.99)]
    data.qpos[-6:] = q
    mujoco.mj_forward(model, data)
    return data


def test_the_hand_is_mujocos():
    for q in postures(20):
        data = posed(q)
        base = data.xmat[1].reshape(3, 3)
        site = data.site("tcp")
        pos, rot, _ = ARM.hand(q[None])
        np.testing.assert_allclose(pos[0], base.T @ (site.xpos - data.xpos[1]), atol=1e-5)
        np.testing.assert_allclose(rot[0], base.T @ site.xmat.reshape(3, 3), atol=1e-5)


def test_jacobian_by_finite_differences():
    q, step = postures(50), 3e-3
    _, _, jacobian = ARM.hand(q)
    for k in range(6):
        d = step * torch.nn.functional.one_hot(torch.tensor(k), 6)
        (pos, rot, _), (pos0, rot0, _) = ARM.hand(q + d), ARM.hand(q - d)
        torch.testing.assert_close((pos - pos0) / (2 * step), jacobian[:, :3, k], atol=3e-4, rtol=0)
        turned = rotation_vector(rot @ rot0.transpose(1, 2)) / (2 * step)
        torch.testing.assert_close(turned, jacobian[:, 3:, k], atol=3e-4, rtol=0)


def test_holding_torque_is_mujocos_bias_at_rest():
    for q in postures(20):
        data = posed(q)
        down = torch.tensor(-data.xmat[1].reshape(3, 3)[2], dtype=torch.float32)
        torque = ARM.holding_torque(q[None], down[None])
        np.testing.assert_allclose(torque[0], data.qfrc_bias[-6:], atol=1e-3)


@pytest.mark.parametrize("robot", [ROBOT, load_robot(RobotConfig(variant="paper"))])
def test_holding_torque_carries_a_payload(robot):
    """Its difference to that of an empty hand is what a weight at the place asks of the joints."""
    arm, model = ArmKinematics(robot), robot.model()
    data = mujoco.MjData(model)
    place, mass = np.array([0.05, -0.02, 0.03]), 1.5
    tcp = model.site("tcp").id
    link = int(model.site_bodyid[tcp])
    for q in postures(20):
        data.qpos[:7] = [0.3, -0.2, 0.9, *np.array([0.8, 0.1, -0.5, 0.3]) / np.sqrt(0.99)]
        data.qpos[-6:] = q
        mujoco.mj_forward(model, data)
        point = data.site_xpos[tcp] + data.xmat[link].reshape(3, 3) @ place
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, point, link)
        down = torch.tensor(-data.xmat[1].reshape(3, 3)[2], dtype=torch.float32)[None]
        load = torch.tensor([[mass]]), torch.tensor(place, dtype=torch.float32)[None]
        torque = arm.holding_torque(q[None], down, *load) - arm.holding_torque(q[None], down)
        np.testing.assert_allclose(torque[0], 9.81 * mass * jacobian[2, -6:], atol=1e-3)


def test_it_finds_poses_near_the_default_and_stays_inside_the_limits():
    wanted = postures(300, spread=0.4)
    pos, rot, _ = ARM.hand(wanted)
    q = ARM.solve(DEFAULT.expand(300, 6), torch.cat([pos, rot[:, :, 0], rot[:, :, 1]], -1))
    found, turned, _ = ARM.hand(q)
    near = torch.linalg.vector_norm(found - pos, dim=-1) < 0.01
    near &= torch.linalg.vector_norm(rotation_vector(rot @ turned.transpose(1, 2)), dim=-1) < 0.05
    assert near.float().mean() > 0.95
    far = ARM.solve(DEFAULT[None], torch.tensor([[3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]]))
    for found in (q, far):
        assert (found >= LOWER).all() and (found <= UPPER).all()
    assert ARM.hand(far)[0][0, 0] > ARM.hand(DEFAULT[None])[0][0, 0] + 0.2  # stretched towards it


def test_rotations_there_and_back():
    axis, angle = torch.tensor([0.6, 0.0, 0.8]), torch.linspace(-3.0, 3.0, 13)
    torch.testing.assert_close(
        rotation_vector(rotation_about(cross_matrix(axis), angle)), angle[:, None] * axis
    )
