"""The parts of the IK controller, each against an independent calculation, and the controller as a whole."""

from dataclasses import replace

import msgspec
import numpy as np
import pinocchio as pin
import pytest

from wbc_baselines.ik import make
from wbc_baselines.ik.arm_servo import solve_arm
from wbc_baselines.ik.balance import distribute_contact_forces, friction_rays
from wbc_baselines.ik.config import TUNED
from wbc_baselines.ik.controller import PERIOD, IKController, moment_of
from wbc_baselines.ik.estimation import ComFilter, GravityFilter, JointFilter, uniform_variance
from wbc_baselines.ik.model import GRAVITY, WholeBodyModel, configuration
from wbc_baselines.ik.placo_ik import PlacoIK
from wbc_baselines.ik.reference import MAX_LEAN, Reference, plan_goal_posture
from wbc_baselines.ik.stance import base_from_stance, measured_stance
from wbc_bench.controller import Observation, Proprioception, Target
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import UnknownNameError
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.outcomes import Outcome
from wbc_bench.robot import load_robot
from wbc_bench.rotations import matrix_from_wxyz

ROBOT = load_robot()
MODEL = WholeBodyModel(ROBOT)
UP = np.array([0.0, 0.0, 1.0])


def standing(joints: np.ndarray = ROBOT.default_q) -> np.ndarray:
    """A configuration (21,) on flat ground in the anchor frame."""
    pos, rot = base_from_stance(MODEL.soles_in_base(joints), UP, None)
    return configuration(pos, rot, joints)


def rotation(rng: np.random.Generator, angle: float) -> np.ndarray:
    return pin.exp3(rng.uniform(-angle, angle, 3))


# estimation


def test_joint_filter_has_the_gain_of_the_simulated_errors() -> None:
    """The optimal gain makes innovations white: their covariance with the next ones vanishes."""
    s, rng, n, steps = TUNED, np.random.default_rng(0), 4000, 60
    kalman = JointFilter(PERIOD, s.joint_pos_noise, s.joint_vel_noise, s.joint_acceleration)
    kalman.reset(np.zeros((n, 1)))
    pos, vel = np.zeros((n, 1)), np.zeros((n, 1))
    cov = np.zeros((2, 2))
    for _ in range(steps):
        a = rng.normal(0.0, s.joint_acceleration, (n, 1))
        pos, vel = pos + PERIOD * vel + PERIOD**2 / 2 * a, vel + PERIOD * a
        error = np.hstack([kalman.pos + PERIOD * kalman.vel - pos, kalman.vel - vel])
        cov = error.T @ error / n  # before the measurement
        noise = rng.uniform(-1, 1, (2, n, 1)) * [[[s.joint_pos_noise]], [[s.joint_vel_noise]]]
        kalman.update(pos + noise[0], vel + noise[1])
    measured = np.diag([uniform_variance(s.joint_pos_noise), uniform_variance(s.joint_vel_noise)])
    np.testing.assert_allclose(kalman._gain, cov @ np.linalg.inv(cov + measured), rtol=0.1, atol=0.003)


def test_gravity_filter_has_the_gain_of_the_simulated_errors() -> None:
    s, rng, n = TUNED, np.random.default_rng(1), 2000
    kalman = GravityFilter(PERIOD, s.gravity_noise, s.gyro_noise)
    down = np.tile(-UP, (n, 1))
    kalman.reset(down + rng.uniform(-s.gravity_noise, s.gravity_noise, (n, 3)))
    variance = 0.0
    for _ in range(400):
        gyro = rng.uniform(-s.gyro_noise, s.gyro_noise, (n, 3))
        kalman.update(down + rng.uniform(-s.gravity_noise, s.gravity_noise, (n, 3)), gyro)
        variance = np.mean(kalman.gravity[:, :2] ** 2)
    # what is left after an update, P (1 - k) = k R, gives the gain back
    assert kalman._gain == pytest.approx(variance / uniform_variance(s.gravity_noise), rel=0.15)
    assert kalman.deviation == pytest.approx(np.sqrt(variance), rel=0.1)


def test_gravity_filter_turns_with_the_gyro() -> None:
    kalman = GravityFilter(PERIOD, TUNED.gravity_noise, TUNED.gyro_noise)
    rate = np.array([0.3, -0.2, 0.5])  # [rad/s] in the base frame
    kalman.reset(-UP[None])
    kalman._gain = 0.0
    kalman._count = 10**9  # measurements no longer count
    for _ in range(100):
        kalman.update(-UP[None], rate[None])
    np.testing.assert_allclose(kalman.gravity[0], pin.exp3(-100 * PERIOD * rate) @ -UP, atol=5e-3)


def test_com_filter_has_the_covariance_of_the_simulated_errors() -> None:
    s, rng, tilt, height = TUNED, np.random.default_rng(2), 0.01, 0.8
    noise = np.hypot(s.com_noise, tilt * height)
    errors = []
    kalman = None
    for _ in range(400):
        pos, vel = np.array([0.0, 0.0, height]), np.zeros(3)
        kalman = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_jump, pos)
        kalman._jump = np.zeros((2, 2))  # none comes here
        for _ in range(50):
            a = rng.normal(0.0, s.com_acceleration, 3)
            pos, vel = pos + PERIOD * vel + PERIOD**2 / 2 * a, vel + PERIOD * a
            seen = pos + rng.normal(0.0, noise, 3)
            seen[2] = height  # the height sets the noise
            kalman.update(seen, np.zeros(3), tilt)
        errors += [(kalman.pos[i] - pos[i], kalman.vel[i] - vel[i]) for i in (0, 1)]
    assert kalman is not None
    cov = np.cov(np.array(errors).T)
    np.testing.assert_allclose(kalman._cov, cov, rtol=0.2)
    # the gain is P C / R after the update
    np.testing.assert_allclose(kalman._cov[:, 0] / noise**2, cov[:, 0] / noise**2, rtol=0.2)


def test_com_filter_follows_a_pushed_pendulum() -> None:
    """Inverted pendulum under feedback, pushed by 0.4 m/s after a second."""
    s, rng = TUNED, np.random.default_rng(3)
    pos, vel = np.array([0.0, 0.0, 0.8]), np.zeros(3)
    kalman = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_jump, pos)
    errors = []
    for k in range(150):
        planned = np.zeros(3)
        planned[:2] = -s.kp_com * kalman.pos[:2] - s.kd_com * kalman.vel[:2]
        # the pressure point under the estimate gives the plan only where the estimate is right
        a = planned + GRAVITY / 0.8 * (pos - kalman.pos) * [1, 1, 0]
        pos, vel = pos + PERIOD * vel + PERIOD**2 / 2 * a, vel + PERIOD * a
        if k == 50:
            vel = vel + np.array([0.4, 0.0, 0.0])
        kalman.update(pos + rng.uniform(-s.com_noise, s.com_noise, 3), planned, 0.003)
        errors.append(np.abs(kalman.vel - vel).max())
    assert max(errors[30:50]) < 0.05
    assert errors[50] > 0.3  # it cannot know yet
    assert max(errors[58:]) < 0.1  # within 0.16 s
    assert np.abs(pos[:2]).max() < 0.01


# the stance


def test_base_pose_is_recovered_from_the_stance() -> None:
    rng = np.random.default_rng(4)
    for _ in range(50):
        xy = np.array([[0.0, 0.1], [0.0, -0.1]]) + rng.uniform(-0.05, 0.05, (2, 2))
        yaw = rng.uniform(-np.pi, np.pi)
        turned = pin.exp3(yaw * UP)
        soles = [
            (turned @ np.array([*p, 0.0]) + [0.3, -0.2, 0.0], pin.exp3((yaw + dyaw) * UP))
            for p, dyaw in zip(xy, rng.uniform(-0.3, 0.3, 2), strict=True)
        ]
        stance = measured_stance(soles)
        pos = np.array([*rng.uniform(-1, 1, 2), rng.uniform(0.5, 0.9)])
        rot = turned @ rotation(rng, 0.4)
        soles_b = [(rot.T @ (p - pos), rot.T @ r) for p, r in soles]
        found_pos, found_rot = base_from_stance(soles_b, rot.T @ UP, stance)
        np.testing.assert_allclose(found_pos, pos, atol=1e-12)
        np.testing.assert_allclose(found_rot, rot, atol=1e-12)


def test_without_a_stance_the_anchor_lies_between_the_soles() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        up_b = rotation(rng, 0.3).T @ UP
        soles_b = MODEL.soles_in_base(ROBOT.default_q + np.r_[rng.uniform(-0.1, 0.1, 8), np.zeros(6)])
        pos, rot = base_from_stance(soles_b, up_b, None)
        np.testing.assert_allclose(rot @ up_b, UP, atol=1e-12)
        soles = [(pos + rot @ p, rot @ r) for p, r in soles_b]
        np.testing.assert_allclose(np.mean([p for p, _ in soles], axis=0), 0.0, atol=1e-12)
        heading = soles[0][1][:, 0] + soles[1][1][:, 0]
        assert abs(np.arctan2(heading[1], heading[0])) < 1e-12


# balance


def contacts() -> tuple[np.ndarray, np.ndarray]:
    """Corners of both soles (8, 3) about the centre of mass, and the configuration, standing."""
    q = standing()
    MODEL.update(q)
    com = MODEL.data.com[0].copy()
    soles = [MODEL.pose(sole) for sole in MODEL.soles]
    return np.concatenate([p + MODEL.corners @ r.T for p, r in soles]) - com, q


@pytest.mark.parametrize("seed", range(5))
def test_forces_reproduce_a_feasible_wrench_inside_the_pyramid(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, _ = contacts()
    rays = friction_rays(0.4)
    wanted = rng.uniform(0.0, 1.0, (len(points), len(rays))) @ rays
    wanted *= MODEL.mass * GRAVITY / wanted[:, 2].sum()
    wrench = np.concatenate([wanted.sum(axis=0), moment_of(points, wanted)])
    forces = distribute_contact_forces(points, rays, wrench, np.ones(6), 1e-3)
    found = np.concatenate([forces.sum(axis=0), moment_of(points, forces)])
    np.testing.assert_allclose(found, wrench, atol=1e-3)
    assert (np.abs(forces[:, :2]).max(axis=1) <= 0.4 / np.sqrt(2) * forces[:, 2] + 1e-9).all()
    assert (np.linalg.norm(forces[:, :2], axis=1) <= 0.4 * forces[:, 2] + 1e-9).all()


def test_no_force_pulls_at_the_ground() -> None:
    points, _ = contacts()
    wrench = np.array([300.0, 0.0, -50.0, 0.0, 200.0, 0.0])  # nothing a foot can do
    forces = distribute_contact_forces(points, friction_rays(0.4), wrench, np.ones(6), 0.02)
    assert np.isfinite(forces).all() and (forces[:, 2] >= 0.0).all()


def test_moment_is_the_sum_of_cross_products() -> None:
    rng = np.random.default_rng(6)
    arms, forces = rng.normal(size=(2, 8, 3))
    np.testing.assert_allclose(moment_of(arms, forces), np.cross(arms, forces).sum(axis=0), atol=1e-12)


def carried() -> tuple[np.ndarray, np.ndarray]:
    """A standing configuration (21,) and the forces (20,) of the contacts that carry it."""
    points, q = contacts()
    wrench = np.array([0.0, 0.0, MODEL.mass * GRAVITY, 0.0, 0.0, 0.0])
    forces = distribute_contact_forces(
        points,
        friction_rays(TUNED.friction),
        wrench,
        np.array([1, 1, 1, TUNED.roll_weight, TUNED.pitch_weight, TUNED.yaw_weight]),
        1e-4,
    )
    generalized = np.zeros(20)
    for i, sole in enumerate(MODEL.soles):
        rot, jacobian, part = MODEL.pose(sole)[1], MODEL.jacobian(sole), forces[4 * i : 4 * i + 4]
        moment = np.cross(MODEL.corners @ rot.T, part).sum(axis=0)
        generalized += jacobian.T @ np.concatenate([part.sum(axis=0), moment])
    return q, generalized


def test_static_balance_leaves_nothing_on_the_base() -> None:
    """Newton-Euler: at rest, gravity is what contact forces and joint torques carry, the base nothing."""
    q, generalized = carried()
    torques = MODEL.gravity_torques(q) - generalized
    np.testing.assert_allclose(torques[:6], 0.0, atol=1e-2)

    data = MODEL.model.createData()  # and the dynamics agree that nothing moves
    tau = np.concatenate([np.zeros(6), torques[6:]]) + generalized
    np.testing.assert_allclose(pin.aba(MODEL.model, data, q, np.zeros(20), tau), 0.0, atol=1e-2)


def test_the_controller_sends_the_torques_of_static_balance() -> None:
    """With zero error, `_balance` is gravity less the contact forces it plans."""
    config = replace(TUNED, feedback=False, sole_width=1.0, damping=1e-4)
    controller = IKController(ROBOT, None, config)
    q = standing()
    obs, target = _observation(1, q)
    controller.reset(np.arange(1), obs, target)
    episode = controller._episodes[0]
    torques = controller._balance(episode, q, pin.Quaternion(q[3:7]).toRotationMatrix(), np.zeros(3), (0, 1))
    np.testing.assert_allclose(episode.acceleration, 0.0, atol=1e-3)
    q, generalized = carried()
    np.testing.assert_allclose(torques, (MODEL.gravity_torques(q) - generalized)[6:], atol=1e-3)


# the hand


def test_arm_reaches_a_near_pose() -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        joints = ROBOT.default_q.copy()
        joints[8:] += rng.uniform(-0.2, 0.2, 6)
        near = joints.copy()
        near[8:] += rng.uniform(-0.05, 0.05, 6)
        pose, _ = MODEL.arm_in_base(near)
        found = joints.copy()
        for _ in range(6):  # damped: the fixed point is what counts
            found[8:] = solve_arm(MODEL, found, pose, 1e-3, 0.5)
        (pos, rot), _ = MODEL.arm_in_base(found)
        assert np.linalg.norm(pos - pose[0]) < 1e-4
        assert np.linalg.norm(pin.log3(rot.T @ pose[1])) < 1e-4


def test_arm_stops_at_the_limit() -> None:
    (pos, rot), _ = MODEL.arm_in_base(ROBOT.default_q)
    found = solve_arm(MODEL, ROBOT.default_q, (pos + np.array([0.4, 0.4, 0.2]), rot), TUNED.hand_damping, 0.1)
    assert np.abs(found - ROBOT.default_q[8:]).max() == pytest.approx(0.1)


# the reference


def test_reference_keeps_its_speed_and_arrives() -> None:
    s, rng = TUNED, np.random.default_rng(8)
    for _ in range(5):
        ee = MODEL.ee_of(standing())
        target = ee[0] + rng.uniform(-0.4, 0.4, 3), ee[1] @ rotation(rng, 1.0)
        reference = Reference(s, PERIOD, ee, target, ROBOT.default_q)
        goal = ROBOT.default_q + 0.1
        reference.set_goal(ROBOT.default_q, goal)
        before = 0.0
        for _ in range(500):
            pos, rot = reference.ee
            reference.track(target)
            reference.advance()
            linear = np.linalg.norm(reference.ee[0] - pos) / PERIOD
            angular = np.linalg.norm(pin.log3(rot.T @ reference.ee[1])) / PERIOD
            assert linear <= s.slew_linear + 1e-9 and angular <= s.slew_angular + 1e-9
            share = max(linear / s.slew_linear, angular / s.slew_angular)
            assert share - before <= PERIOD / s.slew_ramp + 1e-6  # starts gently
            before = share
        np.testing.assert_allclose(reference.ee[0], target[0], atol=1e-4)
        np.testing.assert_allclose(reference.ee[1], target[1], atol=1e-4)
        np.testing.assert_allclose(reference.posture, goal, atol=1e-4)


def test_plan_reaches_posture_targets() -> None:
    protocol, path = find_protocol("tuning_nominal_v1")
    rows, _ = read_manifest(protocol, manifest_path(path))
    lean = np.arccos(matrix_from_wxyz(rows.feasible_qpos[:, 3:7])[:, 2, 2])
    # plans do not lean further, so they miss targets that are out of reach of a base that leans less
    rows = rows.take(np.flatnonzero((rows.stratum == "posture") & (lean < MAX_LEAN))[:8])
    q = standing()
    shift = np.array([*q[:2], 0.0])  # the base stands over the world's origin at reset
    MODEL.update(q)
    stance = measured_stance([MODEL.pose(sole) for sole in MODEL.soles])
    solver = PlacoIK(ROBOT, TUNED.weights, PERIOD)
    for pos, quat in zip(rows.target_pos_w, rows.target_quat_w, strict=True):
        joints, error = plan_goal_posture(
            solver,
            MODEL,
            q,
            MODEL.ee_of(q),
            (pos + shift, matrix_from_wxyz(quat)),
            stance.poses(),
            stance.hull(MODEL.corners),
            ROBOT.default_q,
            TUNED.weights.planning_posture,
        )
        assert error < 0.02
        assert ((joints > ROBOT.lower) & (joints < ROBOT.upper)).all()


# the controller


def _observation(count: int, q: np.ndarray) -> tuple[Observation, Target]:
    """Noise-free, at rest, with the hand where it is asked to be."""
    rot = pin.Quaternion(q[3:7]).toRotationMatrix()
    pos, ee_rot = MODEL.ee_of(q)
    still = Proprioception(
        base_ang_vel_b=np.zeros((count, 3)),
        gravity_b=np.tile(rot.T @ -UP, (count, 1)),
        joint_pos=np.tile(q[7:], (count, 1)),
        joint_vel=np.zeros((count, 14)),
        joint_torque=np.zeros((count, 14)),
    )
    target = Target(np.tile(rot.T @ (pos - q[:3]), (count, 1)), np.tile(rot.T @ ee_rot, (count, 1, 1)))
    return Observation(0.0, np.ones(count, dtype=bool), still, None, None, None), target


def test_unknown_variant() -> None:
    with pytest.raises(UnknownNameError, match="did you mean kinematic"):
        make(ROBOT, "kinematics")


@pytest.mark.parametrize("variant", ["", "kinematic", "osqp", "standing"])
def test_variants_are_named(variant: str) -> None:
    assert make(ROBOT, variant).info.name == (f"ik:{variant}" if variant else "ik")


class Stub:
    """A solver that succeeds until it is told to fail."""

    fails = False

    def step(self, q: np.ndarray, *_, **__) -> np.ndarray | None:
        return None if self.fails else q


def test_without_a_solution_the_last_command_is_held() -> None:
    solver = Stub()
    controller = IKController(ROBOT, solver, TUNED)
    obs, target = _observation(2, standing())
    controller.reset(np.arange(2), obs, target)
    first = controller.act(obs, target)
    assert first.infeasible is not None and not first.infeasible.any()
    solver.fails = True
    for _ in range(20):  # planning fails too
        held = controller.act(obs, target)
        assert held.infeasible is not None and held.infeasible.all()
        np.testing.assert_array_equal(held.q, first.q)
    ended = controller.act(obs._replace(active=np.array([True, False])), target)
    assert ended.infeasible is not None
    assert ended.infeasible.tolist() == [True, False]


@pytest.fixture(scope="module")
def two_seconds(smoke: EvalProtocol) -> EvalProtocol:
    episodes = msgspec.structs.replace(smoke.episodes, horizon=2.0)
    success = msgspec.structs.replace(smoke.success, window=0.1)
    return msgspec.structs.replace(smoke, episodes=episodes, success=success)


def test_stands_and_does_not_depend_on_the_batch(two_seconds: EvalProtocol, calm_rows) -> None:
    smoke, path = find_protocol("smoke_v1")
    drawn = read_manifest(smoke, manifest_path(path))[0].take(slice(0, 2))
    rows = calm_rows(2, target_pos_w=drawn.target_pos_w, target_quat_w=drawn.target_quat_w)
    controller = make(ROBOT)
    together = rollout(controller, two_seconds, rows)
    assert (together.steps == two_seconds.num_steps).all()
    assert not set(together.outcome) & {Outcome.FELL, Outcome.INVALID, Outcome.ILLEGAL_CONTACT}
    for i in range(2):
        alone = rollout(controller, two_seconds, rows.take(slice(i, i + 1)))
        for name in ("position_error", "orientation_error", "action", "ee_pos_w", "infeasible_steps"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(together, name)[i], err_msg=name)
