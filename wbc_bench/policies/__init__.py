"""Policies of other stacks, each from a card: `policy:CARD.toml`."""

from pathlib import Path

from wbc_bench.controller import Controller
from wbc_bench.errors import ControllerError
from wbc_bench.robot import Robot


class Policies:
    """The entry point of policies by their cards."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """Create the controller of `policy:CARD.toml`. Raises: ControllerError, UnknownNameError."""
        from wbc_bench.policies.controller import from_card

        if not variant.endswith(".toml"):
            raise ControllerError(f"controller 'policy:{variant}', valid: policy:CARD.toml, a card's path")
        return from_card(robot, Path(variant))

    def variants(self) -> list[tuple[str, str]]:
        """Return the form of a variant, with its description."""
        return [
            (
                "CARD.toml",
                "A policy of another stack, described by a card: `wbc-bench policy import FILE.onnx`.",
            )
        ]


make = Policies()
