"""A shard of episodes on MuJoCo's batch API: reset from manifest rows, push, step, and measure."""

import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.episodes.world import PAYLOAD, world_model
from wbc_bench.evaluation.delays import LateCommands, LateStates, physics_steps
from wbc_bench.evaluation.drives import Drive, Motors, rest_of
from wbc_bench.evaluation.motor_load import LoadMeter, MotorLoad
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, Robot, Scene, load_robot
from wbc_bench.rotations import matrix_from_rotvec, matrix_from_wxyz, wxyz_from_matrix

Array = NDArray[np.float64]
_JOINTS = slice(7, 7 + NUM_JOINTS)  # of the robot in qpos; what a scene adds follows
_JOINT_SPEEDS = slice(6, 6 + NUM_JOINTS)
_STAGE_NONE, _STAGE_VEL = mujoco.mjtStage.mjSTAGE_NONE, mujoco.mjtStage.mjSTAGE_VEL
MAX_SPEED = 1e3  # [m/s, rad/s] of any coordinate; beyond it the integration has diverged
# on these MuJoCo resets the simulation or zeroes its controls, and goes on as if nothing had happened
FATAL_WARNINGS = [
    getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}").value for name in ("QPOS", "QVEL", "QACC", "CTRL")
]


class Places(NamedTuple):
    """Where the arrays of a model hold what is read of the robot."""

    tcp: int  # site
    soles: list[int]  # sites, left and right
    sole_force: NDArray[np.int64]  # (2, 3) columns of the sensors
    ground: NDArray[np.int64]  # columns of the sensors: contacts of other parts than the feet


def places_of(model: mujoco.MjModel) -> Places:
    """The places of a model that `Robot.model` built."""
    names = [model.sensor(i).name for i in range(model.nsensor)]
    address = {name: int(model.sensor_adr[i]) for i, name in enumerate(names)}
    return Places(
        tcp=model.site("tcp").id,
        soles=[model.site(f"sole_{side}").id for side in "LR"],
        sole_force=np.add.outer([address["sole_L_force"], address["sole_R_force"]], np.arange(3)),
        ground=np.array([address[name] for name in names if name.startswith("ground_")]),
    )


class State(NamedTuple):
    """The true state of N simulations after a control step."""

    base_pos_w: Array  # (N, 3) [m]
    base_rot_w: Array  # (N, 3, 3)
    base_lin_vel_w: Array  # (N, 3) [m/s]
    base_ang_vel_b: Array  # (N, 3) [rad/s]
    joint_pos: Array  # (N, 14) [rad]
    joint_vel: Array  # (N, 14) [rad/s]
    joint_torque: Array  # (N, 14) [N m]
    ee_pos_w: Array  # (N, 3) [m]
    ee_rot_w: Array  # (N, 3, 3)
    foot_pos_w: Array  # (N, 2, 3) [m] left and right sole
    foot_force_w: Array  # (N, 2, 3) [N] ground on left and right sole, one physics step late
    ground_contact: NDArray[
        np.bool_
    ]  # (N,) a part other than a foot touches the ground, one physics step late
    diverged: NDArray[np.bool_]  # (N,)


def scale_gains(robot: Robot, fields: Callable[[str], Any], kp: Any, kd: Any) -> None:
    """Multiply the gains of PD loops by factors (N, 14).

    Args:
        robot: Robot of the simulations.
        fields: Gives a model field of N simulations by its name, which is changed; of NumPy or PyTorch, as
            are the factors.
        kp: Factors of the stiffness.
        kd: Factors of the damping.
    """
    gain = fields("actuator_gainprm")
    if robot.facts.variant.motor is None:
        gain[:, :, 0] *= kp
        bias = fields("actuator_biasprm")
        bias[:, :, 1] *= kp
        bias[:, :, 2] *= kd
    else:  # the controller inside of MuJoCo's motor
        gain[:, :, 4] *= kp
        gain[:, :, 6] *= kd


class Simulation:
    """N episodes of one protocol, on one thread. Rows that have ended are not stepped further."""

    def __init__(self, protocol: EvalProtocol, rows: EpisodeManifest, scene: Scene | None = None) -> None:
        self.protocol, self.rows = protocol, rows
        self.robot = load_robot(protocol.robot)
        model = world_model(protocol, scene)
        count = len(rows)
        # persistent: sensors refreshed after a step are not computed again by the next
        self._batch = batch = Batch(model, count, nthread=1, persistent=True)
        self._base = model.body(self.robot.facts.base).id
        self._randomise(model)
        physics = protocol.physics
        self._delay = physics_steps(rows.command_delay, physics.timestep)
        self._commands = LateCommands(self._delay, physics.decimation, self.robot.default_q)
        self._drives: LateCommands | None = None  # of a controller that commands more than positions
        self._qpos, self._qvel, self._ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self._site_xpos, self._site_xmat = batch.bind("site_xpos"), batch.bind("site_xmat")
        self._subtree_com = batch.bind("subtree_com")
        self._torque, self._sensor = batch.bind("actuator_force"), batch.bind("sensordata")
        self._places = places_of(model)
        self.physics_time = 0.0  # [s] of processor time in the engine's steps
        self._meter = LoadMeter(self.robot, rows.motor_strength, physics)
        self._reset()

    def _randomise(self, model: mujoco.MjModel) -> None:
        """What an episode draws of the robot and of its ground becomes model fields of its simulation."""
        rows, batch = self.rows, self._batch
        # the larger coefficient of a pair counts, so both sides carry the draw
        batch.expand("geom_friction")[:, :, 0] = rows.friction[:, None]
        base = self._base
        mass = model.body_mass[base]
        masses = batch.expand("body_mass")
        masses[:, base] = mass + rows.base_mass
        batch.expand("body_inertia")[:, base] = (
            model.body_inertia[base] * ((mass + rows.base_mass) / mass)[:, None]
        )
        scale_gains(self.robot, batch.expand, rows.kp_scale, rows.kd_scale)
        if np.any(rows.motor_strength != 1):
            batch.expand("actuator_forcerange")[:] *= rows.motor_strength[:, None, None]
        if rows.payload.any():
            hand = model.body(PAYLOAD).id
            masses[:, hand] = rows.payload
            batch.expand("body_ipos")[:, hand] = rows.payload_offset
        ground = model.geom("ground").id
        if rows.slope.any():
            turned = np.pad(rows.slope, ((0, 0), (0, 1)))
            batch.expand("geom_quat")[:, ground] = wxyz_from_matrix(matrix_from_rotvec(turned))
        if rows.terrain_offset.any():
            place = np.pad(rows.terrain_offset, ((0, 0), (0, 1)))
            turned = matrix_from_rotvec(np.pad(rows.slope, ((0, 0), (0, 1))))
            batch.expand("geom_pos")[:, ground] = np.einsum("nij,nj->ni", turned, place)
        batch.set_const()

    def _reset(self) -> None:
        rows, qpos, qvel = self.rows, self._qpos, self._qvel
        self._batch.reset(stage=_STAGE_NONE)
        qpos[:, :7] = 0.0
        qpos[:, 2], qpos[:, 3] = rows.base_height, 1.0
        qpos[:, _JOINTS] = self.robot.default_q
        qpos[:, 7 : 7 + NUM_LEG_JOINTS] += rows.leg_q
        qvel[:, :6] = rows.base_vel
        qvel[:, 6 : 6 + NUM_LEG_JOINTS] = rows.leg_qd
        self._ctrl[:] = self.robot.default_q - rows.joint_offset
        self._batch.forward()

    def push(self, velocity: Array) -> None:
        """Add to the base's velocity: (N, 2), (N, 3) in the world [m/s], or (N, 6), the rest in the base."""
        self._qvel[:, : velocity.shape[1]] += velocity

    def step(
        self,
        command: Array,
        active: NDArray[np.bool_],
        late: Sequence[LateStates] = (),
        drive: Drive | None = None,
    ) -> State:
        """Let the PD loop track joint commands (N, 14) [rad] for one control period, in active rows only.

        Commands act when their episode's delay has passed; the PD loop compares them with the encoders, which
        are off by the episode's offset. `late` are shown the states at the times that they ask for. Without a
        `drive` the loop has the variant's gains.

        Returns:
            The state at the end of the period.
        """
        decimation = self.protocol.physics.decimation
        ids = np.flatnonzero(active)
        chosen = None if len(ids) == len(active) else ids
        self._commands.give(command)
        self._give(drive)
        self._meter.begin()
        for states in late:
            states.begin_step()
        sampled = set().union(*(states.offsets for states in late)) - {decimation}
        due = self._meter.due
        for begin, end in pairwise(sorted({0, due, decimation} | self._commands.offsets | sampled)):
            control = self._commands.acting(begin) - self.rows.joint_offset
            if self._drives is not None:
                acting = self._drives.acting(begin).reshape(len(active), len(Drive._fields), NUM_JOINTS)
                control = self._motors.apply(control, Drive(*np.moveaxis(acting, 1, 0)))
            self._ctrl[ids] = control[ids]
            stage = _STAGE_VEL if end in sampled | {decimation} else _STAGE_NONE
            start = time.process_time()
            self._batch.step(chosen, nstep=end - begin, stage=stage)
            self.physics_time += time.process_time() - start
            if end == due:
                self._meter.sample(self._torque, self._qvel[:, _JOINT_SPEEDS], active)
            if end in sampled:
                for states in late:
                    states.sample(end, self.state())
        state = self.state()
        for states in late:
            states.sample(decimation, state)
        return state

    def _give(self, drive: Drive | None) -> None:
        """Keep a drive with the positions of the same command, so that both act equally late."""
        rest = np.concatenate(rest_of(self.robot))
        if self._drives is None:
            if drive is None:
                return
            self._drives = LateCommands(self._delay, self.protocol.physics.decimation, rest)
            self._motors = Motors(self.robot, self._batch.expand, self.rows.kp_scale, self.rows.kd_scale)
        self._drives.give(rest if drive is None else np.concatenate(drive, axis=1))

    @property
    def load(self) -> MotorLoad:
        """What the last control step asked of the motors."""
        return self._meter.load

    @property
    def qpos(self) -> Array:
        """(N, 21) base position [m], base quaternion wxyz, joints [rad]; a copy."""
        return self._qpos[:, : _JOINTS.stop].copy()

    @property
    def com_w(self) -> Array:
        """(N, 3) [m] centre of mass of the whole robot, with the base mass of its episode; a copy."""
        return self._subtree_com[:, self._base].copy()

    @property
    def scenery(self) -> Array:
        """Positions (N, K) of the joints that a scene added; K is 0 without one."""
        return self._qpos[:, _JOINTS.stop :].copy()

    def state(self) -> State:
        """The state now; arrays are copies or freshly computed."""
        qpos, qvel, at = self._qpos.copy(), self._qvel.copy(), self._places
        speed = np.abs(qvel).max(axis=1)
        fatal = np.any(self._batch.warning[:, FATAL_WARNINGS, 1] > 0, axis=1)
        return State(
            base_pos_w=qpos[:, :3],
            base_rot_w=matrix_from_wxyz(qpos[:, 3:7]),
            base_lin_vel_w=qvel[:, :3],
            base_ang_vel_b=qvel[:, 3:6],
            joint_pos=qpos[:, _JOINTS],
            joint_vel=qvel[:, _JOINT_SPEEDS],
            joint_torque=self._torque.copy(),
            ee_pos_w=self._site_xpos[:, at.tcp].copy(),
            ee_rot_w=self._site_xmat[:, at.tcp].reshape(-1, 3, 3).copy(),
            foot_pos_w=self._site_xpos[:, at.soles],
            foot_force_w=self._sensor[:, at.sole_force],
            ground_contact=np.any(self._sensor[:, at.ground] > 0, axis=1),
            diverged=~(np.isfinite(qpos).all(axis=1) & (speed < MAX_SPEED)) | fatal,
        )
