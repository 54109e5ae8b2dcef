"""What measured torques say of the robot: the payload in its hand, and the gains of its drives."""

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.config import IKConfig
from wbc_baselines.ik.model import GRAVITY

Array = NDArray[np.float64]
LEAST = 1.0  # [(N m/kg)^2] of the arm's torques per kilogram, below which a payload cannot be seen; choice
SATURATED = 0.8  # of a torque limit, from which on a drive says nothing of its gain; choice


class PayloadObserver:
    """Payload in the hand of one robot: what the arm's torques hold beyond the arm's own weight.

    A mean at first, then a low-pass filter, whose noise would otherwise shake the soft arm that its result
    is fed forward to.
    """

    def __init__(self, period: float, s: IKConfig) -> None:
        self._period, self._filter_time, self._limit = period, s.payload_time, s.payload_limit
        self._time = 0.0  # [s] of observation
        self.mass = 0.0  # [kg]

    def update(self, hand: Array, gravity: Array, torque: Array) -> None:
        """Take in arm torques.

        Args:
            hand: Jacobian (6, 6) of the end-effector by the arm's joints, world-aligned.
            gravity: (6,) [N m] that the arm's own weight asks for.
            torque: (6,) [N m] measured.
        """
        self._time += self._period
        per_kg = hand[2] * GRAVITY  # (6,) [N m/kg]
        residual = torque - gravity - self.mass * per_kg
        gain = self._period / min(self._time, self._filter_time)
        step = gain * float(per_kg @ residual) / float(per_kg @ per_kg + LEAST)
        self.mass = float(np.clip(self.mass + step, 0.0, self._limit))


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
