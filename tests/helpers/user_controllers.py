"""Controllers in files of their own, as a user writes them."""

from pathlib import Path

CONTROLLER = """
import os, signal, time
from pathlib import Path
import numpy as np
from wbc_bench.controller import ControllerInfo, JointCommand

class Mine:
    info = ControllerInfo("mine", frozenset({{"proprioception"}}), 0.02, "a test")

    def __init__(self, robot):
        self.default_q = robot.default_q

    def reset(self, episodes, obs, target):
        self.episodes, self.calls = episodes, 0

    def act(self, obs, target):
        self.calls += 1
        q = 0.5 * self.default_q + 0.5 * obs.proprioception.joint_pos
{body}
        return JointCommand(q)
"""


def write_controller(folder: Path, name: str, *body: str) -> str:
    """A user's own controller file; its name is unique because modules stay loaded in workers."""
    path = folder / f"{name}.py"
    path.write_text(CONTROLLER.format(body="".join(f"        {line}\n" for line in body)))
    return f"{path}:Mine"
