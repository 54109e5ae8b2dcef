"""What a controller may see: measurements with the protocol's noise, and the target in the base frame."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import (
    BasePose,
    EePose,
    Observation,
    Privileged,
    Proprioception,
    Signal,
    Target,
)
from wbc_bench.episodes.manifest import EpisodeManifest
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.simulation import State
from wbc_bench.randomness import stream
from wbc_bench.robot import NUM_JOINTS, NUM_LEG_JOINTS, load_robot
from wbc_bench.robot.kinematics import ArmKinematics
from wbc_bench.rotations import matrix_from_rotvec, matrix_from_wxyz, rho6

Array = NDArray[np.float64]
T = TypeVar("T", bound=tuple)
_WIDTHS = {  # signals with noise, in the order of their columns
    "base_ang_vel": 3,
    "gravity": 3,
    "joint_pos": NUM_JOINTS,
    "joint_vel": NUM_JOINTS,
    "joint_torque": NUM_JOINTS,
    "ee_pos": 3,
    "ee_rot": 6,
}
_HIDDEN = (  # fields of Privileged that are columns of the manifest
    *("payload", "payload_offset", "motor_strength", "joint_offset", "imu_tilt"),
    *("command_delay", "observation_delay", "odometry_delay"),
)


class Sensors:
    """Turns true states of N episodes into observations.

    Noise is uniform and is drawn for a whole episode at once from the episode's own stream, so that it
    depends neither on the batch nor on when another episode ends. Source: paper, section III-A.
    """

    def __init__(self, protocol: EvalProtocol, rows: EpisodeManifest, signals: frozenset[Signal]) -> None:
        self._rows, self._signals = rows, signals
        half = np.concatenate(
            [np.full(width, getattr(protocol.noise, name)) for name, width in _WIDTHS.items()]
        )
        self._columns, start = {}, 0
        for name, width in _WIDTHS.items():
            self._columns[name] = slice(start, start + width)
            start += width
        self._noise = None
        if half.any() and signals & {"proprioception", "ee_pose"}:
            shape = (protocol.num_steps + 1, len(half))
            self._noise = np.stack(
                [
                    stream(int(key), "noise").uniform(-1, 1, shape) * (half * scale)
                    for key, scale in zip(rows.noise_key, rows.noise_scale, strict=True)
                ],
                axis=1,
            )  # (T + 1, N, columns)
        # the IMU's axes in the base, and what it measures along them
        self._imu_tilt = None
        if rows.imu_tilt.any():
            self._imu_tilt = matrix_from_rotvec(np.pad(rows.imu_tilt, ((0, 0), (0, 1))))
        self._arm = ArmKinematics(load_robot(protocol.robot)) if rows.joint_offset.any() else None
        self._drift = None
        if rows.odometry_drift.any():
            self._drift = _random_walks(protocol, rows)
        self._target_rot_w = matrix_from_wxyz(rows.target_quat_w)
        self._period = protocol.control_period
        self._before: State | None = None

    def observe(
        self,
        step: int,
        time: float,
        state: State,
        active: NDArray[np.bool_],
        measured: State | None = None,
    ) -> Observation:
        """The observation at control step `step`, time [s].

        `measured` is the state that the sensors saw last, the present one if None.
        """
        measured = measured or state

        def noisy(name: str, value: Array) -> Array:
            return value if self._noise is None else value + self._noise[step][:, self._columns[name]]

        rot_w, rows, signals = state.base_rot_w, self._rows, self._signals
        proprioception = ee_pose = base_pose = privileged = None
        encoders = measured.joint_pos + rows.joint_offset
        if "proprioception" in signals:
            proprioception = Proprioception(
                base_ang_vel_b=noisy("base_ang_vel", self._by_imu(measured.base_ang_vel_b)),
                # R^T (0, 0, -1)
                gravity_b=noisy("gravity", self._by_imu(-measured.base_rot_w[:, 2])),
                joint_pos=noisy("joint_pos", encoders),
                joint_vel=noisy("joint_vel", measured.joint_vel),
                joint_torque=noisy("joint_torque", measured.joint_torque),
            )
        if "ee_pose" in signals:
            if self._arm is None:
                base = measured.base_rot_w
                pos_b = np.einsum("nji,nj->ni", base, measured.ee_pos_w - measured.base_pos_w)
                rot_b = np.swapaxes(base, 1, 2) @ measured.ee_rot_w
            else:  # where the encoders say that the hand is
                pos_b, rot_b = self._arm.pose(encoders[:, NUM_LEG_JOINTS:])
            ee_pose = EePose(noisy("ee_pos", pos_b), noisy("ee_rot", rho6(rot_b)))
        if "base_pose" in signals:
            base_pose = BasePose(state.base_pos_w, rot_w, state.base_lin_vel_w)
        if "privileged" in signals:
            privileged = Privileged(
                friction=rows.friction,
                base_mass=rows.base_mass,
                kp_scale=rows.kp_scale,
                kd_scale=rows.kd_scale,
                foot_force_w=state.foot_force_w,
                base_lin_vel_b=np.einsum("nji,nj->ni", rot_w, state.base_lin_vel_w),
                joint_torque=state.joint_torque,
                foot_pos_b=(state.foot_pos_w - state.base_pos_w[:, None]) @ rot_w,
                **self._rates(state),
                **{name: getattr(rows, name) for name in _HIDDEN},
                odometry_error_b=np.einsum("nji,nj->ni", rot_w, self._drift_at(step)),
            )
        return Observation(
            time,
            active.copy(),
            proprioception and _locked(proprioception),
            ee_pose and _locked(ee_pose),
            base_pose and _locked(base_pose),
            privileged and _locked(privileged),
        )

    def _rates(self, state: State) -> dict[str, Array]:
        """Finite differences to the state of the observation before."""
        before, self._before = self._before or state, state
        turned = state.ee_rot_w @ np.swapaxes(before.ee_rot_w, 1, 2)
        skew = (turned - np.swapaxes(turned, 1, 2)) / 2
        # the sine of the angle of a period stands for the angle: 0.1 % off at 4 rad/s
        ang = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=-1)
        rate = 1 / self._period  # [1/s]
        world = np.stack([state.ee_pos_w - before.ee_pos_w, ang], axis=1) * rate  # (N, 2, 3)
        lin_b, ang_b = np.moveaxis(world @ state.base_rot_w, 1, 0)
        joint_acc = (state.joint_vel - before.joint_vel) * rate
        return {"joint_acc": joint_acc, "ee_lin_vel_b": lin_b, "ee_ang_vel_b": ang_b}

    def _by_imu(self, vector_b: Array) -> Array:
        """Vectors (N, 3) of the base frame along the axes of the IMU, tilted and not known to be."""
        return vector_b if self._imu_tilt is None else np.einsum("nji,nj->ni", self._imu_tilt, vector_b)

    def target(self, odometry: State, step: int = 0) -> Target:
        """The manifest's targets in the base frame that odometry gives at control step `step`."""
        return self.in_base(odometry, self._rows.target_pos_w, self._target_rot_w, step)

    def in_base(self, odometry: State, pos_w: Array, rot_w: Array, step: int = 0) -> Target:
        """Poses (N, 3) [m], (N, 3, 3) of the world in the base frame that odometry gives, drift included."""
        base = odometry.base_rot_w
        believed = odometry.base_pos_w + self._drift_at(step)
        pos_b = np.einsum("nji,nj->ni", base, pos_w - believed)
        return _locked(Target(pos_b, np.swapaxes(base, 1, 2) @ rot_w))

    def _drift_at(self, step: int) -> Array:
        """How far (N, 3) [m] the odometry puts the base off at a control step; zeros without drift."""
        return np.zeros_like(self._rows.target_pos_w) if self._drift is None else self._drift[step]


def _locked(part: T) -> T:
    """A named tuple of arrays that cannot be written to: some are the harness's own."""
    views = [array.view() for array in part]
    for view in views:
        view.flags.writeable = False
    return type(part)(*views)


def _random_walks(protocol: EvalProtocol, rows: EpisodeManifest) -> Array:
    """(T + 1, N, 3) [m] drift of the odometry at every control step, zero at the start."""
    root, shape = np.sqrt(protocol.control_period), (protocol.num_steps, 3)
    steps = [
        stream(int(key), "odometry").normal(0.0, drift * root, shape)
        for key, drift in zip(rows.noise_key, rows.odometry_drift, strict=True)
    ]
    return np.pad(np.stack(steps, axis=1).cumsum(axis=0), ((1, 0), (0, 0), (0, 0)))
