"""What may stand around the robot."""

from typing import Protocol

import mujoco


class Scene(Protocol):
    """Bodies beside the robot. The robot keeps its places in the model: their joints follow its own."""

    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add them to the robot's editable model; their joints begin at the model's reference."""
        ...
