"""What a control step asked of the motors, sampled at one of its physics steps."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.episodes.protocol import Physics
from wbc_bench.robot import Robot

FULL = 1 - 1e-6  # of a limit: what is reached after rounding


class MotorLoad(NamedTuple):
    """Of N robots over one control period; a robot that did not move has zero and False."""

    work: NDArray[np.float64]  # (N,) [J] positive mechanical work, summed over the joints
    at_torque_limit: NDArray[np.bool_]  # (N,) some joint was, at the physics step that was sampled
    at_speed_limit: NDArray[np.bool_]  # (N,)


class LoadMeter:
    """Takes one sample per control period, at a physics step that goes round from period to period.

    So every part of the period counts alike, also the peak after a command jumps: sums over an episode are
    without bias. To sample all physics steps would cost a seventh of the physics, since the engine returns to
    Python at every one.
    """

    def __init__(self, robot: Robot, strength: NDArray[np.float64], physics: Physics) -> None:
        """`strength` (N,): factor of an episode on the torque limits of `robot`."""
        self._effort = FULL * strength[:, None] * robot.effort  # (N, 14) [N m]
        self._speed = FULL * robot.velocity  # (14,) [rad/s]
        self._period = physics.timestep * physics.decimation  # [s]
        self._decimation = physics.decimation
        self.due = 0  # physics steps after the start of the control period at which the sample is taken

    def begin(self) -> None:
        """A control period begins."""
        self.due = self.due % self._decimation + 1

    def sample(
        self, torque: NDArray[np.float64], speed: NDArray[np.float64], moved: NDArray[np.bool_]
    ) -> None:
        """Take the sample of the robots that `moved` (N,).

        Args:
            torque: (N, 14) [N m] applied throughout the physics step.
            speed: (N, 14) [rad/s] at its end. Positions advance by it, so that torque times speed is the
                exact power of the simulated motor over the physics step.
            moved: (N,)
        """
        power = np.maximum(torque * speed, 0.0).sum(axis=1)  # [W]
        self.load = MotorLoad(
            np.where(moved, power, 0.0) * self._period,
            moved & (np.abs(torque) >= self._effort).any(axis=1),
            moved & (np.abs(speed) >= self._speed).any(axis=1),
        )
