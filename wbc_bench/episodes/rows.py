"""The rows of a manifest: one an episode, holding every draw that the episode needs."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import MAX_PUSHES
from wbc_bench.robot import NUM_JOINTS


@dataclass(frozen=True)
class EpisodeManifest:
    """Columns of M episodes, in the order (replicate, episode)."""

    replicate: NDArray[np.int64]  # (M,)
    episode: NDArray[np.int64]  # (M,) number inside the replicate
    stratum: NDArray[np.object_]  # (M,) arm, posture, step; beyond: no feasible pose is known
    condition: NDArray[np.object_]  # (M,) "", nominal, randomised
    orientation: NDArray[np.object_]  # (M,) "", free, horizontal
    height: NDArray[np.float64]  # (M,) [m] nominal target height (reach), else the target's
    target_pos_w: NDArray[np.float64]  # (M, 3) [m]
    target_quat_w: NDArray[np.float64]  # (M, 4) wxyz
    # (M, 21) a feasible configuration that reaches the target; NaN if beyond
    feasible_qpos: NDArray[np.float64]
    base_height: NDArray[np.float64]  # (M,) [m] at reset: the lower sole touches the ground
    friction: NDArray[np.float64]  # (M,)
    base_mass: NDArray[np.float64]  # (M,) [kg] added
    base_vel: NDArray[np.float64]  # (M, 6) linear in the world [m/s], angular in the base [rad/s]
    leg_q: NDArray[np.float64]  # (M, 8) [rad] added to the default posture at reset
    leg_qd: NDArray[np.float64]  # (M, 8) [rad/s]
    kp_scale: NDArray[np.float64]  # (M, 14)
    kd_scale: NDArray[np.float64]  # (M, 14)
    push_time: NDArray[np.float64]  # (M, MAX_PUSHES) [s], NaN for none
    push_vel: NDArray[np.float64]  # (M, 2 * MAX_PUSHES) [m/s] x, y of each, in the world
    noise_key: NDArray[np.int64]  # (M,) seed of the episode's noise stream
    noise_scale: NDArray[np.float64]  # (M,) 0 or 1 on the protocol's noise

    # Later columns, constant through an episode; a file without them means no such disturbance.
    push_vel_z: NDArray[np.float64]  # (M, MAX_PUSHES) [m/s]
    push_ang_vel: NDArray[np.float64]  # (M, 3 * MAX_PUSHES) [rad/s] in the base
    command_delay: NDArray[np.float64]  # (M,) [s]
    observation_delay: NDArray[np.float64]  # (M,) [s]
    odometry_delay: NDArray[np.float64]  # (M,) [s]
    odometry_drift: NDArray[np.float64]  # (M,) [m/sqrt(s)]
    payload: NDArray[np.float64]  # (M,) [kg]
    payload_offset: NDArray[np.float64]  # (M, 3) [m] in the end-effector frame
    motor_strength: NDArray[np.float64]  # (M,) factor on the torque limits
    joint_offset: NDArray[np.float64]  # (M, 14) [rad] measured less true
    imu_tilt: NDArray[np.float64]  # (M, 2) [rad] rotation vector in the base, x and y
    slope: NDArray[np.float64]  # (M, 2) [rad] rotation vector of the ground, x and y
    terrain_offset: NDArray[np.float64]  # (M, 2) [m] where on the uneven ground

    def __len__(self) -> int:
        return len(self.replicate)

    def take(self, rows: NDArray[np.int64] | slice) -> "EpisodeManifest":
        """The chosen rows."""
        return EpisodeManifest(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def of_replicate(self, replicate: int, count: int | None = None) -> "EpisodeManifest":
        """The first `count` (default all) episodes of a replicate."""
        return self.take(np.flatnonzero(self.replicate == replicate)[:count])


def neutral(count: int, pushes: int = MAX_PUSHES) -> dict[str, NDArray[np.float64]]:
    """The later columns (`count`, ...) of episodes without any of the disturbances that they hold.

    `pushes` is the room for them, other than that of a manifest where no manifest is written.
    """
    widths = {"push_vel_z": pushes, "push_ang_vel": 3 * pushes, "joint_offset": NUM_JOINTS}
    widths |= {"payload_offset": 3, "imu_tilt": 2, "slope": 2, "terrain_offset": 2}
    scalars = ("command_delay", "observation_delay", "odometry_delay", "odometry_drift", "payload")
    columns = {name: np.zeros((count, width)) for name, width in widths.items()}
    columns |= {name: np.zeros(count) for name in scalars}
    return columns | {"motor_strength": np.ones(count)}
