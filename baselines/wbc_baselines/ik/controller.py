"""The floating-base IK controller: slewed target, whole-body IK, gravity feed-forward, balance feedback."""

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.robot import Robot

from wbc_baselines.ik.balance import distribute, friction_rays
from wbc_baselines.ik.estimation import ComFilter, GravityFilter, JointFilter
from wbc_baselines.ik.model import GRAVITY, Pose, WholeBodyModel, configuration, turn
from wbc_baselines.ik.settings import Settings
from wbc_baselines.ik.stance import Stance, base_from_stance, measured_stance

Array = NDArray[np.float64]
PERIOD = 0.02  # [s]


class _Episode:
    """What the controller remembers of one episode; poses in the anchor frame."""

    def __init__(self, stance: Stance, q: Array, ee: Pose, target: Pose, com: ComFilter) -> None:
        self.step = 0
        self.stance = stance  # where the soles stand
        self.q = q  # (21,) reference configuration
        self.ee = ee  # slewed target
        self.target = target  # filtered target
        self.com = com
        self.acceleration = np.zeros(3)  # [m/s^2] planned for the centre of mass
        self.speed = 0.0  # of the slewing, as a fraction of its limit
        self.start = q[7:]  # (14,) joint positions before the way,
        self.goal: Array | None = None  # (14,) planned at its end,
        self.way, self.left = 0.0, 0.0  # [s] its length at full speed, and what is left of it
        self.correction_pos, self.correction_rot = np.zeros(3), np.zeros(3)  # integral of the hand's error
        self.rot_integral = np.zeros(3)  # [rad/s^2]
        self.command = q[7:].copy()
        self.hull = np.zeros((3, 2))


class IKController:
    """Whole-body IK over the floating base at 50 Hz, anchored at the stance feet."""

    def __init__(self, robot: Robot, solver, settings: Settings, name: str = "ik") -> None:
        self.info = ControllerInfo(name, frozenset({"proprioception"}), PERIOD, f"wbc_baselines.{name}")
        self._robot, self._solver, self._s = robot, solver, settings
        self._model = WholeBodyModel(robot)
        self._joints = JointFilter(PERIOD, 0.01, 1.5, settings.joint_acceleration)
        self._gravity = GravityFilter(PERIOD, 0.05, 0.2)
        self._rays = friction_rays(settings.friction)
        self._contacts = self._model.corners * np.array([settings.sole_x, settings.sole_y, 1.0])
        self._weight = np.array([1, 1, 1, *[settings.moment_weight] * 2, settings.yaw_weight])

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Start from the measured posture."""
        p = obs.proprioception
        self._joints.reset(p.joint_pos)
        self._gravity.reset(p.gravity_b)
        self._fresh = True
        self._episodes = [self._start(i, target) for i in range(len(episodes))]

    def _start(self, i: int, target: Target) -> _Episode:
        model, joints = self._model, self._joints.pos[i]
        soles_b = model.soles_in_base(joints)
        pos, rot = base_from_stance(soles_b, -self._gravity.gravity[i], None)
        stance = measured_stance([(pos + rot @ p, rot @ r) for p, r in soles_b])
        q = configuration(pos, rot, joints)
        s = self._s
        com = ComFilter(PERIOD, s.com_noise, s.com_acceleration, s.com_drift, s.com_jump, s.com_threshold, model.com_of(q))
        goal = (pos + rot @ target.pos_b[i], rot @ target.rot_b[i])
        episode = _Episode(stance, q, model.ee_of(q), goal, com)
        episode.row = i
        return episode

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Joint commands (N, 14) [rad]; an episode without a solution holds its last command."""
        p = obs.proprioception
        if not self._fresh:
            self._joints.update(p.joint_pos, p.joint_vel)
            self._gravity.update(p.gravity_b, p.base_ang_vel_b)
        self._fresh = False
        q = np.tile(self._robot.default_q, (len(obs.active), 1))
        infeasible = np.zeros(len(obs.active), dtype=bool)
        for i in np.flatnonzero(obs.active):
            episode = self._episodes[i]
            found = self._step(
                episode,
                p.joint_pos[i],
                -self._gravity.gravity[i],
                p.base_ang_vel_b[i],
                (target.pos_b[i], target.rot_b[i]),
            )
            infeasible[i] = not found
            q[i] = episode.command
        return JointCommand(q, infeasible)

    def _step(self, e: _Episode, joints: Array, up_b: Array, ang_vel_b: Array, target_b: Pose) -> bool:
        s, model = self._s, self._model
        soles_b = model.soles_in_base(joints)
        pos, rot = base_from_stance(soles_b, up_b, e.stance)
        measured = configuration(pos, rot, joints)
        stance = measured_stance([(pos + rot @ p, rot @ r) for p, r in soles_b])
        e.stance = e.stance.toward(stance, PERIOD / s.stance_filter)
        if e.step % 10 == 0:
            e.hull = e.stance.hull(model.corners)
        model.update(measured)
        target = (pos + rot @ target_b[0], rot @ target_b[1])
        self._slew(e, target, model.pose(model.tcp))

        reference = (e.ee[0] + e.correction_pos, e.ee[1] @ pin.exp3(e.correction_rot))
        posture = self._posture(e)
        # the measured stance may be far from the reference at first: the first step must be free to jump there
        q = self._solver.step(e.q, reference, e.stance.poses(), e.hull, posture, limit_speed=e.step > 1)
        if q is None:
            return False
        e.q = q
        e.command = q[7:].copy()
        if s.feedforward:
            torques = self._balance(e, measured, rot, ang_vel_b)
            e.command += np.clip(torques, -self._robot.effort, self._robot.effort) / self._robot.kp
            e.command[:8] += s.compliance * (self._joints.pos[e.row] - q[7:])[:8]
        return True

    def _slew(self, e: _Episode, target: Pose, ee: Pose) -> None:
        """Move the reference pose of the hand smoothly towards the filtered target."""
        s = self._s
        keep = PERIOD / s.target_filter
        e.target = (e.target[0] + keep * (target[0] - e.target[0]), turn(e.target[1], target[1], keep))
        e.step += 1
        if e.step * PERIOD <= s.settle:
            return
        if e.goal is None:
            e.start, e.goal = e.q[7:].copy(), self.plan(e)
        way, turning = e.target[0] - e.ee[0], pin.log3(e.ee[1].T @ e.target[1])
        left = max(_norm(way) / s.slew_linear, _norm(turning) / s.slew_angular)  # [s] at full speed
        e.way, e.left = max(e.way, left), left
        e.speed = min(1.0, e.speed + PERIOD / s.slew_ramp, s.slew_gain * left)
        part = min(1.0, e.speed * PERIOD / max(left, 1e-9))
        e.ee = (e.ee[0] + part * way, e.ee[1] @ pin.exp3(part * turning))
        if left < 0.5:
            gain, limit = PERIOD * s.ee_integral, s.ee_integral_limit
            e.correction_pos = np.clip(e.correction_pos + gain * (target[0] - ee[0]), -limit, limit)
            e.correction_rot = np.clip(e.correction_rot + gain * pin.log3(ee[1].T @ target[1]), -limit, limit)

    def _posture(self, e: _Episode) -> Array:
        """Joint positions (14,) preferred now: on the straight line from the start to the planned goal."""
        if e.goal is None:
            return self._robot.default_q
        return e.goal + (e.left / max(e.way, 1e-9)) * (e.start - e.goal)

    def plan(self, e: _Episode) -> Array:
        """Joint positions (14,) at the target: the first of several starts that gets there, or the best."""
        best, best_error = e.q, np.inf
        soles = e.stance.poses()
        turning = pin.log3(e.ee[1].T @ e.target[1])
        for seed in self._seeds():
            q = e.q
            for k in range(60):
                part = min(1.0, (k + 1) / 35)
                ee = (e.ee[0] + part * (e.target[0] - e.ee[0]), e.ee[1] @ pin.exp3(part * turning))
                step = self._solver.step(q, ee, soles, e.hull, seed, limit_speed=False)
                if step is None:
                    break
                q = step
            pos, rot = self._model.ee_of(q)
            error = _norm(pos - e.target[0]) + 0.3 * _norm(pin.log3(rot.T @ e.target[1]))
            if error < best_error:
                best, best_error = q, error
            if error < 0.01:
                break
        self.plan_error = best_error
        return best[7:]

    def _seeds(self) -> list[Array]:
        """Postures to start from: standing, squatting, upright, leaning, arm folded, arm to either side."""
        seeds = [self._robot.default_q]
        for hip, knee, j1, j2, j3 in (
            (0.6, 0.9, 0.0, 1.5, 1.5),
            (0.0, 0.0, 0.0, 1.5, 1.5),
            (-0.3, -0.5, 0.0, 1.2, 0.6),
            (0.9, 1.1, 0.0, 2.5, 0.8),
            (0.0, 0.0, 1.0, 1.5, 1.5),
            (0.0, 0.0, -1.0, 1.5, 1.5),
        ):
            q = self._robot.default_q.copy()
            # the hips turn about opposite axes, the ankles about the same
            q[[1, 2, 3, 5, 6, 7]] = hip, knee, knee - hip, -hip, -knee, knee - hip
            q[8:11] = j1, j2, j3
            seeds.append(q)
        return seeds

    def _balance(self, e: _Episode, measured: Array, rot: Array, ang_vel_b: Array) -> Array:
        """Torques (14,) [N m] that carry the weight and bring centre of mass and base to the reference."""
        s, model = self._s, self._model
        e.com.update(model.data.com[0], e.acceleration)
        soles = [model.pose(sole) for sole in model.soles]
        jacobians = [model.jacobian(sole) for sole in model.soles]
        torques = model.gravity_torques(measured)
        wrench = np.zeros(6)
        wrench[2] = model.mass * GRAVITY
        if s.feedback:
            error = model.com_of(e.q) - e.com.pos
            gains = np.array([1.0, 1.0, s.height_gain])
            wrench[:3] += model.mass * gains * (s.kp_com * error - s.kd_com * e.com.vel)
            wrench[:3] -= model.mass * s.rejection * e.com.disturbance
            rot_ref = pin.Quaternion(e.q[3:7]).toRotationMatrix()
            error = rot @ pin.log3(rot.T @ rot_ref)
            limit = s.rot_integral_limit
            e.rot_integral = np.clip(e.rot_integral + PERIOD * s.ki_rot * error, -limit, limit)
            wrench[3:] = s.inertia * (s.kp_rot * error - s.kd_rot * (rot @ ang_vel_b) + e.rot_integral)
        arms = [self._contacts @ r.T for _, r in soles]
        points = np.concatenate([p + arm for (p, _), arm in zip(soles, arms, strict=True)]) - e.com.pos
        forces = distribute(points, self._rays, wrench, self._weight, s.damping)
        e.acceleration = forces.sum(axis=0) / model.mass - np.array([0.0, 0.0, GRAVITY])
        for jacobian, arm, force in zip(jacobians, arms, np.split(forces, 2), strict=True):
            moment = np.array(
                [
                    (arm[:, 1] * force[:, 2] - arm[:, 2] * force[:, 1]).sum(),
                    (arm[:, 2] * force[:, 0] - arm[:, 0] * force[:, 2]).sum(),
                    (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]).sum(),
                ]
            )
            torques -= jacobian.T @ np.concatenate([force.sum(axis=0), moment])
        return torques[6:]


def _norm(vector: Array) -> float:
    return float(np.sqrt(vector @ vector))
