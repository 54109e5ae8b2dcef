"""The floating-base IK controller: slewed target, whole-body IK, gravity feed-forward, balance feedback."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.robot import Robot
from wbc_bench.rotations import matrix_from_rotvec, rotvec_from_matrix, wxyz_from_matrix, xyzw_from_wxyz

from wbc_baselines.ik.balance import distribute, friction_rays
from wbc_baselines.ik.estimation import ComFilter, GravityFilter, JointFilter
from wbc_baselines.ik.model import GRAVITY, WholeBodyModel
from wbc_baselines.ik.placo_ik import PlacoIK

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weights:
    """Of the IK program."""

    ee_position: float = 1.0
    ee_orientation: float = 0.3
    com: float = 0.03
    polygon: float = 1e3
    posture: float = 1e-3
    foot_flat: float = 1e-1
    regularization: float = 1e-5
    joint_margin: float = 0.02
    speed_fraction: float = 0.5


@dataclass(frozen=True)
class Settings:
    weights: Weights = Weights()
    slew_linear: float = 0.2  # [m/s]
    slew_angular: float = 0.6  # [rad/s]
    slew_gain: float = 2.0  # [1/s]
    slew_accel: float = 1.0  # [s] to ramp up
    settle: float = 0.3  # [s] before the target moves
    target_filter: float = 0.3  # [s]
    stance_filter: float = 0.5
    com_margin: float = 0.03
    kp_com: float = 15.0
    kd_com: float = 7.5
    kp_rot: float = 60.0
    kd_rot: float = 8.0
    inertia: float = 1.5
    w_moment: float = 1.0
    friction: float = 0.4
    ee_integral: float = 0.3
    feedforward: bool = True
    feedback: bool = True
    joint_acc: float = 10.0
    com_noise: float = 0.005
    com_acc: float = 1.0


class Episode:
    """State of one episode."""

    __slots__ = ("com", "acc", "stance", "q", "ee", "speed", "target", "goal", "integral", "command", "step", "first")


class IKController:
    def __init__(self, robot: Robot, settings: Settings = Settings(), name="ik") -> None:
        self.info = ControllerInfo(name, frozenset({"proprioception"}), 0.02, "wbc_baselines.ik")
        self._robot, self._s = robot, settings
        self._period = 0.02
        self._body = WholeBodyModel(robot)
        self._ik = PlacoIK(robot, settings.weights, self._period)
        s = settings
        self._joints = JointFilter(self._period, 0.01, 1.5, s.joint_acc)
        self._gravity = GravityFilter(self._period, 0.05, 0.2)
        self._rays = friction_rays(s.friction)
        self._corners = self._body.corners * np.array([0.85, 0.7, 1])

    # ------------------------------------------------------------------
    def reset(self, episodes, obs: Observation, target: Target) -> None:
        p = obs.proprioception
        self._joints.reset(p.joint_pos)
        self._gravity.reset(p.gravity_b)
        self._episodes = [self._start(i, obs, target) for i in range(len(episodes))]
        self._fresh = True

    def _base_in_anchor(self, i: int, feet_a) -> tuple[Array, Array]:
        """Base pose in the anchor frame from gravity, joints and the feet's places; updates the body model."""
        up_b = -self._gravity.gravity[i]
        q = np.zeros(21)
        q[6] = 1
        q[7:] = self._joints.pos[i]
        body = self._body
        body.update(q)
        soles = [body.pose(f) for f in body.soles]
        # roll and pitch from gravity, yaw from the feet's headings and the line between them
        line = soles[0][0] - soles[1][0]
        line -= up_b * (up_b @ line)
        y = line / np.linalg.norm(line)
        x = np.cross(y, up_b)
        rot_bl = np.stack([x, y, up_b], axis=1)  # frame of the line in base
        if feet_a is None:
            rot = rot_bl.T
            pos = -np.mean([rot @ s[0] for s in soles], axis=0)
            # x along the mean heading
            heading = rot @ (soles[0][1][:, 0] + soles[1][1][:, 0])
            psi = np.arctan2(heading[1], heading[0])
            c, sn = np.cos(-psi), np.sin(-psi)
            rz = np.array([[c, -sn, 0], [sn, c, 0], [0, 0, 1.0]])
            return rz @ pos, rz @ rot
        d = feet_a[0][0] - feet_a[1][0]
        psi = np.arctan2(-d[0], d[1])
        c, sn = np.cos(psi), np.sin(psi)
        rz = np.array([[c, -sn, 0], [sn, c, 0], [0, 0, 1.0]])
        rot = rz @ rot_bl.T
        pos = np.mean([feet_a[k][0] - rot @ soles[k][0] for k in range(2)], axis=0)
        return pos, rot

    def _flat_feet(self, pos, rot):
        feet = []
        for f in self._body.soles:
            p, r = self._body.pose(f)
            p, r = pos + rot @ p, rot @ r
            psi = np.arctan2(r[1, 0], r[0, 0])
            c, s = np.cos(psi), np.sin(psi)
            feet.append((np.array([p[0], p[1], 0.0]), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])))
        return feet

    def _start(self, i, obs, target) -> Episode:
        e = Episode()
        pos, rot = self._base_in_anchor(i, None)
        e.stance = self._flat_feet(pos, rot)
        q = np.concatenate([pos, xyzw_from_wxyz(wxyz_from_matrix(rot)), self._joints.pos[i]])
        e.q = q
        self._body.update(q)
        e.com = ComFilter(self._period, self._s.com_noise, self._s.com_acc)
        e.com.reset(self._body.data.com[0][:2])
        e.acc = np.zeros(2)
        e.ee = self._body.pose(self._body.tcp)
        e.target = (pos + rot @ target.pos_b[i], rot @ target.rot_b[i])
        e.speed = 0.0
        e.goal = None
        e.integral = np.zeros(6)
        e.command = self._joints.pos[i].copy()
        e.step = 0
        e.first = True
        return e

    # ------------------------------------------------------------------
    def act(self, obs: Observation, target: Target) -> JointCommand:
        p = obs.proprioception
        if not self._fresh:
            self._joints.update(p.joint_pos, p.joint_vel)
            self._gravity.update(p.gravity_b, p.base_ang_vel_b)
        self._fresh = False
        q = np.tile(self._robot.default_q, (len(obs.active), 1))
        infeasible = np.zeros(len(obs.active), bool)
        for i in np.flatnonzero(obs.active):
            q[i], infeasible[i] = self._act_one(i, self._episodes[i], p, target)
        return JointCommand(q, infeasible)

    def _polygon(self, feet):
        from scipy.spatial import ConvexHull

        m = self._s.com_margin
        pts = np.concatenate([f[0] + self._body.corners @ f[1].T for f in feet])[:, :2]
        hull = ConvexHull(pts)
        v = pts[hull.vertices]
        c = v.mean(axis=0)
        return v, c

    def _solve(self, e, ee, posture, limit=True, q=None):
        poly, centre = self._poly
        s = self._s
        # shrink
        shr = [p for p in poly]
        self._ik._polygon.margin = s.com_margin
        return self._ik.step(e.q if q is None else q, ee, e.stance, shr, np.array([*centre, 0.6]), posture, limit)

    def _plan(self, e) -> Array:
        """Joint configuration at the target: the best of several starts."""
        best = None
        default = self._robot.default_q
        for seed in self._seeds():
            q = e.q.copy()
            start = e.ee
            dp = e.target[0] - start[0]
            dr = rotvec_from_matrix(start[1].T @ e.target[1])
            for k in range(60):
                f = min(1.0, (k + 1) / 35)
                ee = (start[0] + f * dp, start[1] @ matrix_from_rotvec(f * dr))
                nq = self._solve(e, ee, seed, False, q)
                if nq is None:
                    break
                q = nq
            self._body.update(q)
            pos, rot = self._body.pose(self._body.tcp)
            err = np.linalg.norm(pos - e.target[0]) + 0.3 * np.linalg.norm(rotvec_from_matrix(rot.T @ e.target[1]))
            if best is None or err < best[0]:
                best = (err, q)
            if err < 0.01:
                break
        self.plan_error = best[0]
        return best[1][7:]

    def _seeds(self):
        d = self._robot.default_q
        out = [d]
        for legs, arm in (
            ((0.6, 0.9), (0, 1.5, 1.5)),
            ((0.0, 0.0), (0, 1.5, 1.5)),
            ((-0.3, -0.5), (0, 1.2, 0.6)),
            ((0.9, 1.1), (0, 2.5, 0.8)),
            ((0.0, 0.0), (1.0, 1.5, 1.5)),
            ((0.0, 0.0), (-1.0, 1.5, 1.5)),
        ):
            s = d.copy()
            s[1], s[2], s[3] = legs[0], legs[1], legs[1] - legs[0]
            s[5], s[6], s[7] = -legs[0], -legs[1], legs[1] - legs[0]
            s[8:11] = arm
            out.append(s)
        return out

    def _act_one(self, i, e: Episode, p, target):
        s, body, dt = self._s, self._body, self._period
        pos, rot = self._base_in_anchor(i, e.stance)
        if True:
            # follow the feet slowly
            k = dt / s.stance_filter
            feet = self._flat_feet(pos, rot)
            e.stance = [
                (f0[0] + k * (f1[0] - f0[0]), f0[1] @ matrix_from_rotvec(k * rotvec_from_matrix(f0[1].T @ f1[1])))
                for f0, f1 in zip(e.stance, feet, strict=True)
            ]
        self._poly = self._polygon(e.stance)
        # estimated state
        qm = np.concatenate([pos, xyzw_from_wxyz(wxyz_from_matrix(rot)), self._joints.pos[i]])
        body.update(qm)
        com = body.data.com[0].copy()
        e.com.update(com[:2], e.acc)
        ee_pos, ee_rot = body.pose(body.tcp)
        t_pos, t_rot = pos + rot @ target.pos_b[i], rot @ target.rot_b[i]
        k = min(1.0, dt / s.target_filter) if e.step else 1.0
        e.target = (
            e.target[0] + k * (t_pos - e.target[0]),
            e.target[1] @ matrix_from_rotvec(k * rotvec_from_matrix(e.target[1].T @ t_rot)),
        )
        points, jac = [], []
        for f in body.soles:
            fp, fr = body.pose(f)
            points.append(fp + self._corners @ fr.T)
            jac.append(body.jacobian(f))
        gravity = pin.computeGeneralizedGravity(body.model, body.data, qm)
        sole_pos = [body.pose(f)[0] for f in body.soles]

        # reference
        e.step += 1
        if e.step * dt > s.settle:
            if e.goal is None:
                e.goal = self._plan(e)
            dp = e.target[0] - e.ee[0]
            dr = rotvec_from_matrix(e.ee[1].T @ e.target[1])
            dist = max(np.linalg.norm(dp) / s.slew_linear, np.linalg.norm(dr) / s.slew_angular)  # [s] to go
            e.speed = min(1.0, e.speed + dt / s.slew_accel, s.slew_gain * dist)
            f = min(1.0, e.speed * dt / max(dist, 1e-9))
            e.ee = (e.ee[0] + f * dp, e.ee[1] @ matrix_from_rotvec(f * dr))
            if dist < 0.5:
                # integrate the measured error of the hand
                e.integral[:3] += dt * s.ee_integral * (t_pos - ee_pos)
                e.integral[3:] += dt * s.ee_integral * rotvec_from_matrix(ee_rot.T @ t_rot)
                e.integral = np.clip(e.integral, -0.08, 0.08)
        ref = (e.ee[0] + e.integral[:3], e.ee[1] @ matrix_from_rotvec(e.integral[3:]))
        posture = self._robot.default_q if e.goal is None else e.goal
        q = self._solve(e, ref, posture, limit=not e.first)
        e.first = False
        failed = q is None
        if not failed:
            e.q = q
        command = e.q[7:].copy()
        if s.feedforward:
            body.update(e.q)
            com_ref = body.data.com[0][:2].copy()
            force = np.array([0, 0, body.mass * GRAVITY])
            wrench = np.zeros(6)
            wrench[:3] = force
            if s.feedback:
                a = s.kp_com * (com_ref - e.com.pos) - s.kd_com * e.com.vel
                wrench[:2] = body.mass * a
                rot_ref = pin.Quaternion(e.q[3:7]).matrix()
                err = rot @ rotvec_from_matrix(rot.T @ rot_ref)
                wrench[3:] = s.inertia * (s.kp_rot * err - s.kd_rot * (rot @ p.base_ang_vel_b[i]))
                wrench[5] *= 0.2
            com[:2] = e.com.pos
            weight = np.array([1, 1, 1, s.w_moment, s.w_moment, 0.2])
            forces = distribute(np.concatenate(points), com, wrench, self._rays, weight, 0.02)
            e.acc = forces.sum(axis=0)[:2] / body.mass
            tau = gravity.copy()
            for k in range(2):
                f = forces[4 * k : 4 * k + 4]
                moment = np.cross(points[k] - sole_pos[k], f).sum(axis=0)
                tau -= jac[k].T @ np.concatenate([f.sum(axis=0), moment])
            command = command + np.clip(tau[6:], -self._robot.effort, self._robot.effort) / self._robot.kp
        if failed:
            command = e.command
        e.command = command
        return command, failed
