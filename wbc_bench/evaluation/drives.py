"""Gains, velocities and torques that commands carry beside positions, and how simulated motors take them."""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import JointCommand
from wbc_bench.robot import Robot

Array = NDArray[np.float64]
# A motor whose loop runs inside of MuJoCo has no input for torques: they are put in as positions, for which a
# gain must not be zero. 1e-6 N m/rad is far below what a motor resolves, and 1e9 rad is 1000 N m then.
LEAST_KP = 1e-6  # [N m/rad]
LARGEST_POSITION = 1e9  # [rad] MuJoCo gives up at 1e10


class Drive(NamedTuple):
    """What the PD loops of N robots add to positions; each (N, 14)."""

    kp: Array  # [N m/rad]
    kd: Array  # [N m s/rad]
    qd: Array  # [rad/s]
    torque: Array  # [N m]


def drive_of(command: JointCommand, robot: Robot) -> Drive:
    """The drive of a command, completed by the variant's own values."""
    given, shape = (command.kp, command.kd, command.qd, command.torque), np.shape(command.q)
    own = rest_of(robot)
    return Drive(
        *(np.broadcast_to(o, shape) if part is None else part for part, o in zip(given, own, strict=True))
    )


def rest_of(robot: Robot) -> Drive:
    """The drive (14,) of a command of positions alone."""
    zero = np.zeros_like(robot.kp)
    return Drive(robot.kp, robot.kd, zero, zero)


def equivalent_position(q: Array, drive: Drive) -> Array:
    """Positions (N, 14) [rad] which, tracked at rest with the same gains, give the same torque.

    kp (q' - p) - kd v = kp (q - p) + kd (qd - v) + torque. NaN where kp is zero: no position does.
    """
    extra = drive.kd * drive.qd + drive.torque  # [N m]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(drive.kp > 0, q + extra / drive.kp, np.nan)


def action_of(q: Array, drive: Drive, parts: Collection[str], robot: Robot) -> Array:
    """The action (N, A) [1] of commands that are more than positions, of a controller that names none.

    All `parts` that the controller uses, side by side: positions in units of the action scale, gains in units
    of the variant's, velocities and torques in units of their limits.
    """
    units = Drive(robot.kp, robot.kd, robot.velocity, robot.effort)
    scaled = [getattr(drive, part) / getattr(units, part) for part in Drive._fields if part in parts]
    return np.concatenate([robot.action_of(q), *scaled], axis=1)


class Motors:
    """Writes drives into the models of N simulations; it is made when a first command carries one."""

    def __init__(
        self, robot: Robot, fields: Callable[[str], Array], kp_scale: Array, kd_scale: Array
    ) -> None:
        """`fields(name)` is a model field of N simulations; the factors (N, 14) are those of the episodes."""
        self._internal = robot.facts.variant.motor is not None
        self._gain, self._bias = fields("actuator_gainprm"), fields("actuator_biasprm")
        self._kp_scale, self._kd_scale = kp_scale, kd_scale

    def apply(self, q: Array, drive: Drive) -> Array:
        """Set the gains of all rows.

        Args:
            q: (N, 14) [rad] positions as the encoders of the loops see them.
            drive: What acts beside them.

        Returns:
            Controls (N, 14) that make the motors exert what `JointCommand` says.
        """
        kp, kd = drive.kp * self._kp_scale, drive.kd * self._kd_scale
        extra = kd * drive.qd + drive.torque  # [N m]
        if self._internal:
            kp = np.maximum(kp, LEAST_KP)
            self._gain[:, :, 4], self._gain[:, :, 6] = kp, kd
            return np.clip(q + extra / kp, -LARGEST_POSITION, LARGEST_POSITION)
        self._gain[:, :, 0] = kp
        self._bias[:, :, 0], self._bias[:, :, 1], self._bias[:, :, 2] = extra, -kp, -kd
        return q
