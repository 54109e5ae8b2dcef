"""A controller that builds on a shipped one: `ik:standing`, with a limit on how fast the arm is commanded.

    wbc-bench eval --controller examples/own_controller.py:GentleArm ik:standing \\
        --protocol nominal_v2 --replicates 1 --episodes 20 --out build/own_controller

On these 20 undisturbed episodes it reaches the target in 16 and falls in 1: all 14 of the strata `arm` and
`posture`, and 2 of the 6 of `step`, since it never takes a step. `ik:standing` itself reaches 15 and falls in
2; so few episodes do not tell the two apart.
"""

import numpy as np
from numpy.typing import NDArray

from wbc_bench import ControllerInfo, JointCommand, Observation, Target, load_controller
from wbc_bench.robot import NUM_LEG_JOINTS, Robot

ARM = slice(NUM_LEG_JOINTS, None)  # the 8 leg joints come first, then the 6 of the arm
MAX_SPEED = 0.5  # [rad/s] choice: a full turn in 13 s, slow enough to be seen in a replay


class GentleArm:
    """Asks `ik:standing` for joint commands, and lets those of the arm change by at most MAX_SPEED."""

    def __init__(self, robot: Robot) -> None:
        self._inner = load_controller("ik:standing", robot)
        # It reads what the inner controller reads and nothing else, at the same control period.
        self.info = ControllerInfo(
            name="gentle_arm",
            signals=self._inner.info.signals,
            control_period=self._inner.info.control_period,
            source="examples/own_controller.py",
        )
        self._max_change = MAX_SPEED * self.info.control_period  # [rad]
        self._default_arm = robot.default_q[ARM]

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Starts N episodes, each with the arm in the default posture."""
        self._inner.reset(episodes, obs, target)
        self._arm = np.tile(self._default_arm, (len(episodes), 1))  # (N, 6) [rad]

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Returns the joint commands (N, 14) [rad] of one control step."""
        asked = self._inner.act(obs, target)
        q = asked.q.copy()
        q[:, ARM] = np.clip(q[:, ARM], self._arm - self._max_change, self._arm + self._max_change)
        self._arm = q[:, ARM].copy()
        return JointCommand(q, asked.infeasible)
