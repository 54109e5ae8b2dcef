"""Holds the default posture: the floor under every table."""

import numpy as np
from numpy.typing import NDArray

from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.errors import UnknownNameError
from wbc_bench.robot import Robot


class HoldController:
    """Commands the default posture and looks at nothing."""

    def __init__(self, robot: Robot, variant: str = "") -> None:
        if variant:
            raise UnknownNameError("variant of hold", variant, [], "--controller")
        self.info = ControllerInfo("hold", frozenset(), control_period=0.02, source="wbc_baselines.hold")
        self._default_q = robot.default_q

    @staticmethod
    def variants() -> list[tuple[str, str]]:
        """Return the only variant, with its description."""
        return [("", "Holds the default posture.")]

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Nothing to forget."""
        self._command = JointCommand(np.tile(self._default_q, (len(episodes), 1)))

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """The default posture, (N, 14) [rad]."""
        return self._command
