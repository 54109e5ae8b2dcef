"""A controller that stands in the default posture and moves one arm joint with the distance of the target."""

import numpy as np

from wbc_bench import ControllerInfo, JointCommand

SHOULDER = 9  # J2 of the arm; `robot.facts.joints` lists the order


class Lean:
    def __init__(self, robot):
        self.info = ControllerInfo(
            name="lean",
            signals=frozenset({"proprioception"}),
            control_period=0.02,  # [s]
            source="lean.py",
        )
        self.robot = robot

    def reset(self, episodes, obs, target):
        pass  # nothing to forget

    def act(self, obs, target):
        action = np.zeros((len(obs.active), 14))
        action[:, SHOULDER] = np.clip(target.pos_b[:, 0], 0.0, 1.0)  # target distance ahead [m]
        return JointCommand(self.robot.command_of(action))
