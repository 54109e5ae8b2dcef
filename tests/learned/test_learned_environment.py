"""Training's environment is the evaluation's: same physics, draws, observations, endings; resets in place."""

import hashlib

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch import Tensor

from training_targets import PROTOCOL, TARGETS, coarse, manifest_of
from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.training.backends.cpu import CpuBackend
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_baselines.learned.training.environment import Environment
from wbc_baselines.learned.training.make import training_protocol
from wbc_baselines.learned.training.resets import (
    DECAY,
    INITIAL_STRATUM_PROBABILITIES,
    sample_episodes,
    sample_pushes,
    scale_disturbances,
    stratum_probabilities,
)
from wbc_baselines.learned.training.sensing import noise_half_widths
from wbc_baselines.learned.training.state_view import rotation_from_wxyz
from wbc_baselines.learned.training.target_set import (
    TARGET_SETS,
    TargetSet,
    digest,
    draw_target_set,
    read_target_set,
    write_target_set,
)
from wbc_bench.episodes import randomization
from wbc_bench.episodes.protocol import EvalProtocol, Noise, find_protocol
from wbc_bench.errors import ManifestError, ProtocolError
from wbc_bench.evaluation.observation import Sensors
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.outcomes import STRATA
from wbc_bench.randomness import stream
from wbc_bench.robot import load_robot
from wbc_bench.rotations import matrix_from_wxyz

N = 6


def environment(
    protocol: EvalProtocol | None = None, count: int = N, seed: int = 0, threads: int = 1
) -> Environment:
    protocol = protocol or coarse()
    return Environment(protocol, CpuBackend(protocol, count, threads), TARGETS, "gated", seed)


def actions(steps: int, count: int = N, scale: float = 0.3) -> Tensor:
    return scale * torch.randn(steps, count, 14, generator=torch.Generator().manual_seed(1))


def test_the_physics_is_the_evaluations():
    """The same starts and commands, 0.3 s at 2 ms x 10, through both simulations: equal but for float32."""
    samples = sample_episodes(PROTOCOL, TARGETS, N, stream(3, "test"))
    backend = CpuBackend(PROTOCOL, N, 1)
    simulation = Simulation(PROTOCOL, manifest_of(samples.reset, samples.target))
    state = backend.reset(torch.arange(N), samples.reset)
    robot = load_robot(PROTOCOL.robot)
    for action in actions(15):
        command = torch.tensor(robot.command_of(action.double().numpy()), dtype=torch.float32)
        _, state = backend.step(command[None])
        simulation.step(command.double().numpy(), np.ones(N, dtype=bool))
    truth = simulation.state()
    for mine, theirs in (
        (state.qpos[:, 7:], truth.joint_pos),
        (state.qvel[:, 6:], truth.joint_vel),
        (state.qpos[:, :3], truth.base_pos_w),
        (rotation_from_wxyz(state.qpos[:, 3:7]), truth.base_rot_w),
        (state.torque, truth.joint_torque),
        (state.ee_pos_w, truth.ee_pos_w),
        (state.ee_rot_w, truth.ee_rot_w),
        (state.foot_force_w, truth.foot_force_w),
        (state.ground_contact, truth.ground_contact),
    ):
        np.testing.assert_allclose(mine.numpy(), theirs, rtol=2e-6, atol=2e-6)


def test_observations_are_the_evaluations():
    """Without noise, every column is what the evaluation's sensors say of the same state."""
    protocol = coarse(noise=Noise())
    env = environment(protocol)
    env.begin_rollout(0, 4)
    for action in actions(4):
        env.step(action)
    state, episode, seen = env._state, env._episode, env.observations
    samples = sample_episodes(PROTOCOL, TARGETS, N, stream(3, "test"))
    rows = manifest_of(samples.reset, samples.target)
    rows.target_pos_w[:] = episode.target_pos_w.numpy()
    sensors = Sensors(protocol, rows, frozenset({"proprioception", "ee_pose", "privileged"}))
    from wbc_bench.evaluation.simulation import State as Truth

    truth = Truth(
        base_pos_w=state.qpos[:, :3].double().numpy(),
        base_rot_w=matrix_from_wxyz(state.qpos[:, 3:7].double().numpy()),
        base_lin_vel_w=state.qvel[:, :3].double().numpy(),
        base_ang_vel_b=state.qvel[:, 3:6].double().numpy(),
        joint_pos=state.qpos[:, 7:].double().numpy(),
        joint_vel=state.qvel[:, 6:].double().numpy(),
        joint_torque=state.torque.double().numpy(),
        ee_pos_w=state.ee_pos_w.double().numpy(),
        ee_rot_w=state.ee_rot_w.double().numpy(),
        foot_pos_w=state.feet_pos_w.double().numpy(),
        foot_force_w=state.foot_force_w.double().numpy(),
        ground_contact=state.ground_contact.numpy(),
        diverged=state.diverged.numpy(),
    )
    active = np.ones(N, dtype=bool)
    seen_by_bench = sensors.observe(4, 0.08, truth, active)
    body, ee, privileged = seen_by_bench.proprioception, seen_by_bench.ee_pose, seen_by_bench.privileged
    assert body and ee and privileged
    default = load_robot().default_q
    ee9 = np.concatenate([ee.pos_b, ee.rot6_b], axis=1)
    common = [body.base_ang_vel_b, body.gravity_b, body.joint_pos - default, body.joint_vel]
    expected = np.concatenate([*common, episode.action.numpy(), ee9, episode.d_ref[:, None].numpy()], axis=1)
    np.testing.assert_allclose(seen.policy[:, : inputs.OBSERVATION].numpy(), expected, atol=2e-5)
    np.testing.assert_allclose(seen.critic[:, : inputs.OBSERVATION].numpy(), expected, atol=2e-5)
    term = np.concatenate([*common, body.joint_torque, ee9], axis=1)
    np.testing.assert_allclose(seen.frame.numpy(), term, atol=2e-5)
    target = sensors.target(truth).pos_b
    np.testing.assert_allclose(seen.policy[:, 58:61].numpy(), target, atol=2e-5)
    rot_b = np.swapaxes(truth.base_rot_w, 1, 2) @ episode.target_rot_w.double().numpy()
    np.testing.assert_allclose(
        seen.policy[:, 61:67].numpy(), np.concatenate([rot_b[..., 0], rot_b[..., 1]], 1), atol=2e-5
    )
    np.testing.assert_allclose(seen.velocity.numpy(), privileged.base_lin_vel_b, atol=2e-5)


def test_velocities_are_differences_over_a_period():
    """The end-effector's velocity columns carry the pose of the step before into the present one."""
    env = environment()
    env.begin_rollout(0, 12)
    for action in actions(11):
        env.step(action)
    before = env._state
    done = env.step(actions(12)[-1]).done
    alive = (~done).nonzero()[:, 0]
    rot_w = rotation_from_wxyz(env._state.qpos[:, 3:7])
    velocity_w = torch.einsum("nij,nj->ni", rot_w, env._derived.ee_vel_b[:, :3])
    moved = before.ee_pos_w + 0.02 * velocity_w
    torch.testing.assert_close(moved[alive], env._state.ee_pos_w[alive], atol=1e-5, rtol=0)
    turn = 0.02 * torch.einsum("nij,nj->ni", rot_w, env._derived.ee_vel_b[:, 3:])
    hat = torch.linalg.cross(turn[:, :, None].expand(-1, 3, 3), before.ee_rot_w, dim=1)
    torch.testing.assert_close((before.ee_rot_w + hat)[alive], env._state.ee_rot_w[alive], atol=0.02, rtol=0)


def test_starts_have_the_manifests_distribution():
    """Ranges of the protocol, filled; the resting height of each leg posture; strata by weight."""
    count, spread = 600, PROTOCOL.randomization
    samples = sample_episodes(PROTOCOL, TARGETS, count, stream(5, "test"))
    start = samples.reset
    for values, low, high in (
        (start.friction, *spread.friction),
        (start.base_mass, *spread.base_mass),
        (start.base_vel[:, :3], -spread.base_lin_vel, spread.base_lin_vel),
        (start.base_vel[:, 3:], -spread.base_ang_vel, spread.base_ang_vel),
        (start.leg_q, -spread.leg_q, spread.leg_q),
        (start.leg_qd, -spread.leg_qd, spread.leg_qd),
        (start.kp_scale, *spread.gain),
        (start.kd_scale, *spread.gain),
        (samples.decay, *DECAY),
    ):
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high >= values.max() > high - 0.02 * (high - low)
    heights = [randomization.resting_height(PROTOCOL.robot, q) for q in start.leg_q[:5].numpy()]
    np.testing.assert_array_equal(start.base_height[:5], heights)
    counts = np.bincount(TARGETS.stratum[samples.target], minlength=3)
    assert np.all(np.abs(counts - count / 3) < 5 * np.sqrt(count * 2 / 9))


def test_what_legs_lack_where_a_hand_is_late():
    """Both soles loaded, slow, no step needed, the reference due and the hand not there; else nothing."""
    env = environment(count=8)
    state, episode, view = env._state, env._episode, env._derived
    state.qvel[:] = 0.0
    state.foot_force_w[..., 2] = 60.0
    episode.stratum[:] = STRATA.index("posture")
    episode.d_ref[:], view.pos_error[:] = 0.4, 0.06
    state.foot_force_w[0, 0, 2] = 0.0
    state.qvel[1, 0] = 0.2
    state.qvel[2, 4] = 0.4
    episode.d_ref[3] = 0.6
    view.pos_error[4] = 0.04
    episode.stratum[5] = STRATA.index("step")
    leg_posture_error = env.leg_posture_error()
    assert (leg_posture_error[:6] == 0).all()
    for k in (6, 7):
        row = np.flatnonzero((episode.target_pos_w[k].numpy() == TARGETS.pos_w).all(1))[0]
        expected = TARGETS.witness_qpos[row, 7:15] - state.qpos[k, 7:15].numpy()
        np.testing.assert_allclose(leg_posture_error[k], expected, atol=1e-6)


def test_pushes_are_the_manifests():
    """One episode's draw equals the evaluation's from an equal generator."""
    for seed in range(20):
        step, velocity = sample_pushes(PROTOCOL, 1, stream(seed, "test"))
        time, expected = randomization.draw_pushes(
            PROTOCOL.push, PROTOCOL.episodes.horizon, stream(seed, "test")
        )
        np.testing.assert_array_equal(
            step[0], np.where(np.isnan(time), -1, np.round(np.nan_to_num(time) / 0.02))
        )
        np.testing.assert_array_equal(velocity[0, :, :2].ravel(), expected)


def test_training_may_push_more_often():
    """As many as fit, each within the interval asked for, none in the quiet end."""
    often = training_protocol(TrainConfig("no_latent", push_interval=(1.5, 3.0)))
    step, velocity = sample_pushes(often, 400, stream(1, "test"))
    assert step.shape == (400, 6) and velocity.shape == (400, 6, 6)
    came = step >= 0
    assert set(came.sum(1)) <= {2, 3, 4, 5} and came.sum() > 3 * 400 * 0.9
    gaps = np.diff(step, axis=1, prepend=0)[came]
    assert gaps.min() >= 75 - 1 and gaps.max() <= 150 + 1
    assert step.max() < PROTOCOL.num_steps - PROTOCOL.push.quiet_end / PROTOCOL.control_period + 1
    assert (velocity[~came] == 0).all()
    with pytest.raises(TrainingError, match=r"--push-interval 3 1\.5: valid: 0 < least <= most"):
        TrainConfig("no_latent", push_interval=(3.0, 1.5)).check()


def test_a_push_comes_at_its_step():
    """Only that environment's base jumps, by what was drawn."""
    protocol = coarse()
    with_push, without = environment(protocol), environment(protocol)
    for env in (with_push, without):
        env._episode.push_step.fill_(-1)
        env.begin_rollout(0, 1)
    with_push._episode.push_step[2, 0] = with_push._episode.step[2]
    with_push._episode.push_vel[2, 0, :2] = torch.tensor([0.4, -0.2])
    moved = []
    for env, expected in ((with_push, [2]), (without, [])):
        assert env.step(torch.zeros(N, 14)).pushed.nonzero()[:, 0].tolist() == expected
        moved.append(env._state.qpos[:, :2].clone())
    difference = (moved[0] - moved[1]).abs().sum(-1)
    assert difference[2] > 1e-3
    assert (difference[[0, 1, 3, 4, 5]] == 0).all()


def test_curriculum_ends_at_the_protocols_weights():
    np.testing.assert_allclose(stratum_probabilities(PROTOCOL, 0.0), INITIAL_STRATUM_PROBABILITIES)
    np.testing.assert_allclose(stratum_probabilities(PROTOCOL, 1.0), np.full(3, 1 / 3))
    for part in (0.0, 0.3, 1.0):
        assert stratum_probabilities(PROTOCOL, part).sum() == pytest.approx(1.0)


def test_noise_is_the_protocols():
    """Uniform within the half-widths, on the shared columns alone, and the critic's are clean."""
    half = noise_half_widths(PROTOCOL)
    assert half.shape == (57,)
    assert half[0] == PROTOCOL.noise.base_ang_vel and half[20] == PROTOCOL.noise.joint_vel
    assert half[47] == PROTOCOL.noise.joint_torque and half[-1] == PROTOCOL.noise.ee_rot
    env = environment(count=64)
    env.begin_rollout(0, 1)
    env.step(torch.zeros(64, 14))
    difference = (env.observations.policy - env.observations.critic[:, :67]).numpy()
    noisy = np.r_[0:34, 48:57]
    assert (np.abs(difference[:, noisy]) <= half[np.r_[0:34, 48:57]] + 1e-5).all()
    assert (np.abs(difference[:, noisy]).max(0) > 0.8 * half[np.r_[0:34, 48:57]]).all()
    np.testing.assert_array_equal(np.delete(difference, noisy, axis=1), 0)


def test_reset_touches_only_what_has_ended():
    """An environment that ends starts anew; the others go on as in a twin where nothing ends."""
    protocol = coarse()
    ends, goes_on = environment(protocol), environment(protocol)
    ends._episode.step[1] = protocol.num_steps - 1
    goes_on._episode.step[1] = 0
    for env in (ends, goes_on):
        env._episode.step[[0, 2, 3, 4, 5]] = 10
        env._episode.push_step.fill_(-1)
        env.begin_rollout(0, 2)
    first = [env.step(torch.zeros(N, 14)) for env in (ends, goes_on)]
    assert first[0].done.tolist() == [False, True, False, False, False, False]
    assert first[0].time_out.tolist() == first[0].done.tolist()
    assert not first[1].done.any()
    others = [0, 2, 3, 4, 5]
    assert ends._episode.step.tolist() == [11, 0, 11, 11, 11, 11]
    assert (ends._episode.action[1] == 0).all() and (ends._derived.ee_vel_b[1] == 0).all()
    e_p, e_r = ends._derived.pos_error[1], ends._derived.rot_error[1]
    assert ends._episode.d_ref[1] == 2 * e_p + e_r
    second = [env.step(torch.zeros(N, 14)) for env in (ends, goes_on)]
    for a, b in zip(second[0].observations, second[1].observations, strict=True):
        torch.testing.assert_close(a[others], b[others], rtol=0, atol=0)
        assert not torch.equal(a[1], b[1])


def test_episodes_are_drawn_ahead_and_taken_in_order():
    """Each is taken once; what is left of a bank that is too small is dropped."""
    env = environment()
    first = env._episodes.target_pos_w.clone()
    assert torch.equal(env._episode.target_pos_w, first)  # all of the first went into the start
    start, episode = env._take(4)
    assert torch.equal(episode.target_pos_w, env._episodes.target_pos_w[:4]) and len(start.friction) == 4
    second = env._episodes.target_pos_w.clone()
    assert not torch.equal(second, first)
    assert torch.equal(env._take(1)[1].target_pos_w, second[4:5])
    third = env._take(2)[1].target_pos_w
    assert torch.equal(third, env._episodes.target_pos_w[:2]) and not torch.equal(third, second[:2])
    same = environment()
    same.load(env.save())
    assert torch.equal(same._take(3)[1].target_pos_w, env._take(3)[1].target_pos_w)


def test_endings():
    """Tilt and a low base end an episode unsafely; a diverged one is counted, its sum bounded."""
    env = environment()
    env.begin_rollout(0, 2)
    env._episode.step.fill_(0)
    tilt = 0.45 * np.pi
    qpos, qvel = env._backend._state["qpos"], env._backend._state["qvel"]
    qpos[0, 2:7] = [1.5, np.cos(tilt / 2), 0, np.sin(tilt / 2), 0]  # in the air, falling on its face
    qpos[1, 2] = 0.2
    qvel[2, 10] = 1e4
    env.clear_log()
    step = env.step(torch.zeros(N, 14))
    assert step.done.tolist() == [True, True, True, False, False, False]
    assert not step.time_out.any()
    assert step.reward.isfinite().all() and (step.reward.abs() <= 5).all() and (step.reward[:3] < -1).all()
    log = env.log()
    assert log["episode/count"] == 3 and log["episode/diverged"] == 1
    assert log["episode/falls"] == pytest.approx(2 / 3)
    for tensor in env.observations:
        assert tensor.isfinite().all()
    assert not env.step(torch.zeros(N, 14)).done.any()  # the reset has cleared the engine's warning


@pytest.mark.parametrize("tilt", [np.pi, 6.28, 10.0, 1e9])
def test_no_tilt_is_beyond_pi(tilt):
    """A large limit switches the termination off, also where its cosine comes round again."""
    protocol = coarse()
    limits = msgspec.structs.replace(protocol.termination, tilt=tilt, base_height=0.0, illegal_contact=False)
    env = environment(msgspec.structs.replace(protocol, termination=limits))
    env.begin_rollout(0, 1)
    env._episode.step.fill_(0)
    env._backend._state["qpos"][:, 2] = 1.5  # in the air
    env._backend._state["qpos"][0, 3:7] = [0.0, 0.0, 1.0, 0.0]  # upside down
    assert not env.step(torch.zeros(N, 14)).done.any()


def test_success_is_the_last_second_inside():
    """Held for 50 steps at the time-out counts, for 49 not."""
    env = environment()
    env.begin_rollout(0, 1)
    env._episode.step.fill_(0)
    env._episode.step[:2] = env.protocol.num_steps - 1
    env._episode.push_step.fill_(-1)
    window = env.protocol.window_steps
    env._episode.steps_in_tolerance[:2] = torch.tensor([window - 1, window - 2])
    env._episode.target_pos_w[:2] = env._state.ee_pos_w[:2]
    env._episode.target_rot_w[:2] = env._state.ee_rot_w[:2]
    env.clear_log()
    env.step(torch.zeros(N, 14))
    assert env.log()["episode/success"] == 0.5


def test_threads_do_not_change_anything():
    one, two = environment(threads=1), environment(threads=2)
    for env in (one, two):
        env.begin_rollout(0, 5)
        for action in actions(5):
            env.step(action)
    for a, b in zip(one.observations, two.observations, strict=True):
        assert torch.equal(a, b)


def test_save_and_load_go_on_bit_by_bit():
    unbroken, broken = environment(), environment()
    for env in (unbroken, broken):
        env._episode.step[0] = env.protocol.num_steps - 12  # one reset before, one after
        env.begin_rollout(0, 8)
        for action in actions(8):
            env.step(action)
    resumed = environment(seed=0)
    resumed.load(broken.save())
    for env in (unbroken, resumed):
        env.begin_rollout(1, 8)
    for action in actions(8, scale=0.5):
        a, b = unbroken.step(action), resumed.step(action)
        assert torch.equal(a.reward, b.reward) and torch.equal(a.done, b.done)
        for x, y in zip(a.observations, b.observations, strict=True):
            assert torch.equal(x, y)


def test_the_pool_is_feasible_and_its_own():
    """What ships is equal parts, poses of unit quaternions, and shares no target with the evaluation."""
    assert np.bincount(TARGETS.stratum).tolist() == [len(TARGETS) // 3] * 3
    np.testing.assert_allclose(np.linalg.norm(TARGETS.quat_w, axis=1), 1, atol=1e-6)
    drawn = draw_target_set(PROTOCOL, 2)
    for mine, theirs in zip(drawn, TARGETS, strict=True):
        np.testing.assert_array_equal(mine, theirs[:2])
    from wbc_bench.episodes.manifest import manifest_path, read_manifest

    frozen, _ = read_manifest(
        *(lambda found: (found[0], manifest_path(found[1])))(find_protocol("ablation_v1"))
    )
    theirs = {hashlib.sha256(row.tobytes()).digest() for row in frozen.target_pos_w.astype(np.float32)}
    assert not any(hashlib.sha256(row.tobytes()).digest() in theirs for row in TARGETS.pos_w)


def test_a_witness_of_the_pool_reaches_its_target():
    import mujoco

    model = load_robot(PROTOCOL.robot).model()
    data = mujoco.MjData(model)
    for k in range(0, len(TARGETS), 397):
        data.qpos[:] = TARGETS.witness_qpos[k]
        mujoco.mj_kinematics(model, data)
        hand = data.site("tcp")
        np.testing.assert_allclose(hand.xpos, TARGETS.pos_w[k], atol=2e-3)
        rot = matrix_from_wxyz(TARGETS.quat_w[k].astype(float))
        np.testing.assert_allclose(hand.xmat.reshape(3, 3), rot, atol=2e-3)


def test_a_pool_knows_what_it_was_drawn_for(tmp_path):
    target_set = TargetSet(
        TARGETS.stratum[:5], TARGETS.pos_w[:5], TARGETS.quat_w[:5], TARGETS.witness_qpos[:5]
    )
    path = tmp_path / "target_set.parquet"
    write_target_set(target_set, PROTOCOL, path)
    for mine, theirs in zip(read_target_set(PROTOCOL, path), target_set, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    narrow = msgspec.structs.replace(
        PROTOCOL, targets=msgspec.structs.replace(PROTOCOL.targets, x=(0.0, 0.1))
    )
    assert digest(narrow) != digest(PROTOCOL) == digest(coarse())
    with pytest.raises(ManifestError, match="draw it again"):
        read_target_set(narrow, path)
    import pyarrow.parquet as pq

    old = tmp_path / "old.parquet"
    pq.write_table(pq.read_table(path).drop_columns("witness_qpos"), old)
    with pytest.raises(ManifestError, match=r"has columns stratum, pos_w, quat_w, valid: .*witness_qpos"):
        read_target_set(PROTOCOL, old)
    sound = read_target_set(PROTOCOL, path)
    for column, value, message in (
        ("stratum", 3, "strata .*valid: 0 to 2"),
        ("pos_w", np.nan, "pos_w holds a number that is not finite"),
        ("quat_w", 2.0, "the norm of a quaternion is not 1"),
        ("witness_qpos", 0.0, "the norm of a quaternion is not 1"),
    ):
        values = getattr(sound, column).copy()
        values[0] = value
        write_target_set(TargetSet(**{**sound._asdict(), column: values}), PROTOCOL, old)
        with pytest.raises(ManifestError, match=message):
            read_target_set(PROTOCOL, old)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ManifestError, match="not readable"):
        read_target_set(PROTOCOL, path)
    with pytest.raises(ManifestError, match="wbc-train targets"):
        read_target_set(PROTOCOL, tmp_path / "none.parquet")
    with pytest.raises(ManifestError, match=r"`wbc-train targets --protocol 'my own\.toml' --path \S+`"):
        read_target_set(PROTOCOL, tmp_path / "none.parquet", "my own.toml")
    with pytest.raises(ProtocolError, match="valid for training: workspace"):  # no command could make it
        read_target_set(find_protocol("reach_v1")[0])
    assert TARGET_SETS.exists() and len(STRATA) == 3


def test_weakened_disturbances_lie_between_none_and_the_protocols():
    """At 0 the nominal robot of the evaluation, at 1 the protocol itself, halfway in between."""
    assert scale_disturbances(PROTOCOL, 1.0) is PROTOCOL
    none = randomization.nominal(PROTOCOL, 0, 0)
    samples = sample_episodes(scale_disturbances(PROTOCOL, 0.0), TARGETS, 5, stream(3, "test"))
    for name, value in samples.reset._asdict().items():
        np.testing.assert_allclose(value, np.broadcast_to(getattr(none, name), value.shape), err_msg=name)
    assert (samples.push_step == -1).all() and not samples.push_vel.any()
    assert not noise_half_widths(scale_disturbances(PROTOCOL, 0.0)).any()

    half, full = scale_disturbances(PROTOCOL, 0.5), PROTOCOL
    np.testing.assert_allclose(noise_half_widths(half), noise_half_widths(full) / 2)
    assert half.push.speed == full.push.speed / 2 and half.push.interval == full.push.interval
    spread = half.randomization
    np.testing.assert_allclose(spread.friction, (np.array(full.randomization.friction) + none.friction) / 2)
    np.testing.assert_allclose(spread.gain, (np.array(full.randomization.gain) + 1) / 2)
    np.testing.assert_allclose(spread.base_mass, np.array(full.randomization.base_mass) / 2)
    assert spread.leg_q == full.randomization.leg_q / 2
