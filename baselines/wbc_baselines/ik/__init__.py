"""`ik`: whole-body inverse kinematics over the floating base.

Variants: `ik` (all episodes of a shard at once, their programs solved by DAQP), `ik:placo` and `ik:osqp` (the
same program in PlaCo, and on Pinocchio and OSQP, an episode at a time), `ik:kinematic` (without feed-forward
and feedback: what is left is the whole-body IK alone), `ik:standing` (never lifts a foot) and `ik:arm` (the
arm alone, on legs that hold their posture or that another controller moves).
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from wbc_baselines.ik.arm_only import ArmController
from wbc_baselines.ik.config import TUNED, TUNED_FOR
from wbc_bench.errors import ControllerError, UnknownNameError, missing_extra
from wbc_bench.robot import Robot

if TYPE_CHECKING:
    from wbc_bench.controller import Controller

CHANGES: dict[str, dict[str, bool]] = {  # to the tuned configuration
    "": {},
    "kinematic": {"feedforward": False, "feedback": False, "stepping": False},
    "osqp": {},
    "placo": {},
    "standing": {"stepping": False},
}
DESCRIPTIONS = {
    "arm": "The arm's inverse kinematics alone: the legs hold the default posture.",
    "": "Whole-body inverse kinematics that takes steps; its quadratic program is solved by DAQP.",
    "kinematic": "The inverse kinematics alone: no feed-forward, no feedback, no steps.",
    "osqp": "The same quadratic program as `ik`, on Pinocchio and OSQP.",
    "placo": "The same quadratic program as `ik`, in PlaCo.",
    "standing": "As `ik`, but no foot is ever lifted.",
}
ARM = "arm"
VARIANTS = (ARM, *CHANGES)


class IK:
    """The entry point of the inverse-kinematics controllers."""

    def __call__(self, robot: Robot, variant: str = "") -> "Controller":
        """Create the controller of a variant.

        Raises:
            UnknownNameError: There is no such variant.
            ControllerError: A solver is not installed.
        """
        if variant not in VARIANTS:
            raise UnknownNameError("variant of ik", variant, filter(None, VARIANTS), "--controller")
        if variant == ARM:
            return ArmController(robot)
        config = replace(TUNED_FOR.get(robot.config.variant, TUNED), **CHANGES[variant])
        name = f"ik:{variant}" if variant else "ik"
        # imported here: each solver is needed only by its own variant
        try:
            from wbc_baselines.ik.batch_ik import OneByOne
            from wbc_baselines.ik.controller import PERIOD, IKController

            if variant == "osqp":
                from wbc_baselines.ik.osqp_ik import OsqpIK

                solver = OneByOne(OsqpIK(robot, config.weights, PERIOD))
            elif variant == "placo":
                from wbc_baselines.ik.placo_ik import PlacoIK

                solver = OneByOne(PlacoIK(robot, config.weights, PERIOD))
            else:
                from wbc_baselines.ik.daqp_ik import DaqpIK

                solver = DaqpIK(robot, config.weights, PERIOD)
        except ImportError as error:
            raise ControllerError(missing_extra(f"controller '{name}'", "ik", error)) from error
        return IKController(robot, solver, config, name)

    def variants(self) -> list[tuple[str, str]]:
        """Return every variant with its description."""
        return [(variant, DESCRIPTIONS[variant]) for variant in VARIANTS]


make = IK()
