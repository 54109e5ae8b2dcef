"""The floating-base IK controller: slewed target, whole-body IK, gravity feed-forward, balance feedback."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from wbc_baselines.ik.arm_servo import solve_arm
from wbc_baselines.ik.balance import distribute_contact_forces, friction_rays
from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.estimation import ComFilter, GravityFilter, JointFilter
from wbc_baselines.ik.load import GainObserver, PayloadObserver
from wbc_baselines.ik.model import GRAVITY, Pose, WholeBodyModel, configuration, leg_of
from wbc_baselines.ik.reference import Reference, plan_goal_posture
from wbc_baselines.ik.stance import Stance, base_from_sole, base_from_stance, measured_stance, yaw_matrix
from wbc_baselines.ik.stepping import (
    Swing,
    center_of_pressure,
    choose_swing_foot,
    outside,
    plan_foothold,
    solve_leg,
)
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.robot import NUM_LEG_JOINTS, Robot

Array = NDArray[np.float64]
PERIOD = 0.02  # [s]
LEGS, ARM = slice(0, NUM_LEG_JOINTS), slice(NUM_LEG_JOINTS, None)


class _Episode:
    """What the controller remembers of one episode, in the anchor frame."""

    def __init__(
        self, stance: Stance, q: Array, reference: Reference, com: ComFilter, payload: PayloadObserver
    ) -> None:
        self.step = 0
        self.swing: Swing | None = None
        self.prepared = False
        self.stance = stance
        self.hull = np.zeros((3, 2))  # (V, 2) [m] of the soles
        self.q = q  # (21,) reference configuration
        self.reference = reference
        self.com = com
        self.payload = payload
        self.torque = np.zeros(14)  # [N m] measured
        self.kp = np.ones(14)  # [N m/rad] as observed
        self.shift = np.zeros(3)  # [m] of the centre of mass by the payload, from the model's
        self.acceleration = np.zeros(3)  # [m/s^2] planned for the centre of mass
        self.turning = np.zeros(3)  # [rad/s^2] integral of the base's orientation error
        self.hand = np.zeros(6)  # [m, rad] integral of the hand's error in the base frame
        self.command = q[7:].copy()


class IKController:
    """Whole-body IK over the floating base at 50 Hz, anchored to the world by the stance feet alone."""

    def __init__(self, robot: Robot, solver, config: IKConfig, name: str = "ik") -> None:
        self.info = ControllerInfo(name, frozenset({"proprioception"}), PERIOD, "wbc_baselines.ik")
        self._robot, self._solver, self._s = robot, solver, config
        self._model = WholeBodyModel(robot)
        s = config
        self._joints = JointFilter(PERIOD, s.joint_pos_noise, s.joint_vel_noise, s.joint_acceleration)
        self._gravity = GravityFilter(PERIOD, s.gravity_noise, s.gyro_noise)
        self._rays = friction_rays(s.friction)
        self._gains = GainObserver(PERIOD, s, robot.kp, robot.kd, robot.effort)
        self._contacts = self._model.corners * np.array([1.0, s.sole_width, 1.0])
        self._weight = np.array([1.0, 1.0, 1.0, s.roll_weight, s.pitch_weight, s.yaw_weight])

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Start from the measured posture."""
        measured = obs.proprioception
        assert measured is not None
        self._joints.reset(measured.joint_pos)
        self._gravity.reset(measured.gravity_b)
        self._first = True
        self._gains.reset(len(episodes))
        self._episodes = [self._start(i, target) for i in range(len(episodes))]

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Joint commands (N, 14) [rad]; an episode without a solution holds its last command."""
        measured = obs.proprioception
        assert measured is not None
        if not self._first:  # the first observation is the one of the reset
            self._joints.update(measured.joint_pos, measured.joint_vel)
            self._gravity.update(measured.gravity_b, measured.base_ang_vel_b)
            if self._s.observe_torques:
                self._gains.update(self._sent, self._joints.pos, self._joints.vel, measured.joint_torque)
        self._first = False
        q = np.tile(self._robot.default_q, (len(obs.active), 1))
        infeasible = np.zeros(len(obs.active), dtype=bool)
        for i in np.flatnonzero(obs.active):
            episode = self._episodes[i]
            episode.torque = measured.joint_torque[i]
            episode.kp = self._robot.kp * self._gains.factor[i]
            infeasible[i] = not self._step(
                episode,
                measured.joint_pos[i],
                self._joints.pos[i],
                -self._gravity.gravity[i],
                measured.base_ang_vel_b[i],
                (target.pos_b[i], target.rot_b[i]),
            )
            q[i] = episode.command
        self._sent = q
        return JointCommand(q, infeasible)

    def _start(self, i: int, target: Target) -> _Episode:
        model, joints, s = self._model, self._joints.pos[i], self._s
        soles_b = model.soles_in_base(joints)
        pos, rot = base_from_stance(soles_b, -self._gravity.gravity[i], None)
        q = configuration(pos, rot, joints)
        com = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_jump, model.com_of(q))
        goal = (pos + rot @ target.pos_b[i], rot @ target.rot_b[i])
        reference = Reference(s, PERIOD, model.ee_of(q), goal, self._robot.default_q)
        return _Episode(_stance_of(pos, rot, soles_b), q, reference, com, PayloadObserver(PERIOD, s))

    def _land(self, e: _Episode, base: Pose, soles_b: list[Pose], joints: Array, target_b: Pose) -> None:
        """Both feet stand again: start over from here, but for what is known of the centre of mass."""
        pos, rot = base
        e.swing, e.step = None, 1
        e.stance = _stance_of(pos, rot, soles_b)
        e.q = configuration(pos, rot, joints)
        goal = (pos + rot @ target_b[0], rot @ target_b[1])
        e.reference = Reference(self._s, PERIOD, self._model.ee_of(e.q), goal, e.reference.posture)

    def _step(
        self, e: _Episode, raw: Array, joints: Array, up_b: Array, ang_vel_b: Array, target_b: Pose
    ) -> bool:
        """One control step from joint positions (14,) raw and filtered; False when the IK has no solution."""
        s, model = self._s, self._model
        e.step += 1
        # raw joint angles: a filter before the one of the centre of mass would only delay it
        soles_b = model.soles_in_base(raw)
        if e.swing is not None:
            stand = 1 - e.swing.side
            base = base_from_sole(soles_b[stand], up_b, e.stance.xy[stand], float(e.stance.yaw[stand]))
            if e.swing.left > 0:
                self._swing(e, e.swing, base, raw, joints, ang_vel_b)
                return True
            self._land(e, base, soles_b, joints, target_b)
        pos, rot = base_from_stance(soles_b, up_b, e.stance)
        e.stance = e.stance.toward(_stance_of(pos, rot, soles_b), PERIOD / s.stance_filter)
        if e.step % 10 == 1:
            e.hull = e.stance.hull(model.corners)
        soles = e.stance.poses()

        reference = e.reference
        reference.track((pos + rot @ target_b[0], rot @ target_b[1]))
        if e.step * PERIOD > s.settle:
            if reference.goal is None:
                goal, _ = self._plan(e, e.stance, e.hull)
                reference.set_goal(e.q[7:].copy(), goal)
            reference.advance()
        weight = s.weights.standing_posture if reference.goal is None else s.weights.posture
        # the program knows the model's centre of mass, which must stand where the shifted one is inside
        hull = e.hull - e.shift[:2]
        # the measured stance may be far from the reference: the first step must be free to jump there
        q = self._solver.step(
            e.q, reference.ee, soles, hull, reference.posture, weight, limit_speed=e.step > 1
        )
        if q is None:
            return False
        e.q = q
        e.command = q[7:].copy()
        near = np.clip(s.hand_blend - reference.left, 0.0, 1.0)
        if s.feedback and near > 0:
            e.command[ARM] += near * (self._hold_hand(e, joints, target_b) - q[7:][ARM])
        if s.feedforward:
            torques = self._balance(e, configuration(pos, rot, raw), rot, ang_vel_b, (0, 1))
            e.command += np.clip(torques, -self._robot.effort, self._robot.effort) / e.kp
            e.command[LEGS] += s.compliance * (joints - q[7:])[LEGS]
        if s.stepping and e.step * PERIOD > s.step_wait:
            capture, rate = e.com.capture_point()
            if outside(capture, e.hull) > s.step_trigger or self._may_widen(e, capture, rate):
                side = choose_swing_foot(s, e.stance, capture, rate, model.corners)
                e.swing = Swing(side, s.step_duration, joints[leg_of(side)].copy())
        return True

    def _may_widen(self, e: _Episode, capture: Array, rate: float) -> bool:
        """Once, standing calmly on a narrow stance: whether the target stays in reach from a wider one."""
        s, model = self._s, self._model
        if e.prepared or e.step * PERIOD < s.step_prepare_time:
            return False
        e.prepared = True
        # a step swings the hand: one that is at its target already stays there
        if e.stance.width() > s.step_prepare or e.reference.left < s.step_prepare_way:
            return False
        side = choose_swing_foot(s, e.stance, capture, rate, model.corners)
        wider = e.stance.moved(
            side, plan_foothold(s, e.stance, side, capture, rate, s.step_duration, model.corners).xy
        )
        _, error = self._plan(e, wider, wider.hull(model.corners))
        return error < s.step_prepare_error

    def _plan(self, e: _Episode, stance: Stance, hull: Array) -> tuple[Array, float]:
        """Joint positions (14,) at the target on a stance, and the error [m + 0.3 m/rad] left there."""
        way, default, weight = e.reference, self._robot.default_q, self._s.weights.planning_posture
        return plan_goal_posture(
            self._solver, self._model, e.q, way.ee, way.target, stance.poses(), hull, default, weight
        )

    def _swing(
        self, e: _Episode, swing: Swing, base: Pose, raw: Array, joints: Array, ang_vel_b: Array
    ) -> None:
        """One control step on one foot: it carries the robot, the other leg swings, the arm is held."""
        s, model, (pos, rot) = self._s, self._model, base
        stand = 1 - swing.side
        measured = configuration(pos, rot, raw)
        torques = self._balance(e, measured, rot, ang_vel_b, (stand,))
        swing.time += PERIOD
        capture, rate = e.com.capture_point()
        if swing.landing is None or swing.left > s.step_aim:
            swing.landing = plan_foothold(s, e.stance, swing.side, capture, rate, swing.left, model.corners)
        # where the base will be when the foot lands
        p = center_of_pressure(capture, e.stance.xy[stand], float(e.stance.yaw[stand]), model.corners)
        grow = rate * swing.left
        com = e.com.pos[:2]
        shift = (np.cosh(grow) - 1) * (com - p) + np.sinh(grow) / rate * e.com.vel[:2]
        yaw = yaw_matrix(float(e.stance.yaw[stand]))
        leg, standing = leg_of(swing.side), leg_of(stand)
        goals = []
        for part, height in ((1.0, -s.step_press), (0.5, s.step_height)):
            start = e.stance.xy[swing.side]
            xy = start + part * (swing.landing.xy - start)
            base_pos = pos + part * np.array([*shift, 0.0])
            where = np.array([*xy, height]) - base_pos
            goals.append(solve_leg(model, raw, swing.side, (rot.T @ where, rot.T @ yaw)))
        q, qd, qdd = swing.follow(*goals)
        kp, kd = e.kp, self._robot.kd
        accelerations = np.zeros(14)
        accelerations[leg] = qdd
        torques[leg] = model.torques(measured, e.acceleration, accelerations)[leg]
        torques = np.clip(torques, -self._robot.effort, self._robot.effort)
        e.command[leg] = q + (torques[leg] + kd[leg] * qd) / kp[leg]
        e.command[standing] = joints[standing] + torques[standing] / kp[standing]

    def _hold_hand(self, e: _Episode, joints: Array, target_b: Pose) -> Array:
        """Arm joints (6,) [rad] that keep the hand where the slewed target is, seen from the swaying base."""
        s, reference = self._s, e.reference
        if reference.left < 0.5:
            (pos, rot), _ = self._model.arm_in_base(joints)
            error = np.concatenate([target_b[0] - pos, pin.log3(target_b[1] @ rot.T)])
            limit = s.hand_integral_limit
            e.hand = np.clip(e.hand + PERIOD * s.hand_integral * error, -limit, limit)
        # the slewed target relative to the target holds in any frame: no estimate of the base enters
        turn_back = target_b[1] @ reference.target[1].T
        pos = target_b[0] + turn_back @ (reference.ee[0] - reference.target[0]) + e.hand[:3]
        rot = pin.exp3(e.hand[3:]) @ turn_back @ reference.ee[1]
        arm = solve_arm(self._model, e.q[7:], (pos, rot), s.hand_damping, s.hand_limit)
        return np.clip(arm, self._robot.lower[ARM], self._robot.upper[ARM])

    def _balance(
        self, e: _Episode, measured: Array, rot: Array, ang_vel_b: Array, standing: tuple[int, ...]
    ) -> Array:
        """Torques (14,) [N m] that carry the weight and bring centre of mass and base to the reference."""
        s, model = self._s, self._model
        model.update(measured)
        soles = [model.pose(model.soles[side]) for side in standing]
        jacobians = [model.jacobian(model.soles[side]) for side in standing]
        hand, com = model.jacobian(model.tcp), model.data.com[0].copy()
        ee = model.pose(model.tcp)[0]
        torques = model.gravity_torques(measured)
        if s.observe_torques and e.step * PERIOD > s.payload_after:
            e.payload.update(hand[:, 14:], torques[14:], e.torque[ARM])
        torques = torques + e.payload.mass * GRAVITY * hand[2]
        mass = model.mass + e.payload.mass
        e.shift = e.payload.mass / mass * (ee - com)
        com = com + e.shift
        e.com.update(com, e.acceleration, s.com_tilt * self._gravity.deviation)
        wrench = np.zeros(6)
        wrench[2] = mass * GRAVITY
        if s.feedback:
            error = model.com_of(e.q) + e.shift - e.com.pos
            wrench[:3] += mass * (s.kp_com * error - s.kd_com * e.com.vel)
            rot_ref = pin.Quaternion(e.q[3:7]).toRotationMatrix()
            error = rot @ pin.log3(rot.T @ rot_ref)
            limit = s.rot_integral_limit
            e.turning = np.clip(e.turning + PERIOD * s.ki_rot * error, -limit, limit)
            wrench[3:] = s.inertia * (s.kp_rot * error - s.kd_rot * (rot @ ang_vel_b) + e.turning)
        arms = [self._contacts @ r.T for _, r in soles]
        points = np.concatenate([p + arm for (p, _), arm in zip(soles, arms, strict=True)]) - e.com.pos
        forces = distribute_contact_forces(points, self._rays, wrench, self._weight, s.damping)
        e.acceleration = forces.sum(axis=0) / mass
        e.acceleration[2] -= GRAVITY
        for jacobian, arm, force in zip(jacobians, arms, np.split(forces, len(arms)), strict=True):
            torques -= jacobian.T @ np.concatenate([force.sum(axis=0), moment_of(arm, force)])
        return torques[6:]


def moment_of(arms: Array, forces: Array) -> Array:
    """Moment (3,) [N m] of forces (P, 3) at points (P, 3) about the origin of the points."""
    (x, y, z), (fx, fy, fz) = arms.T, forces.T
    return np.array([(y * fz - z * fy).sum(), (z * fx - x * fz).sum(), (x * fy - y * fx).sum()])


def _stance_of(pos: Array, rot: Array, soles_b: list[Pose]) -> Stance:
    return measured_stance([(pos + rot @ p, rot @ r) for p, r in soles_b])
