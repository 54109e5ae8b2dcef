"""Static whole-body configurations: which end-effector poses the robot can hold with its soles in place.

The kinematics is solved in closed form. The legs have no ankle roll, so with both soles flat, parallel and
the default stance width apart, roll and yaw of the base and the abduction joints are zero (a base roll r
would bring the soles nearer by the factor cos r). What remains of base and legs is planar: x, height and
pitch of the base. Given these three, each leg is a two-link arm with two knee branches, and the arm (J2, J3,
J4 parallel, J5 and J6 meeting in a point) has four branches. So one end-effector pose leaves a family of
configurations of three dimensions, and that family is searched over a grid of base poses: no starting
values, no local minima.

Everything here lives in the ground frame: on the ground, below the default base, x forward (`ground_frame`).
"""

from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.ground_frame import GroundFrame, to_ground_frame
from wbc_bench.episodes.planar import turn, two_link, wrap
from wbc_bench.robot import NUM_LEG_JOINTS, Robot, RobotConfig, load_robot, mount_of, tcp_of
from wbc_bench.rotations import matrix_from_rpy, matrix_from_wxyz, wxyz_from_matrix

Array = NDArray[np.float64]

JOINT_MARGIN = 0.02  # [rad] to every joint limit; choice: twice the noise of a joint sensor
FAR = 1e3  # [m] or [rad]; choice: beyond it no configuration of the robot is meant
EFFORT_SHARE = 0.9  # of the joint efforts; choice: a tenth is left for feedback
CLEARANCE = 0.01  # [m] of everything but the soles above the ground
TILT_SHARE = 0.9  # of the tilt at which an episode ends
HEIGHT_MARGIN = 0.05  # [m] of the base above the height at which an episode ends

# Grid of base poses. Choice, measured: of 400 poses drawn over the box of ablation_v1 it reaches 82; a grid
# of half the steps reaches 83, one of twice the steps 76.
STEP_X = 0.02  # [m]
STEP_Z = 0.02  # [m]
STEP_PITCH = 0.08  # [rad]
SPAN_X = (-0.30, 0.40)  # [m] wider than the centre of mass over the soles allows
PITCH_LIMIT = 1.2  # [rad]


class Witness(NamedTuple):
    """A feasible configuration of an end-effector pose."""

    qpos: Array  # (21,) base position [m], wxyz, joints [rad]
    margin: (
        float  # smallest normalised distance to a joint limit, a straight elbow or knee, or the soles' edge
    )


class _Bodies(NamedTuple):
    """Base and leg configurations of the grid that respect the limits, C of them."""

    base: Array  # (C, 3) x [m], z [m], pitch [rad]
    leg_q: Array  # (C, 8) [rad]
    first_moment: Array  # (C, 3) mass times centre of mass of everything but the moving arm [kg m]
    margin: Array  # (C,)


class StaticSolver:
    """Finds static configurations of one robot; see the module's docstring."""

    def __init__(self, robot: Robot, com_margin: float, tilt: float, base_height: float) -> None:
        """`com_margin` [m] inside the soles; `tilt` [rad] and `base_height` [m] at which an episode ends."""
        self.robot, self.com_margin = robot, com_margin
        self.max_tilt, self.min_height = min(TILT_SHARE * tilt, np.pi), base_height + HEIGHT_MARGIN
        self.model = robot.model()
        ground = self.model.geom("ground").id
        self.model.geom_margin[ground] = CLEARANCE  # contacts this far away are reported
        self.data = mujoco.MjData(self.model)
        self._read_geometry()
        self._default = self._bodies_at(np.array([[0.0, self.default_height, 0.0]]), only_default=True)
        self._grid = self._bodies_at(self._base_grid())

    # ---- geometry ------------------------------------------------------------------------------------------

    def _read_geometry(self) -> None:
        facts, config = self.robot.facts, self.robot.config
        joint = {j.name: j for j in facts.joints}
        xyz = {name: np.array(j.xyz) for name, j in joint.items()}
        self._hip = (xyz["abad_L_Joint"] + xyz["hip_L_Joint"])[[0, 2]]
        self._thigh, self._shank = xyz["knee_L_Joint"][[0, 2]], xyz["ankle_L_Joint"][[0, 2]]
        # signs from pitch angles of the links to joint angles: +1 turns about +y
        self._leg_sign = np.array(
            [joint[f"{part}_{s}_Joint"].axis[1] for s in "LR" for part in _PITCH_JOINTS]
        )
        foot = facts.foot
        self.default_height = -(
            self._hip[1] + self._thigh[1] + self._shank[1] + foot.z
        )  # [m] soles on the ground
        self._ankle = np.array(
            [self._hip[0] + self._thigh[0] + self._shank[0], -foot.z]
        )  # in the ground frame
        half_width = xyz["abad_L_Joint"][1] + xyz["hip_L_Joint"][1] + xyz["knee_L_Joint"][1] + foot.y[1]
        # the flat soles side by side: their hull is a rectangle
        self.hull_low = np.array([self._ankle[0] + foot.x[0], -half_width])  # (2,) [m]
        self.hull_high = np.array([self._ankle[0] + foot.x[1], half_width])

        mount, frame = np.array(mount_of(facts, config).xyz), tcp_of(facts, config)
        tcp, self._tcp_rot = np.array(frame.xyz), matrix_from_rpy(np.array(frame.rpy))
        self._arm_root = mount + xyz["J1"]
        self._shoulder, self._upper = xyz["J2"][[0, 2]], xyz["J3"][[0, 2]]
        self._forearm = xyz["J4"][[0, 2]]
        # where the axes of J5 and J6 meet, from J4; J4 turns about y, so its own offset along y adds to it
        self._wrist = xyz["J5"] + [0.0, xyz["J4"][1], xyz["J6"][2]]
        self._wrist_to_tcp = tcp + np.array([xyz["J6"][0], 0.0, 0.0])
        links = {link.name: link for link in facts.links}
        self._arm = [
            (np.array(j.xyz), np.array(j.axis), links[j.child].mass, np.array(links[j.child].com))
            for j in facts.joints[NUM_LEG_JOINTS:]
        ]
        self._arm_mass = sum(mass for _, _, mass, _ in self._arm)
        self._mass = float(self.model.body_subtreemass[0])
        self._reach = np.hypot(*self._upper) + np.hypot(*self._forearm) + self._wrist[0] + self._shoulder[0]

    def _base_grid(self) -> Array:
        """(G, 3) x, z, pitch of the base, the default one among them."""
        x = STEP_X * np.arange(np.ceil(SPAN_X[0] / STEP_X), np.floor(SPAN_X[1] / STEP_X) + 1)
        top = np.hypot(*self._thigh) + np.hypot(*self._shank) + np.hypot(*self._hip) + self._ankle[1]  # [m]
        down = np.floor((self.default_height - self.min_height) / STEP_Z)
        z = self.default_height + STEP_Z * np.arange(
            -down, np.floor((top - self.default_height) / STEP_Z) + 1
        )
        limit = np.floor(min(PITCH_LIMIT, self.max_tilt) / STEP_PITCH)
        pitch = STEP_PITCH * np.arange(-limit, limit + 1)
        return np.stack(np.meshgrid(x, z, pitch, indexing="ij"), axis=-1).reshape(-1, 3)

    def _bodies_at(self, base: Array, only_default: bool = False) -> _Bodies:
        """The leg configurations, either knee branch, of base poses (G, 3) that are within limits."""
        pitch = base[:, 2]
        hip = base[:, :2] + turn(pitch, self._hip)
        a, b, bend = two_link(self._thigh, self._shank, self._ankle - hip)  # (2, G)
        turns = np.stack([a - pitch, b - a, -b], axis=-1)  # (2, G, 3) of hip, knee, ankle about +y
        leg_q = np.zeros((2, len(base), NUM_LEG_JOINTS))
        leg_q[..., _PITCH_COLUMNS] = wrap(np.concatenate([turns, turns], axis=-1) * self._leg_sign)
        margin = self._joint_margin(leg_q[..., _PITCH_COLUMNS], _PITCH_COLUMNS)
        knee = _KNEE_COLUMNS[0]
        half_range = (self.robot.upper[knee] - self.robot.lower[knee]) / 2
        margin = np.minimum(margin, np.abs(bend) / half_range)
        allowed = self._within_limits(leg_q, slice(0, NUM_LEG_JOINTS))
        if only_default:
            allowed &= np.abs(leg_q - self.robot.default_q[:NUM_LEG_JOINTS]).max(-1) < 1e-6
        branch, cell = np.nonzero(allowed)
        base, leg_q, margin = base[cell], leg_q[branch, cell], margin[branch, cell]

        first_moment = np.empty((len(base), 3))
        fixed = np.array(
            [
                name not in {j.child for j in self.robot.facts.joints[NUM_LEG_JOINTS:]}
                for name in _bodies(self.model)
            ]
        )
        for i in range(len(base)):
            self._kinematics(_qpos(base[i], leg_q[i], self.robot.default_q[NUM_LEG_JOINTS:]))
            first_moment[i] = (self.model.body_mass * fixed) @ self.data.xipos
        # the arm can move the centre of mass no further than this
        slack = self._arm_mass * (self._reach + np.hypot(*self._arm_root[[0, 2]])) / self._mass  # [m]
        com_x = first_moment[:, 0] / self._mass
        keep = (com_x > self.hull_low[0] - slack) & (com_x < self.hull_high[0] + slack)
        return _Bodies(base[keep], leg_q[keep], first_moment[keep], margin[keep])

    # ---- closed-form arm -----------------------------------------------------------------------------------

    def arm_branches(self, pos_b: Array, rot_b: Array) -> tuple[Array, Array]:
        """All arm configurations of end-effector poses (N, 3), (N, 3, 3) in the base frame.

        Returns:
            J1..J6 (4, N, 6) [rad], NaN where there is none, and the elbow's bend (4, N) [rad].
        """
        rot_b = rot_b @ self._tcp_rot.T  # of the last link
        wrist = pos_b - rot_b @ self._wrist_to_tcp - self._arm_root
        radius = np.hypot(wrist[:, 0], wrist[:, 1])
        # the wrist stays at a fixed lateral offset from the plane of the arm
        sine = self._wrist[1] / np.maximum(radius, 1e-9)
        off = np.arcsin(np.where(np.abs(sine) <= 1, sine, np.nan))
        bearing = np.arctan2(wrist[:, 1], wrist[:, 0])
        j1 = np.stack([bearing - off, bearing - np.pi + off])  # (2, N) wrist before or behind the axis of J1
        cos, sin = np.cos(j1), np.sin(j1)
        # the rows of Rz(-j1) rot_b that are needed: Ry(phi) Rz(-j5) Rx(j6), phi = j2 - j3 - j4
        r00 = cos * rot_b[:, 0, 0] + sin * rot_b[:, 1, 0]
        r1 = cos[..., None] * rot_b[:, 1] - sin[..., None] * rot_b[:, 0]  # (2, N, 3)
        j5 = -np.arcsin(np.clip(r1[..., 0], -1, 1))
        j6 = np.arctan2(-r1[..., 2], r1[..., 1])
        phi = np.arctan2(-np.broadcast_to(rot_b[:, 2, 0], r00.shape), r00)
        plane = np.stack(
            [cos * wrist[:, 0] + sin * wrist[:, 1], np.broadcast_to(wrist[:, 2], cos.shape)], axis=-1
        )
        elbow_goal = plane - self._shoulder - turn(phi, self._wrist[[0, 2]])
        a, b, bend = two_link(self._upper, self._forearm, elbow_goal)  # (2, 2, N)
        q = np.stack([np.broadcast_to(v, a.shape) for v in (j1, a, a - b, b - phi, j5, j6)], axis=-1)
        lower = self.robot.lower[NUM_LEG_JOINTS:]
        q = lower + (q - lower) % (2 * np.pi)  # ranges reach beyond pi
        return q.reshape(4, len(pos_b), 6), bend.reshape(4, len(pos_b))

    def arm_first_moment(self, q: Array) -> Array:
        """Mass times centre of mass (N, 3) [kg m] of the moving arm in the base frame, at J1..J6 (N, 6)."""
        origin = self._arm_root - self._arm[0][0]
        pos, rot = np.broadcast_to(origin, (len(q), 3)), np.broadcast_to(np.eye(3), (len(q), 3, 3))
        total = np.zeros((len(q), 3))
        for i, (xyz, axis, mass, com) in enumerate(self._arm):
            pos = pos + rot @ xyz
            rot = rot @ matrix_from_rpy(q[:, i, None] * axis)  # axes are coordinate axes
            total += mass * (pos + rot @ com)
        return total

    # ---- search --------------------------------------------------------------------------------------------

    def solve_arm(self, pos: Array, rot: Array) -> Witness | None:
        """A configuration with base and legs at the default posture of a pose in the ground frame."""
        return self._best(self._default, pos, rot)

    def solve_posture(self, pos: Array, rot: Array) -> Witness | None:
        """A configuration with the feet in place: of the feasible ones on the grid, the largest margin."""
        return self._best(self._grid, pos, rot)

    def _best(self, bodies: _Bodies, pos: Array, rot: Array) -> Witness | None:
        x, z, pitch = bodies.base.T
        wrist = pos - rot @ self._tcp_rot.T @ self._wrist_to_tcp
        root_x, root_z = np.moveaxis(turn(pitch, self._arm_root[[0, 2]] + [0.0, self._shoulder[1]]), -1, 0)
        apart = (wrist[0] - x - root_x) ** 2 + wrist[1] ** 2 + (wrist[2] - z - root_z) ** 2
        near = np.flatnonzero(apart <= self._reach**2)
        if len(near) == 0:
            return None
        x, z, pitch = x[near], z[near], pitch[near]
        level = matrix_from_rpy(np.stack([np.zeros_like(pitch), -pitch, np.zeros_like(pitch)], axis=-1))
        moved = np.stack([pos[0] - x, np.full_like(x, pos[1]), pos[2] - z], axis=-1)
        q, bend = self.arm_branches((level @ moved[..., None])[..., 0], level @ rot)
        branch, row = np.nonzero(self._within_limits(q, slice(NUM_LEG_JOINTS, None)))
        if len(row) == 0:
            return None
        q, bend, cell = q[branch, row], bend[branch, row], near[row]

        elbow = NUM_LEG_JOINTS + 2
        half_range = (self.robot.upper[elbow] - self.robot.lower[elbow]) / 2
        margin = np.minimum(self._joint_margin(q, slice(NUM_LEG_JOINTS, None)), np.abs(bend) / half_range)
        moment = np.einsum(
            "nji,nj->ni", level[row], self.arm_first_moment(q)
        )  # arm about the base, world axes
        moment += self._arm_mass * np.stack([x[row], np.zeros(len(row)), z[row]], axis=-1)
        com = (bodies.first_moment[cell] + moment)[:, :2] / self._mass
        inside = self.com_inside(com)
        margin = np.minimum(margin, inside / ((self.hull_high - self.hull_low) / 2).min())
        margin = np.minimum(margin, bodies.margin[cell])
        stable = np.flatnonzero(inside >= self.com_margin)
        # rounded, so that the last bit of another processor does not choose between equals
        for i in stable[np.argsort(-np.round(margin[stable], 9), kind="stable")]:
            qpos = _qpos(bodies.base[cell[i]], bodies.leg_q[cell[i]], q[i])
            if self.is_clear(qpos) and self._effort_used(qpos) <= EFFORT_SHARE:
                return Witness(qpos, float(margin[i]))
        return None

    # ---- constraints ---------------------------------------------------------------------------------------

    def _within_limits(self, q: Array, joints: slice) -> NDArray[np.bool_]:
        lower, upper = self.robot.lower[joints] + JOINT_MARGIN, self.robot.upper[joints] - JOINT_MARGIN
        return np.asarray(((q >= lower) & (q <= upper)).all(-1))

    def _joint_margin(self, q: Array, joints: slice | list[int]) -> Array:
        """Smallest distance to a limit in units of half the joint's range."""
        lower, upper = self.robot.lower[joints], self.robot.upper[joints]
        return (np.minimum(q - lower, upper - q) / ((upper - lower) / 2)).min(-1)

    def com_inside(self, com: Array) -> Array:
        """Distance (...,) [m] of ground points (..., 2) inside the hull of the soles; negative outside."""
        return np.minimum(com - self.hull_low, self.hull_high - com).min(-1)

    def _kinematics(self, qpos: Array) -> None:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def ee_pose(self, qpos: Array) -> tuple[Array, Array]:
        """End-effector pose (3,), (3, 3) in the world of a configuration (21,), by MuJoCo."""
        self._kinematics(qpos)
        site = self.model.site("tcp").id
        return self.data.site_xpos[site].copy(), self.data.site_xmat[site].reshape(3, 3).copy()

    def is_clear(self, qpos: Array) -> bool:
        """No part touches another, and nothing but the soles is near the ground."""
        self._kinematics(qpos)
        mujoco.mj_collision(self.model, self.data)
        contact = self.data.contact
        ground = self.model.geom("ground").id
        sole = self.model.geom_conaffinity == 1  # the ground itself and the spheres under the soles
        touches_ground = (contact.geom == ground).any(axis=1)
        return not bool((~touches_ground | ~sole[contact.geom].all(axis=1)).any())

    def static_forces(self, qpos: Array) -> tuple[Array, Array, float]:
        """What holds a configuration up without motion.

        Vertical forces at the corners of the soles, of least norm among the non-negative ones that carry the
        weight; the joint torques are what gravity and these forces leave over (Newton-Euler at rest).

        Returns:
            forces (8,) [N], joint torques (14,) [N m], and the part of the weight that no forces can balance.
        """
        model, data = self.model, self.data
        self._kinematics(qpos)
        data.qvel[:] = 0
        gravity = np.empty(model.nv)
        mujoco.mj_rne(model, data, 0, gravity)
        jacobian, lift = np.empty((3, model.nv)), []
        for geom in self._corners():
            point = data.geom_xpos[geom] - [0.0, 0.0, model.geom_size[geom, 0]]
            mujoco.mj_jac(model, data, jacobian, None, point, model.geom_bodyid[geom])
            lift.append(jacobian[2].copy())
        lift = np.array(lift)  # (8, 20)
        from scipy.optimize import nnls  # here: an evaluation reads frozen targets and solves none

        weight = np.linalg.norm(gravity[:3])
        small = 1e-4  # Tikhonov weight: picks the least norm, costs 1e-8 of the balance
        system = np.vstack([lift[:, :6].T, small * np.eye(len(lift))])
        forces, _ = nnls(system, np.concatenate([gravity[:6], np.zeros(len(lift))]))
        residual = gravity - lift.T @ forces
        return forces, residual[6:], float(np.linalg.norm(residual[:6]) / weight)

    def _corners(self) -> list[int]:
        return [self.model.geom(f"foot_{side}_{k}").id for side in "LR" for k in range(4)]

    def _effort_used(self, qpos: Array) -> float:
        """Largest share of a joint's effort; infinite if the soles cannot carry the weight."""
        _, torque, unbalanced = self.static_forces(qpos)
        return float((np.abs(torque) / self.robot.effort).max()) if unbalanced < 1e-3 else np.inf

    def ground_frame_of(self, qpos: Array) -> GroundFrame:
        """Where a configuration (21,) in the world stands, by the position and heading of its soles."""
        self._kinematics(qpos)
        left, right = (self.model.site(f"sole_{side}").id for side in "LR")
        forward = self.data.site_xmat[[left, right]][:, [0, 3]].sum(0)
        forward /= np.linalg.norm(forward)
        x, y = self.data.site_xpos[[left, right], :2].mean(0) - self._ankle[0] * forward
        return GroundFrame(float(x), float(y), float(np.arctan2(forward[1], forward[0])))

    def violations(self, qpos: Array) -> list[str]:
        """What is wrong with a configuration (21,) in the world, by MuJoCo alone; empty if it is feasible."""
        if not (np.abs(qpos) < FAR).all():  # nor NaN; a damaged file may hold any number
            return ["values without bounds"]
        pos, rot = to_ground_frame(self.ground_frame_of(qpos), qpos[:3], matrix_from_wxyz(qpos[3:7]))
        qpos = np.concatenate([pos, wxyz_from_matrix(rot), qpos[7:]])
        wrong = []
        if not self._within_limits(qpos[7:], slice(None)):
            wrong.append("joint limit")
        if rot[2, 2] < np.cos(self.max_tilt) or pos[2] < self.min_height:
            wrong.append("base too tilted or too low")
        self._kinematics(qpos)
        for side, sign in zip("LR", (1, -1), strict=True):
            site = self.model.site(f"sole_{side}").id
            middle = sign * (self.hull_high[1] - self.robot.facts.foot.y[1])
            error = self.data.site_xpos[site] - [self._ankle[0], middle, 0.0]
            turned = np.linalg.norm(self.data.site_xmat[site].reshape(3, 3) - np.eye(3))
            if np.abs(error).max() > 1e-4 or turned > 1e-3:
                wrong.append(f"sole {side} is not in place")
        inside = self.com_inside(self.data.subtree_com[0, :2])
        if inside < self.com_margin - 1e-9:
            wrong.append(f"centre of mass {inside:.4f} m inside the soles")
        if not self.is_clear(qpos):
            wrong.append("collision")
        if self._effort_used(qpos) > EFFORT_SHARE + 1e-6:
            wrong.append("effort")
        return wrong


@cache
def static_solver(config: RobotConfig, com_margin: float, tilt: float, base_height: float) -> StaticSolver:
    """The solver of a robot configuration, built once a process (a tenth of a second)."""
    return StaticSolver(load_robot(config), com_margin, tilt, base_height)


_PITCH_JOINTS = ("hip", "knee", "ankle")
_PITCH_COLUMNS = [1, 2, 3, 5, 6, 7]  # of the eight leg joints
_KNEE_COLUMNS = [2, 6]


def _qpos(base: Array, leg_q: Array, arm_q: Array) -> Array:
    x, z, pitch = base
    return np.concatenate([[x, 0.0, z, np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0], leg_q, arm_q])


def _bodies(model: mujoco.MjModel) -> list[str]:
    return [model.body(i).name for i in range(model.nbody)]
