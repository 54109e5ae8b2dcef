"""What measured torques say of the robot: the payload in its hand, and the gains of its drives."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.kinematics import GRAVITY
from wbc_baselines.ik.rows import Mask, Rows

Array = NDArray[np.float64]
LEAST = 1.0  # [(N m/kg)^2] of the arm's torques per kilogram, below which a payload cannot be seen; choice
SATURATED = 0.8  # of a torque limit, from which on a drive says nothing of its gain; choice


@dataclass
class Payload(Rows):
    """Payload in the hands of N robots: what the arm's torques hold beyond the arm's own weight.

    A mean at first, then a low-pass filter, whose noise would otherwise shake the soft arm that its result
    is fed forward to.
    """

    time: Array  # (N,) [s] of observation
    mass: Array  # (N,) [kg]

    def update(self, s: IKConfig, period: float, seen: Mask, lift: Array, residual: Array) -> None:
        """Take in arm torques.

        Args:
            s: Filter time and limit.
            period: [s] since the last one.
            seen: (N,) robots that are observed.
            lift: (N, 6) [m/rad] of the end-effector, upwards, by the arm's joints.
            residual: (N, 6) [N m] measured beyond what the arm's own weight asks for.
        """
        self.time += np.where(seen, period, 0.0)
        per_kg = lift * GRAVITY  # (N, 6) [N m/kg]
        gain = np.where(seen, period / np.clip(self.time, period, s.payload_time), 0.0)
        left = residual - self.mass[:, None] * per_kg
        step = gain * (per_kg * left).sum(axis=1) / ((per_kg * per_kg).sum(axis=1) + LEAST)
        self.mass = np.clip(self.mass + step, 0.0, s.payload_limit)


class GainObserver:
    """Factors on the nominal stiffness of N robots' joints, from what the drives made of commands.

    Least squares with forgetting of torque = factor x (kp (command - position) - kd velocity), drawn to one
    by a prior.
    """

    def __init__(self, period: float, s: IKConfig, kp: Array, kd: Array, effort: Array) -> None:
        self._kp, self._kd, self._effort = kp, kd, effort
        self._keep = np.exp(-period / s.gain_time)
        self._prior, self._limit = s.gain_prior, s.gain_limit

    def reset(self, count: int) -> None:
        """Know nothing of `count` robots."""
        self._xy, self._xx = np.zeros((2, count, len(self._kp)))
        self.factor = np.ones((count, len(self._kp)))  # (N, 14)

    def update(self, command: Array, pos: Array, vel: Array, torque: Array) -> None:
        """Take in commands (N, 14) [rad], positions [rad], velocities [rad/s] and torques [N m]."""
        x = self._kp * (command - pos) - self._kd * vel
        x = np.where(np.abs(torque) < SATURATED * self._effort, x, 0.0)
        self._xy = self._keep * self._xy + x * (torque - x)
        self._xx = self._keep * self._xx + x**2
        factor = 1.0 + self._xy / (self._xx + self._prior)
        self.factor = np.clip(factor, 1.0 - self._limit, 1.0 + self._limit)
