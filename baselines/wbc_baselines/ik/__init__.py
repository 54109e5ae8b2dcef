"""`ik`: whole-body inverse kinematics over the floating base.

Variants: `ik` (PlaCo), `ik:osqp` (the same program on Pinocchio and OSQP), `ik:kinematic` (PlaCo without
feed-forward and feedback: what is left is the whole-body IK alone) and
`ik:standing` (PlaCo that never lifts a foot).
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from wbc_baselines.ik.config import TUNED, TUNED_FOR
from wbc_bench.errors import ControllerError, UnknownNameError, missing_extra
from wbc_bench.robot import Robot

if TYPE_CHECKING:
    from wbc_baselines.ik.controller import IKController

CHANGES: dict[str, dict[str, bool]] = {  # to the tuned configuration
    "": {},
    "kinematic": {"feedforward": False, "feedback": False, "stepping": False},
    "osqp": {},
    "standing": {"stepping": False},
}
DESCRIPTIONS = {
    "": "Whole-body inverse kinematics that takes steps; its quadratic program is solved by PlaCo.",
    "kinematic": "The inverse kinematics alone: no feed-forward, no feedback, no steps.",
    "osqp": "The same quadratic program as `ik`, on Pinocchio and OSQP.",
    "standing": "As `ik`, but no foot is ever lifted.",
}
VARIANTS = tuple(CHANGES)


class IK:
    """The entry point of the inverse-kinematics controllers."""

    def __call__(self, robot: Robot, variant: str = "") -> "IKController":
        """Create the controller of a variant.

        Raises:
            UnknownNameError: There is no such variant.
            ControllerError: A solver is not installed.
        """
        if variant not in VARIANTS:
            raise UnknownNameError("variant of ik", variant, VARIANTS[1:], "--controller")
        config = replace(TUNED_FOR.get(robot.config.variant, TUNED), **CHANGES[variant])
        name = f"ik:{variant}" if variant else "ik"
        # imported here: each solver is needed only by its own variant
        try:
            from wbc_baselines.ik.controller import PERIOD, IKController

            if variant == "osqp":
                from wbc_baselines.ik.osqp_ik import OsqpIK as Solver
            else:
                from wbc_baselines.ik.placo_ik import PlacoIK as Solver
        except ImportError as error:
            raise ControllerError(missing_extra(f"controller '{name}'", "ik", error)) from error
        return IKController(robot, Solver(robot, config.weights, PERIOD), config, name)

    def variants(self) -> list[tuple[str, str]]:
        """Return every variant with its description."""
        return [(variant, DESCRIPTIONS[variant]) for variant in VARIANTS]


make = IK()
