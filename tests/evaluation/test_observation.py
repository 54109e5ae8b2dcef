"""Observations: only what is declared, noise of the right size that belongs to the episode, frames."""

import dataclasses

import numpy as np
import pytest
from conftest import CalmRows

from wbc_bench.controller import SIGNALS, Observation, Signal
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.observation import Sensors
from wbc_bench.evaluation.simulation import State
from wbc_bench.rotations import geodesic_angle, matrix_from_rotvec, matrix_from_rpy, matrix_from_wxyz, rho6

COUNT = 4
ALL = frozenset(SIGNALS)
NOISE = {  # field of the protocol -> the measurement
    "base_ang_vel": lambda obs: obs.proprioception.base_ang_vel_b,
    "gravity": lambda obs: obs.proprioception.gravity_b,
    "joint_pos": lambda obs: obs.proprioception.joint_pos,
    "joint_vel": lambda obs: obs.proprioception.joint_vel,
    "joint_torque": lambda obs: obs.proprioception.joint_torque,
    "ee_pos": lambda obs: obs.ee_pose.pos_b,
    "ee_rot": lambda obs: obs.ee_pose.rot6_b,
}


@pytest.fixture
def rows(calm_rows: CalmRows) -> EpisodeManifest:
    rng = np.random.default_rng(1)
    quat = rng.normal(size=(COUNT, 4))
    return calm_rows(
        COUNT,
        noise_key=rng.integers(2**63 - 1, size=COUNT),
        noise_scale=np.ones(COUNT),
        target_pos_w=rng.normal(size=(COUNT, 3)),
        target_quat_w=quat / np.linalg.norm(quat, axis=1, keepdims=True),
    )


def random_state(seed: int = 0, count: int = COUNT) -> State:
    rng = np.random.default_rng(seed)
    return State(
        base_pos_w=rng.normal(size=(count, 3)),
        base_rot_w=matrix_from_rpy(rng.uniform(-3, 3, (count, 3))),
        base_lin_vel_w=rng.normal(size=(count, 3)),
        base_ang_vel_b=rng.normal(size=(count, 3)),
        joint_pos=rng.normal(size=(count, 14)),
        joint_vel=rng.normal(size=(count, 14)),
        joint_torque=rng.normal(size=(count, 14)),
        ee_pos_w=rng.normal(size=(count, 3)),
        ee_rot_w=matrix_from_rpy(rng.uniform(-3, 3, (count, 3))),
        foot_pos_w=rng.normal(size=(count, 2, 3)),
        foot_force_w=rng.normal(size=(count, 2, 3)),
        ground_contact=np.zeros(count, dtype=bool),
        diverged=np.zeros(count, dtype=bool),
    )


def observe(
    protocol: EvalProtocol, rows: EpisodeManifest, step: int, state: State, signals=ALL
) -> Observation:
    return Sensors(protocol, rows, signals).observe(step, 0.02 * step, state, np.ones(len(rows), dtype=bool))


def measured(obs: Observation) -> dict[str, np.ndarray]:
    return {name: read(obs) for name, read in NOISE.items()}


@pytest.mark.parametrize("signal", SIGNALS)
def test_undeclared_signals_are_none(smoke: EvalProtocol, rows: EpisodeManifest, signal: Signal) -> None:
    obs = observe(smoke, rows, 0, random_state(), frozenset({signal}))
    for name in SIGNALS:
        assert (getattr(obs, name) is not None) == (name == signal)
    nothing = observe(smoke, rows, 3, random_state(), frozenset())
    assert all(getattr(nothing, name) is None for name in SIGNALS)
    assert nothing.time == pytest.approx(0.06)


def test_noise_is_uniform_within_its_half_widths(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    sensors, state, active = Sensors(smoke, rows, ALL), random_state(), np.ones(COUNT, dtype=bool)
    calm = dataclasses.replace(rows, noise_scale=np.zeros(COUNT))
    truth = measured(observe(smoke, calm, 0, state))
    steps = [measured(sensors.observe(k, 0.02 * k, state, active)) for k in range(smoke.num_steps + 1)]
    for name, exact in truth.items():
        half = getattr(smoke.noise, name)
        noise = np.array([step[name] for step in steps]) - exact  # (T + 1, N, width)
        assert np.abs(noise).max() <= half * (1 + 1e-9), name
        assert np.abs(noise).max() > 0.98 * half, name
        # a uniform draw has standard deviation half / sqrt(3); five of them for the mean
        assert abs(noise.mean()) < 5 * half / np.sqrt(3 * noise.size), name
        assert noise.std() == pytest.approx(half / np.sqrt(3), rel=0.05), name
        lag = (noise[1:] * noise[:-1]).mean() / noise.var()
        assert abs(lag) < 5 / np.sqrt(noise.size), f"{name}: steps are not independent"
        both = noise.reshape(len(noise), COUNT, -1)
        apart = (both[:, 0] * both[:, 1]).mean() / noise.var()
        assert abs(apart) < 5 / np.sqrt(both[:, 0].size), f"{name}: episodes are not independent"


def test_without_noise_measurements_are_exact(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    state = random_state()
    obs = observe(smoke, dataclasses.replace(rows, noise_scale=np.zeros(COUNT)), 7, state)
    assert obs.proprioception and obs.ee_pose
    np.testing.assert_array_equal(obs.proprioception.base_ang_vel_b, state.base_ang_vel_b)
    np.testing.assert_array_equal(obs.proprioception.joint_pos, state.joint_pos)
    np.testing.assert_array_equal(obs.proprioception.joint_vel, state.joint_vel)
    np.testing.assert_array_equal(obs.proprioception.joint_torque, state.joint_torque)
    for i in range(COUNT):
        rot_w = state.base_rot_w[i]
        np.testing.assert_allclose(obs.proprioception.gravity_b[i], rot_w.T @ [0, 0, -1], atol=1e-15)
        np.testing.assert_allclose(
            rot_w @ obs.ee_pose.pos_b[i] + state.base_pos_w[i], state.ee_pos_w[i], atol=1e-14
        )
        np.testing.assert_allclose(obs.ee_pose.rot6_b[i], rho6(rot_w.T @ state.ee_rot_w[i]), atol=1e-15)


def test_noise_belongs_to_the_episode(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    """The same for the same episode, whoever shares its batch, in whatever order, and however often."""
    state, chosen = random_state(), np.array([2, 0])
    part = State._make(field[chosen] for field in state)
    for step in (0, 5, smoke.num_steps):
        whole = measured(observe(smoke, rows, step, state))
        again = measured(observe(smoke, rows, step, state))
        fewer = measured(observe(smoke, rows.take(chosen), step, part))
        for name in NOISE:
            np.testing.assert_array_equal(whole[name], again[name])
            np.testing.assert_array_equal(whole[name][chosen], fewer[name])


def test_noise_does_not_depend_on_what_else_is_declared(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    state = random_state()
    alone = observe(smoke, rows, 4, state, frozenset({"ee_pose"})).ee_pose
    beside = observe(smoke, rows, 4, state).ee_pose
    assert alone and beside
    np.testing.assert_array_equal(alone.pos_b, beside.pos_b)


def test_noise_leaves_truth_alone(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    state = random_state()
    obs = observe(smoke, rows, 3, state)
    for mine, before in zip(state, random_state(), strict=True):
        np.testing.assert_array_equal(mine, before)
    assert obs.base_pose and obs.privileged  # what simulation alone knows is not measured, so not noisy
    np.testing.assert_array_equal(obs.base_pose.pos_w, state.base_pos_w)
    np.testing.assert_array_equal(obs.base_pose.lin_vel_w, state.base_lin_vel_w)
    np.testing.assert_array_equal(obs.privileged.foot_force_w, state.foot_force_w)
    np.testing.assert_array_equal(obs.privileged.kp_scale, rows.kp_scale)
    speed_w = np.einsum("nij,nj->ni", state.base_rot_w, obs.privileged.base_lin_vel_b)
    np.testing.assert_allclose(speed_w, state.base_lin_vel_w, atol=1e-14)


def test_gravity_points_down_where_the_base_says_down_is(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    calm = dataclasses.replace(rows, noise_scale=np.zeros(COUNT))
    yawed = matrix_from_rpy(np.array([[0, 0, yaw] for yaw in (0.0, 1.0, -2.0, 3.0)]))
    obs = observe(smoke, calm, 0, random_state()._replace(base_rot_w=yawed)).proprioception
    assert obs
    np.testing.assert_allclose(obs.gravity_b, np.tile([0, 0, -1], (COUNT, 1)), atol=1e-15)
    # nose down by a right angle about +y: the base's x axis points to the ground
    pitched = matrix_from_rpy(np.tile([0, np.pi / 2, 0.4], (COUNT, 1)))
    obs = observe(smoke, calm, 0, random_state()._replace(base_rot_w=pitched)).proprioception
    assert obs
    np.testing.assert_allclose(obs.gravity_b, np.tile([1, 0, 0], (COUNT, 1)), atol=1e-15)


def test_target_moves_with_the_base(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    sensors = Sensors(smoke, rows, frozenset())
    for seed in range(5):
        state = random_state(seed)
        target = sensors.target(state)
        pos_w = np.einsum("nij,nj->ni", state.base_rot_w, target.pos_b) + state.base_pos_w
        np.testing.assert_allclose(pos_w, rows.target_pos_w, atol=1e-14)
        rot_w = state.base_rot_w @ target.rot_b
        np.testing.assert_allclose(rot_w, matrix_from_wxyz(rows.target_quat_w), atol=1e-14)


def test_target_errors_are_the_same_in_both_frames(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    state = random_state()
    target = Sensors(smoke, rows, frozenset()).target(state)
    ee_rot_b = np.swapaxes(state.base_rot_w, 1, 2) @ state.ee_rot_w
    expected = geodesic_angle(state.ee_rot_w, matrix_from_wxyz(rows.target_quat_w))
    np.testing.assert_allclose(geodesic_angle(ee_rot_b, target.rot_b), expected, atol=1e-12)


def test_active_is_a_copy(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    active = np.ones(COUNT, dtype=bool)
    obs = Sensors(smoke, rows, frozenset()).observe(0, 0.0, random_state(), active)
    active[:] = False
    assert obs.active.all()


def test_privileged_rates_are_those_of_the_motion(smoke: EvalProtocol, rows: EpisodeManifest) -> None:
    """A known twist of the end-effector and known accelerations over one period; zero at the start."""
    period, before = smoke.control_period, random_state()
    rng = np.random.default_rng(5)
    lin_w, ang_w, acc = rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 14))
    after = random_state(1)._replace(
        ee_pos_w=before.ee_pos_w + lin_w * period,
        ee_rot_w=matrix_from_rotvec(ang_w * period) @ before.ee_rot_w,
        joint_vel=before.joint_vel + acc * period,
    )
    sensors, active = Sensors(smoke, rows, ALL), np.ones(COUNT, dtype=bool)
    first = sensors.observe(0, 0.0, before, active).privileged
    second = sensors.observe(1, period, after, active).privileged
    assert first is not None and second is not None
    for still in (first.joint_acc, first.ee_lin_vel_b, first.ee_ang_vel_b):
        assert not still.any()
    np.testing.assert_allclose(second.joint_acc, acc)
    for row, rot_w in enumerate(after.base_rot_w):
        np.testing.assert_allclose(rot_w @ second.ee_lin_vel_b[row], lin_w[row])
        np.testing.assert_allclose(rot_w @ second.ee_ang_vel_b[row], ang_w[row], rtol=1e-3)
        for foot in range(2):
            world = after.base_pos_w[row] + rot_w @ second.foot_pos_b[row, foot]
            np.testing.assert_allclose(world, after.foot_pos_w[row, foot])
    np.testing.assert_array_equal(second.joint_torque, after.joint_torque)
