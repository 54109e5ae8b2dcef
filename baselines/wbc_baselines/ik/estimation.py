"""State estimation from the deployable signals: joints, gravity, centre of mass. Batched over episodes."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

Array = NDArray[np.float64]


def uniform_variance(half_width: float) -> float:
    """Variance of uniform noise on +-half_width."""
    return half_width**2 / 3


def kalman_gain(a: Array, c: Array, process: Array, measurement: Array) -> Array:
    """Steady-state Kalman gain of x' = a x + w, y = c x + v. Source: Anderson & Moore 1979, ch. 4."""
    cov = solve_discrete_are(a.T, c.T, process, measurement)
    return cov @ c.T @ np.linalg.inv(c @ cov @ c.T + measurement)


class JointFilter:
    """Joint positions and velocities of N robots: a steady-state Kalman filter, constant velocity between steps."""

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

    Source: complementary filter on the sphere, Mahony et al. 2008; the gain is the scalar Kalman gain.
    """

    def __init__(self, period: float, gravity_noise: float, gyro_noise: float) -> None:
        self._period = period
        one = np.eye(1)
        q = uniform_variance(gyro_noise) * period**2 + 1e-7
        self._gain = kalman_gain(one, one, q * one, uniform_variance(gravity_noise) * one + 1e-12).item()

    def reset(self, gravity: Array) -> None:
        """Start at measured directions (N, 3)."""
        self.gravity = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)

    def update(self, gravity: Array, ang_vel_b: Array) -> None:
        """Take in measured directions (N, 3) and gyro rates (N, 3) [rad/s]."""
        pred = self.gravity - self._period * np.cross(ang_vel_b, self.gravity)
        pred = pred + self._gain * (gravity - pred)
        self.gravity = pred / np.linalg.norm(pred, axis=1, keepdims=True)


class ComFilter:
    """Position, velocity and disturbance acceleration of the centre of mass of one robot, a Kalman filter.

    Between steps the mass follows the planned contact force plus a slowly varying disturbance (an unknown mass,
    gains that are not the nominal ones). An innovation that the noise cannot explain is taken for a push and
    opens the filter to a jump of the velocity.
    """

    def __init__(
        self, period: float, pos_noise: float, acceleration: float, drift: float, jump: float, threshold: float, pos: Array
    ) -> None:
        self._a = np.array([[1.0, period, period**2 / 2], [0.0, 1.0, period], [0.0, 0.0, 1.0]])
        self._b = self._a[:, 2].copy()
        self._b[2] = 0.0
        self._process = acceleration**2 * np.outer(self._b, self._b)
        self._process[2, 2] = drift**2 * period
        self._measurement = pos_noise**2
        direction = np.array([period, 1.0, 0.0])
        self._jump = jump**2 * np.outer(direction, direction)
        self.threshold = threshold
        self._state = np.zeros((3, 3))
        self._state[0] = pos
        self._cov = np.diag([self._measurement, jump**2, drift**2])

    @property
    def pos(self) -> Array:
        """(3,) [m]"""
        return self._state[0]

    @property
    def vel(self) -> Array:
        """(3,) [m/s]"""
        return self._state[1]

    @property
    def disturbance(self) -> Array:
        """(3,) [m/s^2]"""
        return self._state[2]

    def update(self, pos: Array, acceleration: Array) -> None:
        """Take in a measured position (3,) [m] after a step with a planned acceleration (3,) [m/s^2]."""
        state = self._a @ self._state + self._b[:, None] * acceleration
        cov = self._a @ self._cov @ self._a.T + self._process
        innovation = pos - state[0]
        if innovation @ innovation > self.threshold**2 * 3 * (cov[0, 0] + self._measurement):  # three sigma
            cov = cov + self._jump
        gain = cov[:, 0] / (cov[0, 0] + self._measurement)
        self._state = state + gain[:, None] * innovation
        self._cov = cov - gain[:, None] * cov[0]
