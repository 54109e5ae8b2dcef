"""What an episode hides from its controller is in training what it is in an evaluation."""

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch import Tensor

from training_targets import TARGETS, coarse, manifest_of
from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.policy.controller import _privileged
from wbc_baselines.learned.training.backends.cpu import CpuBackend
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_baselines.learned.training.environment import PRIVILEGED_COLUMNS, Environment
from wbc_baselines.learned.training.make import training_protocol
from wbc_baselines.learned.training.resets import sample_episodes
from wbc_baselines.learned.training.sensing import command_age
from wbc_bench.controller import ControllerInfo, JointCommand
from wbc_bench.episodes import randomization
from wbc_bench.episodes.protocol import EvalProtocol, Noise, find_protocol
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.evaluation.delays import LateCommands, physics_steps
from wbc_bench.randomness import stream
from wbc_bench.robot import load_robot

DEPLOY = find_protocol("deploy_v1")[0]
N = 6


def environment(protocol: EvalProtocol, undisturbed: float = 0.0) -> Environment:
    return Environment(protocol, CpuBackend(protocol, N, 1), TARGETS, "gated", 0, undisturbed=undisturbed)


class Scripted:
    """Commands of a table, and what was observed before each."""

    info = ControllerInfo(
        "scripted", frozenset({"proprioception", "ee_pose", "base_pose", "privileged"}), 0.02, "test"
    )

    def __init__(self, commands: np.ndarray) -> None:
        self._commands, self.seen = commands, []

    def reset(self, episodes, obs, target) -> None:
        pass

    def act(self, obs, target) -> JointCommand:
        self.seen.append((obs, target))
        return JointCommand(self._commands[len(self.seen) - 1])


def test_an_episode_of_deploy_is_the_evaluations():
    """Delays, payload, strength, offsets, tilt and pushes: 15 control steps of 2 ms x 10 in both."""
    spread = msgspec.structs.replace(DEPLOY.randomization, odometry_drift=0.0)
    protocol = msgspec.structs.replace(DEPLOY, noise=Noise(), randomization=spread)
    env = environment(protocol)
    episode, reset = env._episode, env._resets
    episode.step.fill_(0)
    episode.push_step.fill_(-1)
    episode.push_step[:, 0], episode.push_vel[:, 0] = 4, torch.linspace(-0.4, 0.4, 6)
    rows = manifest_of(reset, np.zeros(N, np.int64))
    rows.target_pos_w[:] = episode.target_pos_w.numpy()
    delays = episode.delays.numpy() * protocol.physics.timestep
    rows.command_delay[:], rows.observation_delay[:], rows.odometry_delay[:] = delays.T
    assert (delays.max(axis=0) > (0.01, 0.005, 0.01)).all()
    rows.imu_tilt[:] = episode.hidden[:, 5:7].numpy()
    rows.push_time[:, 0] = 4 * protocol.control_period
    rows.push_vel[:, :2] = [-0.4, -0.24]
    rows.push_vel_z[:, 0] = -0.08
    rows.push_ang_vel[:, :3] = [0.08, 0.24, 0.4]
    steps = 15
    action = 0.3 * torch.randn(steps, N, 14, generator=torch.Generator().manual_seed(1))
    robot = load_robot(protocol.robot)
    controller = Scripted(robot.command_of(action.double().numpy()))
    loop = ControlLoop(controller, protocol, rows)
    loop.sensors._target_rot_w = episode.target_rot_w.double().numpy()
    env.begin_rollout(0, steps)
    run = loop.run()
    for k in range(steps):
        next(run)
        obs, target = controller.seen[k]
        body, hand, seen = obs.proprioception, obs.ee_pose, env.observations
        frame = [body.base_ang_vel_b, body.gravity_b, body.joint_pos - robot.default_q, body.joint_vel]
        frame += [body.joint_torque, hand.pos_b, hand.rot6_b]
        command = [target.pos_b, target.rot_b[..., 0], target.rot_b[..., 1]]
        tolerance = {"rtol": 1e-4, "atol": 2e-4, "err_msg": f"control step {k}"}
        np.testing.assert_allclose(seen.frame, np.concatenate(frame, axis=1), **tolerance)
        np.testing.assert_allclose(
            seen.policy[:, inputs.OBSERVATION :], np.concatenate(command, axis=1), **tolerance
        )
        known = _privileged(obs)
        known[:, 17:31] = seen.critic[:, PRIVILEGED_COLUMNS][
            :, 17:31
        ]  # accelerations, differences of float32
        tolerance["atol"] = 2e-3  # [N], [m/s]
        np.testing.assert_allclose(seen.critic[:, PRIVILEGED_COLUMNS], known, **tolerance)
        assert not env.step(action[k]).done.any()


def test_the_robot_that_is_hidden_is_not_the_nominal_one():
    """The same commands move a robot elsewhere once any one of the disturbances is left out."""
    action = 0.3 * torch.randn(8, N, 14, generator=torch.Generator().manual_seed(1))

    def positions(**changes) -> Tensor:
        spread = msgspec.structs.replace(DEPLOY.randomization, **changes)
        env = environment(coarse(DEPLOY, noise=Noise(), randomization=spread))
        env._episode.push_step.fill_(-1)
        env._episode.step.fill_(0)
        env.begin_rollout(0, 8)
        for row in action:
            env.step(row)
        return env._state.qpos

    everything = positions()
    for name, nothing in (
        ("command_delay", (0.0, 0.0)),
        ("payload", (0.0, 0.0)),
        ("motor_strength", (1.0, 1.0)),
        ("joint_offset", 0.0),
    ):
        assert not torch.allclose(positions(**{name: nothing}), everything, atol=1e-4), name


def test_a_command_acts_when_the_evaluations_does():
    rng = np.random.default_rng(0)
    for decimation in (2, 10):
        delay = rng.integers(0, 4 * decimation, 20)
        late = LateCommands(delay, decimation, np.full(1, -1.0))
        given = [np.full((20, 1), float(-1))] * 8
        for k in range(8):
            late.give(np.full((20, 1), float(k)))
            given.append(np.full((20, 1), float(k)))
            for offset in range(decimation):
                age = command_age(offset, torch.from_numpy(delay), decimation).numpy()
                mine = np.array([given[-1 - a][n] for n, a in enumerate(age)])
                np.testing.assert_array_equal(mine, late.acting(offset))


def test_draws_have_the_protocols_ranges():
    spread, count = DEPLOY.randomization, 800
    samples = sample_episodes(DEPLOY, TARGETS, count, stream(5, "test"))
    reset, tilt = samples.reset, samples.imu_tilt.norm(dim=1)
    for values, low, high in (
        (reset.payload, *spread.payload),
        (reset.payload_offset, -spread.payload_offset, spread.payload_offset),
        (reset.motor_strength, *spread.motor_strength),
        (reset.joint_offset, -spread.joint_offset, spread.joint_offset),
        (tilt, 0.0, spread.gravity_tilt),
        (samples.delays[:, 0], *physics_steps(np.array(spread.command_delay), 0.002)),
        (samples.delays[:, 1], *physics_steps(np.array(spread.observation_delay), 0.002)),
        (samples.delays[:, 2], *physics_steps(np.array(spread.odometry_delay), 0.002)),
        (samples.push_vel[..., 2], -DEPLOY.push.vertical_speed, DEPLOY.push.vertical_speed),
        (samples.push_vel[..., 3:], -DEPLOY.push.angular_speed, DEPLOY.push.angular_speed),
    ):
        assert low <= values.min() <= low + 0.02 * (high - low)
        assert high >= values.max() >= high - 0.02 * (high - low)
    assert (samples.noise_scale == 1).all()


def test_a_share_of_the_episodes_is_undisturbed():
    """They are what `nominal` draws, hidden parts included, and show no noise; the others are untouched."""
    count = 600
    mixed = sample_episodes(DEPLOY, TARGETS, count, stream(5, "test"), undisturbed=0.25)
    plain = sample_episodes(DEPLOY, TARGETS, count, stream(5, "test"))
    calm = mixed.noise_scale == 0
    assert 0.18 < calm.double().mean() < 0.32
    nominal = randomization.nominal(DEPLOY, 0, 0)
    for name, value in mixed.reset._asdict().items():
        expected = np.broadcast_to(getattr(nominal, name), value[calm].shape)
        np.testing.assert_array_equal(value[calm], expected, err_msg=name)
        np.testing.assert_array_equal(value[~calm], getattr(plain.reset, name)[~calm])
    assert (mixed.push_step[calm] == -1).all() and not mixed.push_vel[calm].any()
    assert not mixed.delays[calm].any() and not mixed.imu_tilt[calm].any()
    np.testing.assert_array_equal(mixed.delays[~calm], plain.delays[~calm])
    np.testing.assert_array_equal(mixed.target, plain.target)

    env = environment(coarse(DEPLOY), undisturbed=0.5)
    env.begin_rollout(0, 30)
    for _ in range(30):
        env.step(torch.zeros(N, 14))
    calm = env._episode.noise_scale == 0
    assert 0 < calm.sum() < N
    difference = (env.observations.policy - env.observations.critic[:, :67]).abs().amax(1)
    assert (difference[calm] < 1e-5).all() and (difference[~calm] > 0.01).all()
    assert (env._episode.odometry_error_w[calm] == 0).all()


def test_the_odometry_walks_and_takes_the_target_along():
    """Its error has the variance of the protocol's random walk, and shifts the target by as much."""
    spread = msgspec.structs.replace(DEPLOY.randomization, odometry_drift=0.03, odometry_delay=(0.0, 0.0))
    env = environment(coarse(DEPLOY, noise=Noise(), randomization=spread))
    env._episode.odometry_error_w[:] = torch.tensor([0.3, 0.0, 0.0])
    seen = env._observe()
    moved = seen.critic[:, 58:61] - seen.policy[:, 58:61]
    torch.testing.assert_close(moved, seen.critic[:, -3:], atol=1e-6, rtol=0)
    torch.testing.assert_close(moved.norm(dim=1), torch.full((N,), 0.3))
    env.begin_rollout(1, 2000)
    assert env._drift.std().item() == pytest.approx(0.03 * 0.02**0.5, rel=0.02)


def test_training_refuses_ground_that_it_cannot_build(tmp_path):
    path = tmp_path / "steep.toml"
    text = find_protocol("deploy_v1")[1].read_text().replace('name = "deploy_v1"', 'name = "steep"')
    path.write_text(text.replace("gravity_tilt = 0.035", "slope = 0.1"))
    with pytest.raises(TrainingError, match=r"slopes of up to 0\.1 rad .* valid for training: level ground"):
        training_protocol(TrainConfig("no_latent", protocol=str(path)))
    with pytest.raises(TrainingError, match=r"--undisturbed 1\.5: valid: 0 to 1"):
        TrainConfig("no_latent", undisturbed=1.5).check()
