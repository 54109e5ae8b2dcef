"""The robot is its own mirror image, and so are what a policy sees and what it does."""

import mujoco
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from training_targets import coarse
from wbc_baselines.learned.training.backends.cpu import CpuBackend
from wbc_baselines.learned.training.environment import Environment
from wbc_baselines.learned.training.symmetry import critic_mirror, input_mirror, joint_mirror
from wbc_baselines.learned.training.target_set import TargetSet
from wbc_bench.robot import load_robot

ROBOT = load_robot()
M = np.diag([1.0, -1.0, 1.0])


def test_mirrored_joints_put_feet_and_hand_in_the_mirror():
    model, rng = ROBOT.model(), np.random.default_rng(0)

    def sites(joints):
        data = mujoco.MjData(model)
        data.qpos[:] = [0, 0, 0, 1, 0, 0, 0, *joints]
        mujoco.mj_kinematics(model, data)
        return {n: (data.site(n).xpos, data.site(n).xmat.reshape(3, 3)) for n in ("sole_L", "sole_R", "tcp")}

    for _ in range(5):
        joints = ROBOT.default_q + rng.uniform(-0.5, 0.5, 14)
        here, there = sites(joints), sites(joint_mirror(ROBOT)(joints))
        for name, image in (("sole_L", "sole_R"), ("sole_R", "sole_L"), ("tcp", "tcp")):
            np.testing.assert_allclose(there[image][0], M @ here[name][0], atol=2e-4)
            np.testing.assert_allclose(there[image][1], M @ here[name][1] @ M, atol=1e-6)


def one_target(side: float) -> Environment:
    """Two undisturbed robots at rest, asked to go to the same place on one side."""
    w, x, y, z = 0.9, 0.1, -0.2, 0.3
    quat = np.array([[w, side * x, y, side * z]], np.float32)
    pos = np.array([[0.4, 0.25 * side, 0.9]], np.float32)
    quat = (quat / np.linalg.norm(quat)).astype(np.float32)
    targets = TargetSet(
        np.arange(3, dtype=np.int8),
        np.tile(pos, (3, 1)),
        np.tile(quat, (3, 1)),
        np.empty((3, 21), np.float32),
    )
    protocol = coarse()
    return Environment(protocol, CpuBackend(protocol, 2, 1), targets, "gated", 0, disturbance_scale=0.0)


def test_mirrored_actions_lead_to_mirrored_observations():
    """Up to the hand's 0.1 mm, and half a millimetre of the centre of mass, that lie beside the plane."""
    left, right = one_target(1.0), one_target(-1.0)
    image, turn = input_mirror(ROBOT), joint_mirror(ROBOT)
    whole = critic_mirror(ROBOT)
    tolerance = np.full(67, 0.03)
    tolerance[20:34] = 0.4  # [rad/s] joint velocities, up to 6
    wide = np.concatenate([tolerance, np.full(107, 0.05)])
    wide[70:84], wide[84:98] = 1.0, 40.0  # [N m] up to 90, [rad/s^2] up to 300
    wide[102:105], wide[141:147] = 0.6, 2.0  # [rad/s] of the hand, [N] up to 80
    rng = np.random.default_rng(1)
    for env in (left, right):
        env.begin_rollout(0, 10)
    differ = False
    for _ in range(10):
        seen, other = left.observations.policy.numpy(), right.observations.policy.numpy()
        assert (np.abs(other - image(seen)) < tolerance).all()
        true, truth = left.observations.critic.numpy(), right.observations.critic.numpy()
        assert (np.abs(truth - whole(true)) < wide).all()
        differ |= bool((np.abs(other - seen) > 10 * tolerance).any())
        action = rng.normal(0.0, 0.3, (2, 14)).astype(np.float32)
        left.step(torch.from_numpy(action))
        right.step(torch.from_numpy(turn(action)))
    assert differ


def test_a_mirror_image_of_a_mirror_image_is_the_thing_itself():
    for mirror, size in ((critic_mirror(ROBOT), 174), (input_mirror(ROBOT), 67), (joint_mirror(ROBOT), 14)):
        x = np.random.default_rng(2).normal(size=(3, size)).astype(np.float32)
        np.testing.assert_array_equal(mirror(mirror(x)), x)
        assert not np.array_equal(mirror(x), x)
