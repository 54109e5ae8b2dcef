"""State estimation from the deployable signals: joints, gravity, centre of mass. Batched over episodes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from wbc_baselines.ik.geometry import cross, dot
from wbc_baselines.ik.kinematics import GRAVITY
from wbc_baselines.ik.rows import Rows

Array = NDArray[np.float64]


def uniform_variance(half_width: float) -> float:
    """Variance of uniform noise on +-half_width."""
    return half_width**2 / 3


def kalman_gain(a: Array, c: Array, process: Array, measurement: Array) -> Array:
    """Steady-state Kalman gain of x' = a x + w, y = c x + v. Source: Anderson & Moore 1979, ch. 4."""
    cov = solve_discrete_are(a.T, c.T, process, measurement)
    return cov @ c.T @ np.linalg.inv(c @ cov @ c.T + measurement)


class JointFilter:
    """Joint positions and velocities of N robots: a steady-state Kalman filter with constant velocity."""

    def __init__(self, period: float, pos_noise: float, vel_noise: float, acceleration: float) -> None:
        self._period = period
        a = np.array([[1.0, period], [0.0, 1.0]])
        g = np.array([[period**2 / 2], [period]])
        noise = np.diag([uniform_variance(pos_noise), uniform_variance(vel_noise)])
        self._gain = kalman_gain(a, np.eye(2), acceleration**2 * g @ g.T + 1e-12 * np.eye(2), noise)

    def reset(self, pos: Array) -> None:
        """Start at measured positions (N, 14) [rad], at rest."""
        self.pos, self.vel = pos.copy(), np.zeros_like(pos)

    def update(self, pos: Array, vel: Array) -> None:
        """Take in measurements (N, 14) [rad], [rad/s]."""
        k = self._gain
        pred = self.pos + self._period * self.vel
        dp, dv = pos - pred, vel - self.vel
        self.pos = pred + k[0, 0] * dp + k[0, 1] * dv
        self.vel = self.vel + k[1, 0] * dp + k[1, 1] * dv


class GravityFilter:
    """Direction of gravity in the base frame: the gyro turns it, the measured direction corrects it.

    The first measurements are averaged, since a single one is off by more than a degree.

    Source: complementary filter on the sphere, Mahony et al. 2008; the gain is the scalar Kalman gain.
    """

    def __init__(self, period: float, gravity_noise: float, gyro_noise: float) -> None:
        self._period = period
        one = np.eye(1)
        self._noise = np.sqrt(uniform_variance(gravity_noise))
        q = uniform_variance(gyro_noise) * period**2 + 1e-7
        self._gain = kalman_gain(one, one, q * one, uniform_variance(gravity_noise) * one + 1e-12).item()

    def reset(self, gravity: Array) -> None:
        """Start at measured directions (N, 3)."""
        self.gravity = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
        self._count = 1
        self.deviation = self._noise  # [rad] of the direction

    def update(self, gravity: Array, ang_vel_b: Array) -> None:
        """Take in measured directions (N, 3) and gyro rates (N, 3) [rad/s]."""
        pred = self.gravity - self._period * cross(ang_vel_b, self.gravity)
        self._count += 1
        gain = max(self._gain, 1 / self._count)
        self.deviation = self._noise * np.sqrt(gain)
        pred = pred + gain * (gravity - pred)
        self.gravity = pred / np.linalg.norm(pred, axis=1, keepdims=True)


@dataclass
class Com(Rows):
    """Position and velocity of the centres of mass of N robots, as a `ComFilter` knows them."""

    pos: Array  # (N, 3) [m]
    vel: Array  # (N, 3) [m/s]
    cov: Array  # (N, 2, 2) of each axis [m^2], [m^2/s], [m^2/s^2]

    def capture_point(self) -> tuple[Array, Array]:
        """Where (N, 2) [m] a foot would bring the mass to rest, and the rate (N,) [1/s] of running away.

        Source: Pratt et al. 2006.
        """
        rate = np.sqrt(GRAVITY / np.maximum(self.pos[:, 2], 0.2))  # [1/s] of the linear inverted pendulum
        return self.pos[:, :2] + self.vel[:, :2] / rate[:, None], rate


class ComFilter:
    """A Kalman filter of the centre of mass.

    Between steps the mass follows the planned contact force. An innovation that the noise cannot explain is
    taken for a push and opens the filter to a jump of the velocity.
    """

    def __init__(self, period: float, pos_noise: float, acceleration: float, jump: float) -> None:
        self._a = np.array([[1.0, period], [0.0, 1.0]])
        self._b = np.array([period**2 / 2, period])
        self._process = acceleration**2 * np.outer(self._b, self._b)
        self._joint_variance = pos_noise**2
        self._jump = jump**2 * np.outer([period, 1.0], [period, 1.0])

    def start(self, pos: Array) -> Com:
        """At rest at (N, 3) [m]."""
        cov = np.diag([0.03**2, 0.2**2])  # [m^2], [m^2/s^2] at a disturbed reset
        return Com(pos.copy(), np.zeros_like(pos), np.tile(cov, (len(pos), 1, 1)))

    def update(self, com: Com, pos: Array, acceleration: Array, tilt: float) -> None:
        """Take in positions (N, 3) [m], seen with a tilt error [rad], after accelerations (N, 3) [m/s^2]."""
        a, b = self._a, self._b
        pred = com.pos + a[0, 1] * com.vel + b[0] * acceleration
        vel = com.vel + b[1] * acceleration
        cov = a @ com.cov @ a.T + self._process
        noise = self._joint_variance + (tilt * pos[:, 2]) ** 2  # (N,)
        innovation = pos - pred
        # three sigma, three axes
        pushed = dot(innovation, innovation) > 3.0**2 * 3 * (cov[:, 0, 0] + noise)
        cov = cov + np.where(pushed[:, None, None], self._jump, 0.0)
        gain = cov[:, :, 0] / (cov[:, 0, 0] + noise)[:, None]  # (N, 2)
        com.pos, com.vel = pred + gain[:, :1] * innovation, vel + gain[:, 1:] * innovation
        com.cov = cov - gain[:, :, None] * cov[:, :1]
