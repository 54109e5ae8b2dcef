"""Simulation: what the manifest asks for reaches each simulation, against MuJoCo stepped by hand."""

import msgspec
import mujoco
import numpy as np
import pytest
from conftest import CalmRows

from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.evaluation.simulation import Simulation, State
from wbc_bench.robot import Robot, load_robot
from wbc_bench.rotations import wxyz_from_matrix

GRAVITY = 9.81  # [m/s^2]


@pytest.fixture(scope="module")
def disturbed(smoke: EvalProtocol) -> EpisodeManifest:
    """Episodes with everything drawn: friction, mass, gains, posture and velocities."""
    return read_manifest(smoke, manifest_path(find_protocol("smoke_v1")[1]))[0]


def commands(simulation: Simulation, seed: int = 0, spread: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = len(simulation.rows)
    return simulation.robot.default_q + rng.uniform(-spread, spread, (count, 14))


def everyone(simulation: Simulation) -> np.ndarray:
    return np.ones(len(simulation.rows), dtype=bool)


def same(a: State, b: State, rows: np.ndarray | slice = slice(None)) -> bool:
    return all(np.array_equal(x[rows], y[rows]) for x, y in zip(a, b, strict=True))


def edited_model(robot: Robot, rows: EpisodeManifest, i: int) -> mujoco.MjModel:
    """The model of episode i, each draw written where MuJoCo's documentation says it belongs."""
    model = robot.model()
    model.geom_friction[:, 0] = rows.friction[i]
    base = model.body("base_Link")
    base.inertia *= (base.mass[0] + rows.base_mass[i]) / base.mass[0]
    base.mass += rows.base_mass[i]
    for k in range(model.nu):
        model.actuator_gainprm[k, 0] = robot.kp[k] * rows.kp_scale[i, k]
        model.actuator_biasprm[k, 1] = -robot.kp[k] * rows.kp_scale[i, k]
        model.actuator_biasprm[k, 2] = -robot.kd[k] * rows.kd_scale[i, k]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def test_reset_is_what_the_manifest_says(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    simulation = Simulation(smoke, disturbed)
    state, robot, count = simulation.state(), simulation.robot, len(disturbed)
    np.testing.assert_array_equal(state.base_pos_w[:, :2], 0)
    np.testing.assert_array_equal(state.base_pos_w[:, 2], disturbed.base_height)
    np.testing.assert_array_equal(state.base_rot_w, np.tile(np.eye(3), (count, 1, 1)))
    np.testing.assert_array_equal(state.base_lin_vel_w, disturbed.base_vel[:, :3])
    np.testing.assert_array_equal(state.base_ang_vel_b, disturbed.base_vel[:, 3:])
    np.testing.assert_array_equal(state.joint_pos[:, :8], robot.default_q[:8] + disturbed.leg_q)
    np.testing.assert_array_equal(state.joint_pos[:, 8:], np.tile(robot.default_q[8:], (count, 1)))
    np.testing.assert_array_equal(state.joint_vel[:, :8], disturbed.leg_qd)
    np.testing.assert_array_equal(state.joint_vel[:, 8:], 0)
    assert not state.ground_contact.any() and not state.diverged.any()
    model = robot.model()
    data = mujoco.MjData(model)
    corners = [model.geom(f"foot_{side}_{k}") for side in "LR" for k in range(4)]
    for i in range(count):
        data.qpos[:] = [*state.base_pos_w[i], 1, 0, 0, 0, *state.joint_pos[i]]
        mujoco.mj_forward(model, data)
        lowest = min(data.geom(corner.id).xpos[2] - corner.size[0] for corner in corners)
        assert lowest == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(state.ee_pos_w[i], data.site("tcp").xpos, atol=1e-12)
        np.testing.assert_allclose(state.ee_rot_w[i].ravel(), data.site("tcp").xmat, atol=1e-12)


def test_bit_equal_to_mujoco_stepped_by_hand(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    """Friction, mass, gains, push and changing commands, over 0.2 s of each of the episodes."""
    simulation = Simulation(smoke, disturbed)
    robot, pushes = simulation.robot, np.random.default_rng(1).uniform(-0.5, 0.5, (len(disturbed), 2))
    targets = [commands(simulation, seed) for seed in range(10)]
    for step, target in enumerate(targets):
        if step == 4:
            simulation.push(pushes)
        simulation.step(target, everyone(simulation))
    state = simulation.state()
    for i in range(len(disturbed)):
        model = edited_model(robot, disturbed, i)
        data = mujoco.MjData(model)
        data.qpos[:] = [0, 0, disturbed.base_height[i], 1, 0, 0, 0, *robot.default_q]
        data.qpos[7:15] += disturbed.leg_q[i]
        data.qvel[:] = [*disturbed.base_vel[i], *disturbed.leg_qd[i], *np.zeros(6)]
        data.ctrl[:] = robot.default_q
        mujoco.mj_forward(model, data)
        for step, target in enumerate(targets):
            if step == 4:
                data.qvel[:2] += pushes[i]
            data.ctrl[:] = target[i]
            for _ in range(smoke.physics.decimation):
                mujoco.mj_step(model, data)
        mine = np.concatenate([state.base_pos_w[i], state.joint_pos[i]])
        np.testing.assert_array_equal(mine, np.delete(data.qpos, np.s_[3:7]))
        np.testing.assert_array_equal(state.base_lin_vel_w[i], data.qvel[:3])
        np.testing.assert_array_equal(state.joint_vel[i], data.qvel[6:])
        np.testing.assert_array_equal(state.joint_torque[i], data.actuator_force)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(state.ee_pos_w[i], data.site("tcp").xpos, atol=1e-12)  # not a step late
        np.testing.assert_allclose(state.base_rot_w[i].ravel(), data.body("base_Link").xmat, atol=1e-12)


@pytest.mark.parametrize("column", ["friction", "base_mass", "kp_scale", "kd_scale"])
def test_every_draw_matters(smoke: EvalProtocol, calm_rows: CalmRows, column: str) -> None:
    """Two episodes apart in one draw alone move apart; a third like the first does not."""
    sliding = np.tile([0.5, 0.2, 0, 0, 0, 0], (3, 1))
    values = getattr(calm_rows(3), column).copy()
    values[1] = values[1] * 0.5 if column != "base_mass" else 2.0
    simulation = Simulation(smoke, calm_rows(3, base_vel=sliding, **{column: values}))
    target = np.tile(commands(simulation)[:1], (3, 1))
    for _ in range(10):
        simulation.step(target, everyone(simulation))
    qpos = simulation.state().joint_pos
    assert np.abs(qpos[0] - qpos[1]).max() > 1e-5
    np.testing.assert_array_equal(qpos[0], qpos[2])


def test_push_adds_exactly_its_velocity(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    simulation = Simulation(smoke, disturbed)
    simulation.step(commands(simulation), everyone(simulation))
    before = simulation.state()
    push = np.random.default_rng(2).uniform(-1, 1, (len(disturbed), 2))
    push[0] = 0
    simulation.push(push)
    after = simulation.state()
    np.testing.assert_array_equal(after.base_lin_vel_w[:, :2], before.base_lin_vel_w[:, :2] + push)
    np.testing.assert_array_equal(after.base_lin_vel_w[:, 2], before.base_lin_vel_w[:, 2])
    rest = {"base_lin_vel_w": before.base_lin_vel_w}
    assert same(after._replace(**rest), before)


def test_a_subset_steps_alone(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    whole, part = Simulation(smoke, disturbed), Simulation(smoke, disturbed)
    target, some = commands(whole), np.arange(len(disturbed)) % 2 == 0
    for simulation in (whole, part):
        simulation.step(target, everyone(simulation))
    before = part.state()
    nonsense = np.where(some[:, None], target, np.nan)  # commands of the others are never read
    for _ in range(3):
        whole.step(target, everyone(whole))
        part.step(nonsense, some)
    assert same(part.state(), before, ~some)
    assert same(part.state(), whole.state(), some)
    part.step(target, ~some)
    part.step(target, ~some)
    part.step(target, ~some)
    assert same(part.state(), whole.state())  # and the pause has left no trace


def test_state_is_a_copy(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    simulation = Simulation(smoke, disturbed)
    state = simulation.state()
    kept = State._make(field.copy() for field in state)
    simulation.push(np.ones((len(disturbed), 2)))
    simulation.step(commands(simulation), everyone(simulation))
    assert same(state, kept)


def test_ground_carries_the_weight(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    """At rest, with gains so stiff that the robot is a statue (it topples on the nominal ones)."""
    rows = calm_rows(
        2, kp_scale=np.full((2, 14), 40.0), kd_scale=np.full((2, 14), 20.0), base_mass=np.array([0, 3.0])
    )
    simulation = Simulation(smoke, rows)
    target = np.tile(simulation.robot.default_q, (2, 1))
    for _ in range(100):
        simulation.step(target, everyone(simulation))
    state = simulation.state()
    weight = (simulation.robot.model().body_mass.sum() + rows.base_mass) * GRAVITY
    np.testing.assert_allclose(state.foot_force_w[:, :, 2].sum(axis=1), weight, rtol=0.01)
    assert (state.foot_force_w[:, :, 2] > 0.4 * weight[:, None]).all()  # up, on both feet
    assert np.abs(state.foot_force_w[:, :, :2].sum(axis=1)).max() < 0.02 * weight[0]
    assert not state.ground_contact.any()


def test_foot_force_changes_the_momentum(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    """Newton, at every physics step of a moving robot: contact force and weight change its momentum."""
    physics = msgspec.structs.replace(smoke.physics, decimation=1)
    rows = calm_rows(1, base_vel=np.array([[0.3, -0.2, 0, 0.5, 0.3, 0]]))
    simulation = Simulation(msgspec.structs.replace(smoke, physics=physics), rows)
    model = simulation.robot.model()
    data, mass, inertia = mujoco.MjData(model), model.body_mass.sum(), np.zeros((model.nv, model.nv))
    target, forces = commands(simulation), []

    def velocity(state: State) -> np.ndarray:
        return np.concatenate([state.base_lin_vel_w[0], state.base_ang_vel_b[0], state.joint_vel[0]])

    for _ in range(60):
        before = simulation.state()
        simulation.step(target, everyone(simulation))
        after = simulation.state()
        data.qpos[:] = [*before.base_pos_w[0], *wxyz_from_matrix(before.base_rot_w[0]), *before.joint_pos[0]]
        data.qvel[:] = velocity(before)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        # rows of the base's translation: total momentum; weight, with the Coriolis forces of the parts
        rate = inertia[:3] @ (velocity(after) - velocity(before)) / physics.timestep
        force = after.foot_force_w[0].sum(axis=0)
        forces.append(force)
        np.testing.assert_allclose(force - data.qfrc_bias[:3], rate, atol=1e-6 * mass * GRAVITY)
    assert np.abs(np.array(forces)[:, :2]).max() > 10  # [N] friction was at work too


def test_ground_contact_of_a_robot_on_its_side(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    spin = np.zeros((2, 6))
    spin[1, 3] = 5.0  # [rad/s] about the base's x axis
    simulation = Simulation(smoke, calm_rows(2, base_vel=spin))
    target = np.tile(simulation.robot.default_q, (2, 1))
    touched = np.zeros((2, 60), dtype=bool)
    for k in range(60):
        simulation.step(target, everyone(simulation))
        touched[:, k] = simulation.state().ground_contact
    assert not touched[0, :15].any()  # 0.3 s: still on its feet
    assert not touched[1, :5].any() and touched[1, -5:].all()
    state = simulation.state()
    assert state.base_rot_w[1, 2, 2] < 0.3 and state.base_pos_w[1, 2] < 0.3


def test_diverged(
    smoke: EvalProtocol, calm_rows: CalmRows, tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also when MuJoCo itself sees it first: it then resets to a robot that stands as if new."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    count = 5
    speed = np.zeros((count, 6))
    speed[1, 0] = 2e3  # [m/s] too fast to be true
    speed[2, 0] = 1e12  # beyond MuJoCo's own limit
    simulation, calm = (
        Simulation(smoke, calm_rows(count, base_vel=speed)),
        Simulation(smoke, calm_rows(count)),
    )
    np.testing.assert_array_equal(simulation.state().diverged, [False, True, True, False, False])
    target = commands(calm)
    absurd = target.copy()
    absurd[3, 5] = 1e300  # [rad] MuJoCo would replace all controls by zero
    for _ in range(3):
        simulation.step(absurd, everyone(simulation))
        calm.step(target, everyone(calm))
        np.testing.assert_array_equal(simulation.state().diverged, [False, True, True, True, False])
    assert np.isfinite(simulation.state().base_pos_w[2]).all()  # looks healthy, is not
    assert same(simulation.state(), calm.state(), np.array([0, 4]))
    assert not calm.state().diverged.any()


def test_two_simulations_of_one_robot_are_the_same(smoke: EvalProtocol, disturbed: EpisodeManifest) -> None:
    a, b = Simulation(smoke, disturbed), Simulation(smoke, disturbed)
    assert a.robot is load_robot(smoke.robot)
    for step in range(5):
        for simulation in (a, b):
            simulation.step(commands(simulation, step), everyone(simulation))
    assert same(a.state(), b.state())
