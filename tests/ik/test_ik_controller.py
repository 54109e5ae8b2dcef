"""The parts of the IK controller, each against an independent calculation, and the controller as a whole."""

from dataclasses import replace

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import nnls

from wbc_baselines.ik import make
from wbc_baselines.ik.arm_servo import solve_arm
from wbc_baselines.ik.balance import distribute_contact_forces, friction_rays
from wbc_baselines.ik.config import TUNED
from wbc_baselines.ik.controller import BOTH, PERIOD, IKController, Seen
from wbc_baselines.ik.daqp_ik import DaqpIK
from wbc_baselines.ik.estimation import ComFilter, GravityFilter, JointFilter, uniform_variance
from wbc_baselines.ik.geometry import Pose
from wbc_baselines.ik.kinematics import GRAVITY, Bodies, Configuration, Kinematics
from wbc_baselines.ik.model import WholeBodyModel, configuration
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
KINEMATICS = Kinematics(ROBOT)
UP = np.array([0.0, 0.0, 1.0])


def upright(joints: np.ndarray = ROBOT.default_q) -> Configuration:
    """One robot on flat ground in the anchor frame."""
    base = base_from_stance(KINEMATICS.at(joints[None]), UP[None], None)
    return Configuration(base, joints[None].copy())


def standing(joints: np.ndarray = ROBOT.default_q) -> np.ndarray:
    """The configuration (21,) of the same."""
    q = upright(joints)
    return configuration(q.base.pos[0], q.base.rot[0], joints)


def moment_of(arms: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Moment (3,) [N m] of forces (P, 3) at points (P, 3) about the origin of the points."""
    return np.cross(arms, forces).sum(axis=0)


def one_pose(pos: np.ndarray, rot: np.ndarray) -> Pose:
    return Pose(pos[None], rot[None])


def distribute(points: np.ndarray, rays: np.ndarray, wrench: np.ndarray, weight: np.ndarray, damping: float):
    """Forces (P, 3) of one robot."""
    return distribute_contact_forces(points[None], rays, wrench[None], weight, damping)[0]


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
    s, rng, tilt, height, count = TUNED, np.random.default_rng(2), 0.01, 0.8, 400
    noise = np.hypot(s.com_noise, tilt * height)
    kalman = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_jump)
    kalman._jump = np.zeros((2, 2))  # none comes here
    pos, vel = np.tile([0.0, 0.0, height], (count, 1)), np.zeros((count, 3))
    com = kalman.start(pos)
    for _ in range(50):
        a = rng.normal(0.0, s.com_acceleration, (count, 3))
        pos, vel = pos + PERIOD * vel + PERIOD**2 / 2 * a, vel + PERIOD * a
        seen = pos + rng.normal(0.0, noise, (count, 3))
        seen[:, 2] = height  # the height sets the noise
        kalman.update(com, seen, np.zeros((count, 3)), tilt)
    errors = np.stack([com.pos - pos, com.vel - vel])[:, :, :2]  # (2, N, 2)
    cov = np.cov(errors.reshape(2, -1))
    np.testing.assert_allclose(com.cov, np.broadcast_to(cov, com.cov.shape), rtol=0.2)
    # the gain is P C / R after the update
    np.testing.assert_allclose(com.cov[0, :, 0] / noise**2, cov[:, 0] / noise**2, rtol=0.2)


def test_com_filter_follows_a_pushed_pendulum() -> None:
    """Inverted pendulum under feedback, pushed by 0.4 m/s after a second."""
    s, rng = TUNED, np.random.default_rng(3)
    pos, vel = np.array([0.0, 0.0, 0.8]), np.zeros(3)
    kalman = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_jump)
    com, errors = kalman.start(pos[None]), []
    for k in range(150):
        planned = np.zeros(3)
        planned[:2] = -s.kp_com * com.pos[0, :2] - s.kd_com * com.vel[0, :2]
        # the pressure point under the estimate gives the plan only where the estimate is right
        a = planned + GRAVITY / 0.8 * (pos - com.pos[0]) * [1, 1, 0]
        pos, vel = pos + PERIOD * vel + PERIOD**2 / 2 * a, vel + PERIOD * a
        if k == 50:
            vel = vel + np.array([0.4, 0.0, 0.0])
        seen = pos + rng.uniform(-s.com_noise, s.com_noise, 3)
        kalman.update(com, seen[None], planned[None], 0.003)
        errors.append(np.abs(com.vel[0] - vel).max())
    assert max(errors[30:50]) < 0.05
    assert errors[50] > 0.3  # it cannot know yet
    assert max(errors[58:]) < 0.1  # within 0.16 s
    assert np.abs(pos[:2]).max() < 0.01


# the stance


def bodies_of(soles_b: list[tuple[np.ndarray, np.ndarray]]) -> Bodies:
    """One robot of which only the soles are known."""
    pos = np.stack([np.full(3, np.nan), *(p for p, _ in soles_b)])[None]
    rot = np.stack([np.full((3, 3), np.nan), *(r for _, r in soles_b)])[None]
    nothing = np.full((1, 14, 3), np.nan)
    return Bodies(pos, rot, nothing, nothing, nothing[:, 0], nothing)


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
        stance = measured_stance(one_pose(np.zeros(3), np.eye(3)), bodies_of(soles))
        pos = np.array([*rng.uniform(-1, 1, 2), rng.uniform(0.5, 0.9)])
        rot = turned @ rotation(rng, 0.4)
        seen = bodies_of([(rot.T @ (p - pos), rot.T @ r) for p, r in soles])
        found = base_from_stance(seen, (rot.T @ UP)[None], stance)
        np.testing.assert_allclose(found.pos[0], pos, atol=1e-12)
        np.testing.assert_allclose(found.rot[0], rot, atol=1e-12)


def test_without_a_stance_the_anchor_lies_between_the_soles() -> None:
    rng, count = np.random.default_rng(5), 20
    up_b = np.stack([rotation(rng, 0.3).T @ UP for _ in range(count)])
    joints = np.tile(ROBOT.default_q, (count, 1))
    joints[:, :8] += rng.uniform(-0.1, 0.1, (count, 8))
    bodies = KINEMATICS.at(joints)
    base = base_from_stance(bodies, up_b, None)
    for i in range(count):
        pos, rot = base.pos[i], base.rot[i]
        np.testing.assert_allclose(rot @ up_b[i], UP, atol=1e-12)
        soles = [(pos + rot @ p, rot @ r) for p, r in zip(bodies.pos[i, 1:], bodies.rot[i, 1:], strict=True)]
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
    forces = distribute(points, rays, wrench, np.ones(6), 1e-3)
    found = np.concatenate([forces.sum(axis=0), moment_of(points, forces)])
    np.testing.assert_allclose(found, wrench, atol=1e-3)
    assert (np.abs(forces[:, :2]).max(axis=1) <= 0.4 / np.sqrt(2) * forces[:, 2] + 1e-9).all()
    assert (np.linalg.norm(forces[:, :2], axis=1) <= 0.4 * forces[:, 2] + 1e-9).all()


def test_no_force_pulls_at_the_ground() -> None:
    points, _ = contacts()
    wrench = np.array([300.0, 0.0, -50.0, 0.0, 200.0, 0.0])  # nothing a foot can do
    forces = distribute(points, friction_rays(0.4), wrench, np.ones(6), 0.02)
    assert np.isfinite(forces).all() and (forces[:, 2] >= 0.0).all()


def test_forces_are_those_of_non_negative_least_squares() -> None:
    """Lawson & Hanson 1974 as SciPy has it, an independent algorithm, at wrenches near and far."""
    rng, (points, _) = np.random.default_rng(6), contacts()
    rays, weight, damping = friction_rays(TUNED.friction), np.array([1.0, 1.0, 1.0, 3.0, 3.0, 0.2]), 0.02
    for _ in range(20):
        wrench = np.array([0.0, 0.0, MODEL.mass * GRAVITY, 0.0, 0.0, 0.0]) + rng.normal(size=6) * 40.0
        columns = np.array([[*ray, *np.cross(point, ray)] for point in points for ray in rays]).T
        stacked = np.concatenate([weight[:, None] * columns, damping * np.eye(columns.shape[1])])
        multiples, _ = nnls(stacked, np.concatenate([weight * wrench, np.zeros(columns.shape[1])]))
        wanted = multiples.reshape(len(points), len(rays)) @ rays
        np.testing.assert_allclose(distribute(points, rays, wrench, weight, damping), wanted, atol=1e-6)


def carried() -> tuple[np.ndarray, np.ndarray]:
    """A standing configuration (21,) and the forces (20,) of the contacts that carry it."""
    points, q = contacts()
    wrench = np.array([0.0, 0.0, MODEL.mass * GRAVITY, 0.0, 0.0, 0.0])
    forces = distribute(
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
    controller = IKController(ROBOT, Stub(), config)
    start = upright()
    obs, target = _observation(1, start)
    controller.reset(np.arange(1), obs, target)
    episode, bodies = controller._episodes, KINEMATICS.at(start.joints)
    seen = Seen(
        start.joints,
        start.joints,
        np.zeros((1, 14)),
        ROBOT.kp[None],
        UP[None],
        np.zeros((1, 3)),
        target_b(target),
        bodies,
    )
    torques = controller._balance(episode, seen, start.base, BOTH[None], bodies)[0]
    np.testing.assert_allclose(episode.acceleration, 0.0, atol=1e-3)
    q, generalized = carried()
    np.testing.assert_allclose(torques, (MODEL.gravity_torques(q) - generalized)[6:], atol=1e-3)


# the hand


def test_arm_reaches_a_near_pose() -> None:
    rng, count = np.random.default_rng(7), 20
    joints = np.tile(ROBOT.default_q, (count, 1))
    joints[:, 8:] += rng.uniform(-0.2, 0.2, (count, 6))
    near = joints.copy()
    near[:, 8:] += rng.uniform(-0.05, 0.05, (count, 6))
    goal = KINEMATICS.at(near)
    pose = Pose(goal.pos[:, 0], goal.rot[:, 0])
    found = joints.copy()
    for _ in range(6):  # damped: the fixed point is what counts
        found[:, 8:] = solve_arm(KINEMATICS, found, KINEMATICS.at(found), pose, 1e-3, 0.5)
    reached = KINEMATICS.at(found)
    for i in range(count):
        assert np.linalg.norm(reached.pos[i, 0] - pose.pos[i]) < 1e-4
        assert np.linalg.norm(pin.log3(reached.rot[i, 0].T @ pose.rot[i])) < 1e-4


def test_arm_stops_at_the_limit() -> None:
    start = ROBOT.default_q[None]
    bodies = KINEMATICS.at(start)
    far = Pose(bodies.pos[:, 0] + np.array([0.4, 0.4, 0.2]), bodies.rot[:, 0])
    found = solve_arm(KINEMATICS, start, bodies, far, TUNED.hand_damping, 0.1)
    assert np.abs(found - start[:, 8:]).max() == pytest.approx(0.1)


# the reference


def test_reference_keeps_its_speed_and_arrives() -> None:
    s, rng, count = TUNED, np.random.default_rng(8), 5
    ee = MODEL.ee_of(standing())
    hand = Pose(np.tile(ee[0], (count, 1)), np.tile(ee[1], (count, 1, 1)))
    turns = np.stack([rotation(rng, 1.0) for _ in range(count)])
    target = Pose(hand.pos + rng.uniform(-0.4, 0.4, (count, 3)), hand.rot @ turns)
    start = np.tile(ROBOT.default_q, (count, 1))
    reference = Reference.begin(hand, target, start)
    goal = start + 0.1
    reference.set_goal(start, goal)
    before = np.zeros(count)
    for _ in range(500):
        pos, rot = reference.hand.pos, reference.hand.rot
        reference.track(s, PERIOD, target)
        reference.advance(s, PERIOD)
        linear = np.linalg.norm(reference.hand.pos - pos, axis=1) / PERIOD
        turned = [pin.log3(a.T @ b) for a, b in zip(rot, reference.hand.rot, strict=True)]
        angular = np.linalg.norm(turned, axis=1) / PERIOD
        assert (linear <= s.slew_linear + 1e-9).all() and (angular <= s.slew_angular + 1e-9).all()
        share = np.maximum(linear / s.slew_linear, angular / s.slew_angular)
        assert (share - before <= PERIOD / s.slew_ramp + 1e-6).all()  # starts gently
        before = share
    np.testing.assert_allclose(reference.hand.pos, target.pos, atol=1e-4)
    np.testing.assert_allclose(reference.hand.rot, target.rot, atol=1e-4)
    np.testing.assert_allclose(reference.posture, goal, atol=1e-4)


@pytest.fixture(scope="module")
def plans() -> tuple[np.ndarray, np.ndarray]:
    """Joint positions (8, 14) at posture targets, and the errors (8,) left there, planned at once."""
    return plan(leaning_targets())


def leaning_targets() -> Pose:
    protocol, path = find_protocol("tuning_nominal_v1")
    rows, _ = read_manifest(protocol, manifest_path(path))
    lean = np.arccos(matrix_from_wxyz(rows.feasible_qpos[:, 3:7])[:, 2, 2])
    # plans do not lean further, so they miss targets that are out of reach of a base that leans less
    rows = rows.take(np.flatnonzero((rows.stratum == "posture") & (lean < MAX_LEAN))[:8])
    shift = np.array([*standing()[:2], 0.0])  # the base stands over the world's origin at reset
    return Pose(rows.target_pos_w + shift, matrix_from_wxyz(rows.target_quat_w))


def plan(target: Pose) -> tuple[np.ndarray, np.ndarray]:
    start = upright().take(np.zeros(len(target.pos), dtype=int))
    bodies = KINEMATICS.at(start.joints)
    stance = measured_stance(start.base, bodies)
    weight, default = TUNED.weights.planning_posture, ROBOT.default_q
    solver, hull = DaqpIK(ROBOT, TUNED.weights, PERIOD), stance.hull(MODEL.corners)
    return plan_goal_posture(
        solver, KINEMATICS, start, start.hand(bodies), target, stance, hull, default, weight
    )


def test_plan_reaches_posture_targets(plans) -> None:
    joints, error = plans
    assert (error < 0.02).all()
    assert ((joints > ROBOT.lower) & (joints < ROBOT.upper)).all()


def test_a_plan_does_not_depend_on_the_others_of_its_batch(plans) -> None:
    """Alone, an episode tries all its preferred postures at once; among eight, four at a time."""
    targets = leaning_targets()
    for i in (0, 5):
        joints, error = plan(targets.take(np.array([i])))
        np.testing.assert_array_equal(joints[0], plans[0][i])
        assert error[0] == plans[1][i]


# the controller


def _observation(count: int, q: Configuration) -> tuple[Observation, Target]:
    """Noise-free, at rest, with the hand where it is asked to be."""
    bodies = KINEMATICS.at(q.joints)
    still = Proprioception(
        base_ang_vel_b=np.zeros((count, 3)),
        gravity_b=np.tile(q.base.rot[0].T @ -UP, (count, 1)),
        joint_pos=np.tile(q.joints, (count, 1)),
        joint_vel=np.zeros((count, 14)),
        joint_torque=np.zeros((count, 14)),
    )
    target = Target(np.tile(bodies.pos[0, 0], (count, 1)), np.tile(bodies.rot[0, 0], (count, 1, 1)))
    return Observation(0.0, np.ones(count, dtype=bool), still, None, None, None), target


def target_b(target: Target) -> Pose:
    return Pose(target.pos_b, target.rot_b)


def test_unknown_variant() -> None:
    with pytest.raises(UnknownNameError, match="did you mean kinematic"):
        make(ROBOT, "kinematics")


@pytest.mark.parametrize("variant", ["", "kinematic", "osqp", "placo", "standing"])
def test_variants_are_named(variant: str) -> None:
    assert make(ROBOT, variant).info.name == (f"ik:{variant}" if variant else "ik")


class Stub:
    """A solver that succeeds until it is told to fail."""

    lanes, fails = 1, False

    def step(self, q: Configuration, *_: object, **__: object) -> tuple[Configuration, np.ndarray]:
        return q, np.full(len(q.joints), not self.fails)


def test_without_a_solution_the_last_command_is_held() -> None:
    solver = Stub()
    controller = IKController(ROBOT, solver, TUNED)
    obs, target = _observation(2, upright())
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
