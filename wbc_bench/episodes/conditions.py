"""What disturbs an episode, in words."""

import numpy as np

from wbc_bench.episodes.rows import EpisodeManifest

MS, PERCENT = 1e3, 1e2  # of a second, of one


def conditions_of(rows: EpisodeManifest, row: int) -> list[str]:
    """What the manifest drew for one episode: pushes with time and speed, then what lasts.

    What is off is not said.

    Args:
        rows: Episodes of one manifest.
        row: Which of them.
    """
    return [f"push of {speed:.2f} m/s at {time:.1f} s" for time, speed in pushes_of(rows, row)] + _lasting(
        rows, row
    )


def pushes_of(rows: EpisodeManifest, row: int) -> list[tuple[float, float]]:
    """(time [s], speed [m/s] in all three axes of the world) of each push of one episode, in order."""
    sideways, up = rows.push_vel[row].reshape(-1, 2), rows.push_vel_z[row]
    speed = np.linalg.norm(np.column_stack([sideways, up]), axis=1)
    return sorted((float(t), float(v)) for t, v in zip(rows.push_time[row], speed, strict=True) if t == t)


def _lasting(rows: EpisodeManifest, row: int) -> list[str]:
    tilt, slope = (np.rad2deg(np.linalg.norm(part[row])) for part in (rows.imu_tilt, rows.slope))
    said = [
        (True, f"friction {rows.friction[row]:.2f}"),
        (rows.base_mass[row], f"added mass {rows.base_mass[row]:+.1f} kg"),
        (rows.payload[row], f"payload {rows.payload[row]:.2f} kg"),
        (
            np.ptp(rows.kp_scale[row]),
            f"gains times {rows.kp_scale[row].min():.2f} to {rows.kp_scale[row].max():.2f}",
        ),
        (rows.motor_strength[row] - 1, f"motors at {rows.motor_strength[row] * PERCENT:.0f} %"),
        (round(rows.command_delay[row] * MS), f"commands {rows.command_delay[row] * MS:.0f} ms late"),
        (
            round(rows.observation_delay[row] * MS),
            f"measurements {rows.observation_delay[row] * MS:.0f} ms late",
        ),
        (round(rows.odometry_delay[row] * MS), f"odometry {rows.odometry_delay[row] * MS:.0f} ms late"),
        (rows.odometry_drift[row], f"odometry drifts by {rows.odometry_drift[row] * MS:.0f} mm/√s"),
        (
            rows.joint_offset[row].any(),
            f"encoders off by {np.abs(rows.joint_offset[row]).max():.3f} rad at most",
        ),
        (tilt, f"IMU tilted by {tilt:.1f}°"),
        (slope, f"slope of {slope:.1f}°"),
    ]
    return [text for there, text in said if there]
