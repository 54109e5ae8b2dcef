"""The floating-base IK controller: slewed target, whole-body IK, gravity feed-forward, balance feedback.

All episodes of a shard are computed at once. Those in which a foot swings go their own way for that time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.arm_servo import solve_arm
from wbc_baselines.ik.balance import distribute_contact_forces, friction_rays
from wbc_baselines.ik.batch_ik import BatchIK
from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.estimation import Com, ComFilter, GravityFilter, JointFilter
from wbc_baselines.ik.geometry import (
    Pose,
    cross,
    dot,
    log3,
    rotate,
    rotate_back,
    transposed,
)
from wbc_baselines.ik.kinematics import GRAVITY, SOLES, TCP, Bodies, Configuration, Kinematics
from wbc_baselines.ik.load import GainObserver, Payload
from wbc_baselines.ik.reference import Reference, plan_goal_posture
from wbc_baselines.ik.rows import Mask, Rows, on_part
from wbc_baselines.ik.stance import Hull, Stance, base_from_sole, base_from_stance, measured_stance
from wbc_baselines.ik.stepping import (
    LEGS,
    STANDING,
    Sides,
    Swing,
    center_of_pressure,
    choose_swing_foot,
    plan_foothold,
    solve_leg,
)
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.robot import NUM_LEG_JOINTS, Robot
from wbc_bench.rotations import matrix_from_rotvec, yaw_matrix

Array = NDArray[np.float64]
PERIOD = 0.02  # [s]
LEG, ARM = slice(0, NUM_LEG_JOINTS), slice(NUM_LEG_JOINTS, None)
HULL_STEPS = 10  # control steps after which the support polygon follows the stance
BOTH = np.array([0, 1])


@dataclass
class Episodes(Rows):
    """What the controller remembers of N episodes, in the anchor frame of each."""

    step: NDArray[np.int64]  # (N,) since the start or the last landing
    swing: Swing
    prepared: Mask  # (N,) whether a wider stance was thought of
    stance: Stance
    hull: Hull  # of the soles
    q: Configuration  # reference
    reference: Reference
    com: Com
    payload: Payload
    shift: Array  # (N, 3) [m] of the centre of mass by the payload, from the model's
    acceleration: Array  # (N, 3) [m/s^2] planned for the centre of mass
    turning: Array  # (N, 3) [rad/s^2] integral of the base's orientation error
    hand: Array  # (N, 6) [m, rad] integral of the hand's error in the base frame
    command: Array  # (N, 14) [rad]


@dataclass
class Seen(Rows):
    """What is measured of N episodes in a control step."""

    raw: Array  # (N, 14) [rad] joint positions
    joints: Array  # (N, 14) [rad] filtered
    torque: Array  # (N, 14) [N m]
    kp: Array  # (N, 14) [N m/rad] as observed
    up_b: Array  # (N, 3) the vertical in the base frame
    ang_vel_b: Array  # (N, 3) [rad/s]
    target_b: Pose  # of the hand in the base frame
    bodies: Bodies  # at the raw joint angles: a filter before the one of the centre of mass would only delay


class IKController:
    """Whole-body IK over the floating base at 50 Hz, anchored to the world by the stance feet alone."""

    def __init__(self, robot: Robot, solver: BatchIK, config: IKConfig, name: str = "ik") -> None:
        self.info = ControllerInfo(name, frozenset({"proprioception"}), PERIOD, "wbc_baselines.ik")
        self._robot, self._solver, self._s = robot, solver, config
        self._kinematics = Kinematics(robot)
        s, foot = config, robot.facts.foot
        self._corners = np.array(
            [(x, y, 0.0) for x in foot.x for y in foot.y]
        )  # (4, 3) [m] in the sole frame
        self._joints = JointFilter(PERIOD, s.joint_pos_noise, s.joint_vel_noise, s.joint_acceleration)
        self._gravity = GravityFilter(PERIOD, s.gravity_noise, s.gyro_noise)
        self._com = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_jump)
        self._rays = friction_rays(s.friction)
        self._gains = GainObserver(PERIOD, s, robot.kp, robot.kd, robot.effort)
        self._contacts = self._corners * np.array([1.0, s.sole_width, 1.0])
        self._weight = np.array([1.0, 1.0, 1.0, s.roll_weight, s.pitch_weight, s.yaw_weight])

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Start from the measured posture."""
        measured, count = obs.proprioception, len(episodes)
        assert measured is not None
        self._joints.reset(measured.joint_pos)
        self._gravity.reset(measured.gravity_b)
        self._first = True
        self._gains.reset(count)
        joints = self._joints.pos.copy()
        bodies = self._kinematics.at(joints)
        base = base_from_stance(bodies, -self._gravity.gravity, None)
        q, stance = Configuration(base, joints), measured_stance(base, bodies)
        goal, default = base.at(target.pos_b, target.rot_b), np.tile(self._robot.default_q, (count, 1))
        self._episodes = Episodes(
            step=np.zeros(count, dtype=np.int64),
            swing=Swing.none(count),
            prepared=np.zeros(count, dtype=bool),
            stance=stance,
            hull=stance.hull(self._corners),
            q=q,
            reference=Reference.begin(q.hand(bodies), goal, default),
            com=self._com.start(q.com(bodies)),
            payload=Payload(np.zeros(count), np.zeros(count)),
            shift=np.zeros((count, 3)),
            acceleration=np.zeros((count, 3)),
            turning=np.zeros((count, 3)),
            hand=np.zeros((count, 6)),
            command=joints.copy(),
        )

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
        active = obs.active
        if active.any():
            seen = Seen(
                raw=measured.joint_pos[active],
                joints=self._joints.pos[active],
                torque=measured.joint_torque[active],
                kp=self._robot.kp * self._gains.factor[active],
                up_b=-self._gravity.gravity[active],
                ang_vel_b=measured.base_ang_vel_b[active],
                target_b=Pose(target.pos_b[active], target.rot_b[active]),
                bodies=self._kinematics.at(measured.joint_pos[active]),
            )
            part = self._episodes.take(active)
            infeasible[active] = ~self._step(part, seen)
            self._episodes.put(active, part)
            q[active] = part.command
        self._sent = q
        return JointCommand(q, infeasible)

    def _step(self, e: Episodes, seen: Seen) -> Mask:
        """One control step; a mask (N,) of the episodes whose IK has a solution."""
        e.step += 1
        on_foot = e.swing.side != STANDING
        swings = on_foot & (e.swing.left(self._s.step_duration) > 0)
        lands = on_foot & ~swings
        solved = np.ones(len(swings), dtype=bool)
        if swings.any():
            on_part(swings, self._swing, e, seen)
        if lands.any():
            on_part(lands, self._land, e, seen)
        if not swings.all():
            solved[~swings] = on_part(~swings, self._stand, e, seen)
        return solved

    def _base_on_foot(self, e: Episodes, seen: Seen) -> Pose:
        """Bases of robots that stand on the foot that does not swing."""
        rows, stand = np.arange(len(e.step)), 1 - e.swing.side
        sole = np.array(SOLES)[stand]
        sole_b = Pose(seen.bodies.pos[rows, sole], seen.bodies.rot[rows, sole])
        return base_from_sole(sole_b, seen.up_b, e.stance.xy[rows, stand], e.stance.yaw[rows, stand])

    def _land(self, e: Episodes, seen: Seen) -> None:
        """Both feet stand again: start over from here, but for what is known of the centre of mass."""
        base = self._base_on_foot(e, seen)
        e.swing, e.step = Swing.none(len(e.step)), np.ones_like(e.step)
        e.stance = measured_stance(base, seen.bodies)
        e.q = Configuration(base, seen.joints.copy())
        hand = e.q.hand(self._kinematics.at(seen.joints))
        goal = base.at(seen.target_b.pos, seen.target_b.rot)
        e.reference = Reference.begin(hand, goal, e.reference.posture)

    def _stand(self, e: Episodes, seen: Seen) -> Mask:
        """One control step on both feet; a mask (N,) of the episodes whose IK has a solution."""
        s, reference = self._s, e.reference
        base = base_from_stance(seen.bodies, seen.up_b, e.stance)
        e.stance = e.stance.toward(measured_stance(base, seen.bodies), PERIOD / s.stance_filter)
        outdated = e.step % HULL_STEPS == 1
        if outdated.any():
            e.hull.put(outdated, e.stance.take(outdated).hull(self._corners))
        reference.track(s, PERIOD, base.at(seen.target_b.pos, seen.target_b.rot))
        moves = e.step * PERIOD > s.settle
        if moves.any():
            if (unplanned := moves & ~reference.planned).any():
                on_part(unplanned, self._set_goal, e)
            on_part(moves, lambda part: part.advance(s, PERIOD), reference)
        weight = np.where(reference.planned, s.weights.posture, s.weights.standing_posture)
        # the program knows the model's centre of mass, which must stand where the shifted one is inside
        hull = e.hull.moved(-e.shift[:, :2])
        e.q, solved = self._solver.step(
            e.q, reference.hand, e.stance, hull, reference.posture, weight, e.step > 1
        )
        if solved.any():
            on_part(solved, self._command, e, seen, base)
        return solved

    def _set_goal(self, e: Episodes) -> None:
        goal, _ = self._plan(e, e.stance, e.hull)
        e.reference.set_goal(e.q.joints.copy(), goal)

    def _command(self, e: Episodes, seen: Seen, base: Pose) -> None:
        """Commands that follow the new reference configuration, and perhaps the decision to step."""
        s = self._s
        wanted = self._kinematics.at(e.q.joints)
        e.command = e.q.joints.copy()
        near = np.clip(s.hand_blend - e.reference.left, 0.0, 1.0)
        if s.feedback and (near > 0).any():
            arm = on_part(near > 0, self._hold_hand, e, seen, wanted)
            e.command[near > 0, ARM] += near[near > 0, None] * (arm - e.q.joints[near > 0, ARM])
        if s.feedforward:
            torques = self._balance(e, seen, base, np.tile(BOTH, (len(near), 1)), wanted)
            e.command += np.clip(torques, -self._robot.effort, self._robot.effort) / seen.kp
            e.command[:, LEG] += s.compliance * (seen.joints - e.q.joints)[:, LEG]
        waited = e.step * PERIOD > s.step_wait
        if s.stepping and waited.any():
            on_part(waited, self._decide_to_step, e, seen)

    def _decide_to_step(self, e: Episodes, seen: Seen) -> None:
        """Lift a foot where the capture point has left the soles, or a narrow stance is better widened."""
        s = self._s
        capture, _ = e.com.capture_point()
        steps = e.hull.outside(capture) > s.step_trigger
        calm = ~steps & ~e.prepared & (e.step * PERIOD >= s.step_prepare_time)
        if calm.any():
            steps[calm] = on_part(calm, self._may_widen, e)
        if steps.any():
            on_part(steps, self._lift, e, seen)

    def _lift(self, e: Episodes, seen: Seen) -> None:
        side = choose_swing_foot(self._s, e.stance, *e.com.capture_point(), self._corners)
        e.swing = Swing.none(len(side))
        e.swing.side, e.swing.start = side, seen.joints[np.arange(len(side))[:, None], LEGS[side]]

    def _may_widen(self, e: Episodes) -> Mask:
        """Once, standing calmly on a narrow stance: whether the target stays in reach from a wider one."""
        s = self._s
        e.prepared = np.ones_like(e.prepared)
        # a step swings the hand: one that is at its target already stays there
        worth = (e.stance.width() <= s.step_prepare) & (e.reference.left >= s.step_prepare_way)
        if worth.any():
            worth[worth] = on_part(worth, self._reaches_from_wider, e)
        return worth

    def _reaches_from_wider(self, e: Episodes) -> Mask:
        s = self._s
        capture, rate = e.com.capture_point()
        side = choose_swing_foot(s, e.stance, capture, rate, self._corners)
        left = np.full(len(side), s.step_duration)
        place, _ = plan_foothold(s, e.stance, side, capture, rate, left, self._corners)
        wider = e.stance.moved(side, place)
        _, error = self._plan(e, wider, wider.hull(self._corners))
        return error < s.step_prepare_error

    def _plan(self, e: Episodes, stance: Stance, hull: Hull) -> tuple[Array, Array]:
        """Joint positions (N, 14) at targets on stances, and the errors (N,) [m + 0.3 m/rad] left there."""
        way, default, weight = e.reference, self._robot.default_q, self._s.weights.planning_posture
        return plan_goal_posture(
            self._solver, self._kinematics, e.q, way.hand, way.target, stance, hull, default, weight
        )

    def _swing(self, e: Episodes, seen: Seen) -> None:
        """One control step on one foot: it carries the robot, the other leg swings, the arm is held."""
        s, swing, kinematics = self._s, e.swing, self._kinematics
        base, rows = self._base_on_foot(e, seen), np.arange(len(e.step))
        side, stand = swing.side, 1 - swing.side
        # no other reference is known in a swing than that of the last step on both feet
        torques = self._balance(e, seen, base, stand[:, None], kinematics.at(e.q.joints))
        swing.time += PERIOD
        left = swing.left(s.step_duration)
        capture, rate = e.com.capture_point()
        place, _ = plan_foothold(s, e.stance, side, capture, rate, left, self._corners)
        open_still = np.isnan(swing.landing[:, 0]) | (left > s.step_aim)
        swing.landing = np.where(open_still[:, None], place, swing.landing)
        # where the base will be when the foot lands
        xy, yaw = e.stance.xy[rows, stand], e.stance.yaw[rows, stand]
        p = center_of_pressure(capture, xy, yaw, self._corners)
        grow = (rate * left)[:, None]
        way = (np.cosh(grow) - 1) * (e.com.pos[:, :2] - p) + np.sinh(grow) / rate[:, None] * e.com.vel[:, :2]
        leg, goals = LEGS[side], []
        sole_rot = transposed(base.rot) @ yaw_matrix(yaw)
        for part, height in ((1.0, -s.step_press), (0.5, s.step_height)):
            start = e.stance.xy[rows, side]
            where = -base.pos
            where[:, :2] += start + part * (swing.landing - start) - part * way
            where[:, 2] += height
            goals.append(solve_leg(kinematics, seen.raw, side, rotate_back(base.rot, where), sole_rot))
        q, qd, qdd = swing.follow(s.step_duration, *goals)
        each = rows[:, None]
        moving = kinematics.leg_inertia(seen.raw, leg) @ qdd[..., None]
        torques[each, leg] = self._lifting(e.acceleration, base, seen.bodies)[each, leg] + moving[..., 0]
        torques = np.clip(torques, -self._robot.effort, self._robot.effort)
        kp, kd, standing = seen.kp, self._robot.kd, LEGS[stand]
        e.command[each, leg] = q + (torques[each, leg] + kd[leg] * qd) / kp[each, leg]
        held = seen.joints[each, standing]
        e.command[each, standing] = held + torques[each, standing] / kp[each, standing]

    def _lifting(self, acceleration: Array, base: Pose, bodies: Bodies) -> Array:
        """Torques (N, 14) [N m] against gravity and an acceleration (N, 3) [m/s^2] of the whole robot."""
        force = self._kinematics.mass * rotate_back(base.rot, acceleration + np.array([0.0, 0.0, GRAVITY]))
        return dot(bodies.com_linear, force[:, None])

    def _hold_hand(self, e: Episodes, seen: Seen, wanted: Bodies) -> Array:
        """Arm joints (N, 6) [rad] that keep hands where the slewed targets are, seen from a swaying base."""
        s, way, target = self._s, e.reference, seen.target_b
        if (close := way.left < 0.5).any():
            on_part(close, self._integrate_hand, e, seen)
        # the slewed target relative to the target holds in any frame: no estimate of the base enters
        turn_back = target.rot @ transposed(way.target.rot)
        pos = target.pos + rotate(turn_back, way.hand.pos - way.target.pos) + e.hand[:, :3]
        rot = matrix_from_rotvec(e.hand[:, 3:]) @ turn_back @ way.hand.rot
        arm = solve_arm(self._kinematics, e.q.joints, wanted, Pose(pos, rot), s.hand_damping, s.hand_limit)
        return np.clip(arm, self._robot.lower[ARM], self._robot.upper[ARM])

    def _integrate_hand(self, e: Episodes, seen: Seen) -> None:
        s, bodies = self._s, self._kinematics.at(seen.joints)
        turning = log3(seen.target_b.rot @ transposed(bodies.rot[:, TCP]))
        error = np.concatenate([seen.target_b.pos - bodies.pos[:, TCP], turning], axis=1)
        limit = s.hand_integral_limit
        e.hand = np.clip(e.hand + PERIOD * s.hand_integral * error, -limit, limit)

    def _balance(self, e: Episodes, seen: Seen, base: Pose, sides: Sides, wanted: Bodies) -> Array:
        """Torques (N, 14) [N m] that carry the weight and bring centre of mass and base to the reference.

        sides: (N, K) feet that stand; wanted: kinematics of the reference configuration.
        """
        s, bodies, rot = self._s, seen.bodies, base.rot
        joints, rows = Configuration(base, seen.raw), np.arange(len(sides))[:, None]
        hand, com = joints.hand(bodies), joints.com(bodies)
        torques = self._lifting(np.zeros(3), base, bodies)
        up = rot[:, None, 2]  # the vertical in the base frame
        lift = dot(bodies.linear[:, ARM], up)  # (N, 6) [m/rad] of the hand
        if s.observe_torques:
            residual = seen.torque[:, ARM] - torques[:, ARM]
            e.payload.update(s, PERIOD, e.step * PERIOD > s.payload_after, lift, residual)
        payload = e.payload.mass[:, None]
        torques[:, ARM] += payload * GRAVITY * lift
        mass = self._kinematics.mass + payload
        e.shift = payload / mass * (hand.pos - com)
        self._com.update(e.com, com + e.shift, e.acceleration, s.com_tilt * self._gravity.deviation)
        wrench = np.zeros((len(sides), 6))
        wrench[:, 2] = mass[:, 0] * GRAVITY
        if s.feedback:
            error = e.q.com(wanted) + e.shift - e.com.pos
            wrench[:, :3] += mass * (s.kp_com * error - s.kd_com * e.com.vel)
            error = rotate(rot, log3(transposed(rot) @ e.q.base.rot))
            limit = s.rot_integral_limit
            e.turning = np.clip(e.turning + PERIOD * s.ki_rot * error, -limit, limit)
            swaying = s.kd_rot * rotate(rot, seen.ang_vel_b)
            wrench[:, 3:] = s.inertia * (s.kp_rot * error - swaying + e.turning)
        sole = np.array(SOLES)[sides]
        soles = base.pos[:, None] + rotate(rot[:, None], bodies.pos[rows, sole])  # (N, K, 3)
        arms = self._contacts @ transposed(rot[:, None] @ bodies.rot[rows, sole])  # (N, K, 4, 3)
        points = (soles - e.com.pos[:, None])[:, :, None] + arms
        forces = distribute_contact_forces(
            points.reshape(len(sides), -1, 3), self._rays, wrench, self._weight, s.damping
        ).reshape(points.shape)
        force, moment = forces.sum(axis=2), cross(arms, forces).sum(axis=2)  # (N, K, 3) on each sole
        e.acceleration = force.sum(axis=1) / mass
        e.acceleration[:, 2] -= GRAVITY
        legs = LEGS[sides]  # (N, K, 4)
        force, moment = rotate_back(rot[:, None], force), rotate_back(rot[:, None], moment)
        each = rows[:, :, None]
        carried = dot(bodies.linear[each, legs], force[:, :, None])
        torques[each, legs] -= carried + dot(bodies.axis[each, legs], moment[:, :, None])
        return torques
