"""What the later columns of a manifest do to an episode, each alone, against what it should do by hand."""

from collections.abc import Callable

import msgspec
import mujoco
import numpy as np
import pytest
from conftest import CalmRows

from wbc_bench.controller import SIGNALS
from wbc_bench.episodes.manifest import EpisodeManifest, neutral
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.randomization import resting_height, sample
from wbc_bench.episodes.world import _IDLE, PAYLOAD, world_model
from wbc_bench.evaluation.observation import Sensors
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.robot import RobotConfig, load_robot
from wbc_bench.rotations import geodesic_angle, matrix_from_rotvec

ALL = frozenset(SIGNALS)


def with_ranges(protocol: EvalProtocol, **ranges: object) -> EvalProtocol:
    spread = msgspec.structs.replace(protocol.randomization, **ranges)
    return msgspec.structs.replace(protocol, randomization=spread)


def on_paper(protocol: EvalProtocol) -> EvalProtocol:
    return msgspec.structs.replace(protocol, robot=RobotConfig(variant="paper"))


def moved(protocol: EvalProtocol, rows: EpisodeManifest, seconds: float = 0.2):
    """State after the default posture was commanded for a while."""
    simulation = Simulation(protocol, rows)
    command = np.tile(simulation.robot.default_q, (len(rows), 1))
    active = np.ones(len(rows), dtype=bool)
    for _ in range(round(seconds / protocol.control_period)):
        simulation.step(command, active)
    return simulation.state()


def test_a_payload_is_a_point_mass_in_the_hand(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    """In the air, the payload's weight at the hand is what the arm's gravity torques grow by."""
    protocol = on_paper(with_ranges(smoke, payload=(0.0, 2.0)))
    robot, offset = load_robot(protocol.robot), np.array([0.03, -0.02, 0.01])
    rows = calm_rows(2, payload=np.array([0.0, 1.5]), payload_offset=np.stack([np.zeros(3), offset]))
    simulation = Simulation(protocol, rows)
    model = simulation._batch.get_model(1)
    assert model.body_mass.sum() == pytest.approx(world_model(protocol).body_mass.sum() + 1.5)
    data, plain = mujoco.MjData(model), robot.model()
    data.qpos[2], data.qpos[7:] = 1.5, robot.default_q
    empty = mujoco.MjData(plain)
    empty.qpos[:] = data.qpos
    mujoco.mj_forward(model, data)
    mujoco.mj_forward(plain, empty)
    point = empty.site("tcp").xpos + empty.site("tcp").xmat.reshape(3, 3) @ offset
    jacobian = np.zeros((3, plain.nv))
    mujoco.mj_jac(plain, empty, jacobian, None, point, plain.body("arm_link6").id)
    weight = jacobian.T @ [0, 0, 1.5 * 9.81]
    np.testing.assert_allclose(data.qfrc_bias - empty.qfrc_bias, weight, atol=1e-9)
    assert model.body(PAYLOAD).mass[0] == 1.5


def test_protocols_without_payload_and_bumps_have_the_robot_s_own_model(smoke: EvalProtocol) -> None:
    def dump(model: mujoco.MjModel) -> bytes:
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        return buffer.tobytes()

    model = load_robot(smoke.robot).model(smoke.physics.timestep)
    model.opt.disableflags |= _IDLE
    assert dump(world_model(smoke)) == dump(model)


@pytest.mark.parametrize("uneven", [False, True])
def test_what_is_switched_off_in_the_engine_changes_no_bit(
    smoke: EvalProtocol, calm_rows: CalmRows, monkeypatch: pytest.MonkeyPatch, uneven: bool
) -> None:
    protocol = with_ranges(smoke, payload=(0.0, 2.0), step_height=0.02 if uneven else 0.0)
    pushed = np.linspace(0.0, 1.5, 8)[:, None] * [1.0, 0.5]  # some lie on the ground before others
    rows = calm_rows(8, payload=np.linspace(0, 2, 8))
    states = []
    for off in (_IDLE, 0):
        monkeypatch.setattr("wbc_bench.episodes.world._IDLE", off)
        simulation, active = Simulation(protocol, rows), np.ones(8, dtype=bool)
        simulation.push(pushed)
        command = np.tile(simulation.robot.default_q, (8, 1))
        for _ in range(29):
            simulation.step(command, active)
        state = simulation.step(command, active)
        states.append(np.concatenate([simulation.qpos.ravel(), state.foot_force_w.ravel()]).tobytes())
        assert state.ground_contact.any() and not state.ground_contact.all()
    assert states[0] == states[1]


def test_motor_strength_scales_the_torque_limits(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    for protocol in (smoke, on_paper(smoke)):
        simulation = Simulation(protocol, calm_rows(2, motor_strength=np.array([1.0, 0.5])))
        far = np.tile(simulation.robot.upper + 5.0, (2, 1))
        state = simulation.step(far, np.ones(2, dtype=bool))
        assert state.joint_torque[1].max() <= 0.5 * simulation.robot.effort.max() + 1e-9
        limits = simulation._batch.get_model(1).actuator_forcerange
        np.testing.assert_allclose(limits, 0.5 * np.outer(simulation.robot.effort, [-1, 1]))


@pytest.mark.parametrize("build", [lambda p: p, on_paper], ids=["limx_adapter", "paper"])
def test_gains_reach_both_kinds_of_motor(
    smoke: EvalProtocol, calm_rows: CalmRows, build: Callable[[EvalProtocol], EvalProtocol]
) -> None:
    protocol, rng = build(smoke), np.random.default_rng(1)
    kp, kd = rng.uniform(0.8, 1.2, (1, 14)), rng.uniform(0.8, 1.2, (1, 14))
    simulation = Simulation(protocol, calm_rows(1, kp_scale=kp, kd_scale=kd))
    robot, model = simulation.robot, simulation._batch.get_model(0)
    data = mujoco.MjData(model)
    data.qpos[7:], data.qvel[6:] = robot.default_q, 0.1 * rng.normal(size=14)
    data.ctrl[:] = robot.default_q + 0.01 * rng.normal(size=14)
    mujoco.mj_forward(model, data)
    expected = kp[0] * robot.kp * (data.ctrl - robot.default_q) - kd[0] * robot.kd * data.qvel[6:]
    np.testing.assert_allclose(data.actuator_force, expected, atol=1e-9)


def test_the_pd_loop_trusts_encoders_that_are_off(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    """Their offset acts as a command that is off by as much the other way, and shows in what they say."""
    offset = np.zeros((2, 14))
    offset[1, 8:] = [0.05, -0.04, 0.03, 0.05, -0.05, 0.04]
    rows = calm_rows(2, joint_offset=offset)
    simulation, by_hand = Simulation(smoke, rows), Simulation(smoke, calm_rows(2))
    command, active = np.tile(simulation.robot.default_q, (2, 1)), np.ones(2, dtype=bool)
    for _ in range(10):
        simulation.step(command, active)
        by_hand.step(command - offset, active)
    state, other = simulation.state(), by_hand.state()
    np.testing.assert_array_equal(state.joint_pos, other.joint_pos)
    assert np.abs(state.joint_pos[0] - state.joint_pos[1]).max() > 0.02
    sensors = Sensors(smoke, rows, ALL)
    seen = sensors.observe(0, 0.0, state, np.ones(2, dtype=bool))
    assert seen.proprioception is not None and seen.ee_pose is not None
    noise = Sensors(smoke, calm_rows(2), ALL).observe(0, 0.0, state, np.ones(2, dtype=bool))
    assert noise.proprioception is not None and noise.ee_pose is not None
    np.testing.assert_allclose(
        seen.proprioception.joint_pos - noise.proprioception.joint_pos, offset, atol=1e-12
    )
    # the encoders place the hand: right without an offset, centimetres away with one
    apart = np.linalg.norm(seen.ee_pose.pos_b - noise.ee_pose.pos_b, axis=1)
    assert apart[0] < 1e-9 and 0.005 < apart[1] < 0.1


def test_a_tilted_imu_turns_gravity_and_gyro(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    tilt = np.array([[0.0, 0.0], [0.05, 0.0]])
    rows = calm_rows(2, imu_tilt=tilt, base_vel=np.tile([0, 0, 0, 0.1, 0.2, 0.3], (2, 1)))
    state = Simulation(smoke, rows).state()
    seen = Sensors(smoke, rows, ALL).observe(0, 0.0, state, np.ones(2, dtype=bool)).proprioception
    assert seen is not None
    np.testing.assert_allclose(seen.gravity_b[0], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(seen.gravity_b[1], [0, -np.sin(0.05), -np.cos(0.05)], atol=1e-12)
    turned = matrix_from_rotvec(np.array([0.05, 0, 0])).T @ [0.1, 0.2, 0.3]
    np.testing.assert_allclose(seen.base_ang_vel_b[1], turned, atol=1e-12)


def test_odometry_drifts_as_a_random_walk_and_moves_the_target(
    smoke: EvalProtocol, calm_rows: CalmRows
) -> None:
    count, drift = 200, 0.02
    rows = calm_rows(count, odometry_drift=np.full(count, drift), noise_key=np.arange(count))
    sensors, state = Sensors(smoke, rows, ALL), Simulation(smoke, rows).state()
    here = Sensors(smoke, calm_rows(count), ALL).target(state)
    np.testing.assert_array_equal(sensors.target(state, 0).pos_b, here.pos_b)
    seconds = 2.0
    off = sensors.target(state, round(seconds / smoke.control_period)).pos_b - here.pos_b
    assert np.std(off) == pytest.approx(drift * np.sqrt(seconds), rel=0.1)  # 600 draws: 3 % of it
    few = rows.take(slice(3, 5))
    again = Sensors(smoke, few, ALL).target(
        Simulation(smoke, few).state(), round(seconds / smoke.control_period)
    )
    np.testing.assert_array_equal(again.pos_b - here.pos_b[3:5], off[3:5])  # of the episode, not of the batch


def test_pushes_lift_and_turn(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    simulation = Simulation(smoke, calm_rows(1))
    simulation.push(np.array([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]]))
    state = simulation.state()
    np.testing.assert_allclose(state.base_lin_vel_w[0], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(state.base_ang_vel_b[0], [0.4, 0.5, 0.6])


def test_ground_slopes_and_soles_touch_it_at_reset(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    """The lowest corner touches, none is below; and later the robot leans as the ground does."""
    slope = np.array([0.06, -0.08])
    height = resting_height(smoke.robot, np.zeros(8), slope)
    rows = calm_rows(1, slope=slope[None], base_height=np.array([height]))
    simulation = Simulation(smoke, rows)
    model = simulation._batch.get_model(0)
    data = mujoco.MjData(model)
    data.qpos[:] = simulation.qpos[0]
    mujoco.mj_kinematics(model, data)
    ground = data.geom("ground").xmat.reshape(3, 3)
    np.testing.assert_allclose(ground, matrix_from_rotvec(np.array([*slope, 0])), atol=1e-9)
    corners = [model.geom(f"foot_{side}_{k}") for side in "LR" for k in range(4)]
    gaps = [data.geom(c.id).xpos @ ground[:, 2] - c.size[0] for c in corners]
    assert min(gaps) == pytest.approx(0, abs=1e-9)
    lean = moved(smoke, rows, 0.3).foot_pos_w[0]
    normal = np.cross(lean[0] - lean[1], [0, 0, 1])
    assert abs(normal @ [0, 0, 1]) < 1e-9  # the feet are apart
    assert (lean @ ground[:, 2] < 0.02).all()


def test_bumps_hold_the_robot_up(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    protocol = with_ranges(smoke, step_height=0.03)
    offsets = np.array([[0.0, 0.0], [0.7, -1.3], [-2.0, 0.4]])
    heights = [resting_height(smoke.robot, np.zeros(8), None, 0.03, offset) for offset in offsets]
    flat = resting_height(smoke.robot, np.zeros(8))
    assert all(flat <= height <= flat + 0.03 + 1e-9 for height in heights)
    rows = calm_rows(3, terrain_offset=offsets, base_height=np.array(heights))
    state = Simulation(protocol, rows).state()
    assert not state.ground_contact.any() and (state.foot_force_w[..., 2] <= 1.0).all()  # above it
    state = moved(protocol, rows, 0.1)
    assert (state.foot_force_w[..., 2].sum(axis=1) > 50).all()  # upon it
    assert (state.foot_pos_w[..., 2] > -0.01).all()


def test_new_draws_leave_the_old_ones_as_they_are(smoke: EvalProtocol) -> None:
    """Each has its own stream and its range; a protocol without them draws the neutral values."""
    loud = with_ranges(
        smoke,
        command_delay=(0.0, 0.02),
        observation_delay=(0.0, 0.01),
        odometry_delay=(0.0, 0.05),
        odometry_drift=0.01,
        payload=(0.0, 1.0),
        payload_offset=0.03,
        motor_strength=(0.85, 1.1),
        joint_offset=0.02,
        gravity_tilt=0.03,
        slope=0.05,
        step_height=0.02,
    )
    push = msgspec.structs.replace(loud.push, vertical_speed=0.1, angular_speed=0.2)
    loud = msgspec.structs.replace(loud, push=push)
    later = neutral(1)
    for episode in range(20):
        quiet, drawn = sample(smoke, 0, episode)._asdict(), sample(loud, 0, episode)._asdict()
        for name in quiet.keys() - later.keys() - {"base_height"}:  # the ground is another
            np.testing.assert_array_equal(quiet[name], drawn[name])
        for name in later:
            np.testing.assert_array_equal(quiet[name], later[name][0])
        assert 0 <= drawn["command_delay"] <= 0.02 and 0 <= drawn["payload"] <= 1
        assert 0.85 <= drawn["motor_strength"] <= 1.1 and np.abs(drawn["joint_offset"]).max() <= 0.02
        assert np.linalg.norm(drawn["imu_tilt"]) <= 0.03 and np.linalg.norm(drawn["slope"]) <= 0.05
        pushed = np.isfinite(drawn["push_time"])
        assert (np.abs(drawn["push_vel_z"]) <= 0.1).all() and (drawn["push_vel_z"][~pushed] == 0).all()
        assert (drawn["push_ang_vel"].reshape(-1, 3)[~pushed] == 0).all()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("[randomization]\ncommand_delay = [-0.01, 0.0]", r">= 0.0.*command_delay"),
        ("[randomization]\ncommand_delay = [0.0, 0.5]", r"<= 0.2.*command_delay"),
        (
            "[randomization]\nobservation_delay = [0.02, 0.01]",
            r"0.02 is above high 0.01.*observation",
        ),
        ("[randomization]\npayload = [-1.0, 0.0]", r">= 0.0.*payload"),
        ("[randomization]\nmotor_strength = [0.0, 1.0]", r"> 0.0.*motor_strength"),
        ("[randomization]\ngravity_tilt = 0.7", r"<= 0.5.*gravity_tilt"),
        ("[randomization]\nstep_height = -0.1", r">= 0.0.*step_height"),
        ("[physics]\ncone = 'round'", r"'round'.*cone"),
        ("[robot]\nvariant = 'papr'", r"unknown robot variant 'papr'.*paper"),
    ],
)
def test_fields_out_of_range_are_one_line(tmp_path, table: str, words: str) -> None:
    from tiny_protocol import TOML
    from wbc_bench.episodes.protocol import read_protocol
    from wbc_bench.errors import BenchError

    path = tmp_path / "own.toml"
    head, field = table.split("\n")
    text = TOML.format(replicates=1, episodes=6, horizon=0.2)
    path.write_text(text.replace(head, table) if head in text else f"{text}\n{head}\n{field}\n")
    with pytest.raises(BenchError, match=words) as caught:
        read_protocol(path)
    assert "\n" not in str(caught.value)


def test_pyramidal_cones_are_a_field(smoke: EvalProtocol) -> None:
    physics = msgspec.structs.replace(smoke.physics, cone="pyramidal")
    changed = msgspec.structs.replace(smoke, physics=physics)
    assert world_model(changed).opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert world_model(smoke).opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert changed.digest != smoke.digest


def test_targets_turn_with_the_odometry(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    rows = calm_rows(1)
    state = Simulation(smoke, rows).state()
    target = Sensors(smoke, rows, ALL).target(state)
    np.testing.assert_allclose(target.pos_b, rows.target_pos_w - state.base_pos_w, atol=1e-12)
    assert geodesic_angle(target.rot_b, np.eye(3)[None])[0] < 1e-7
