"""`decoupled`: the base walks, the arm reaches, and neither knows of the other.

The composite that whole-body controllers are compared with. A follower chooses where to stand and asks for
the base's velocity; the legs of a trained policy of the bench walk; `ik:arm` moves the arm.

The policy was trained for targets of the hand, not for velocities. It walks because its target is kept ahead
of where its hand is, like a carrot: where the base's velocity would take the hand within `LOOKAHEAD`. At a
velocity of zero the target is the hand itself, wherever the arm has taken it, and the policy only balances.
"""

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.ik.arm_only import ArmController
from wbc_baselines.learned import make as learned
from wbc_bench.controller import Controller, JointCommand, Observation, ProtocolAware, Target
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.policies.follower import Follower
from wbc_bench.robot import NUM_LEG_JOINTS, Robot
from wbc_bench.rotations import heading_from_gravity, matrix_from_rho6, yaw_matrix

Array = NDArray[np.float64]
DEFAULT = "transformer_gru@0"
LOOKAHEAD = 0.5  # [s]; choice: the policy steps for a carrot of 0.1 m and runs for one of 0.3 m
GAIN, LIMITS, TOLERANCE = 1.0, (0.2, 0.2, 0.4), (0.05, 0.1)  # of the follower; choice


class DecoupledController:
    """Legs of a policy, the arm by its inverse kinematics."""

    def __init__(self, robot: Robot, policy: Controller, name: str) -> None:
        self._policy, self._arm = policy, ArmController(robot)
        self._follower = Follower(robot, GAIN, LIMITS, TOLERANCE)
        signals = policy.info.signals | self._arm.info.signals | {"ee_pose"}
        self.checkpoint_sha256 = getattr(policy, "checkpoint_sha256", None)
        self.info = policy.info._replace(name=name, signals=signals, source="wbc_baselines.decoupled")

    def prepare(self, protocol: EvalProtocol) -> None:
        """Hand the protocol to the policy."""
        if isinstance(self._policy, ProtocolAware):
            self._policy.prepare(protocol)

    def reset(self, episodes: NDArray[np.int64], obs: Observation, target: Target) -> None:
        """Choose where to stand."""
        heading = _heading(obs)
        self._follower.start(_turned(heading, target.pos_b), heading @ target.rot_b)
        self._policy.reset(episodes, obs, self.carrot(obs, target))
        self._arm.reset(episodes, obs, target)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        """Legs of the policy, the arm of `ik:arm`, (N, 14) [rad]."""
        command = self._policy.act(obs, self.carrot(obs, target))
        q = np.array(command.q)
        q[:, NUM_LEG_JOINTS:] = self._arm.act(obs, target).q[:, NUM_LEG_JOINTS:]
        return command._replace(q=q)

    def carrot(self, obs: Observation, target: Target) -> Target:
        """The hand's pose, moved as the base would move within LOOKAHEAD at the follower's velocity."""
        assert obs.ee_pose is not None  # declared
        heading = _heading(obs)
        velocity = self._follower.command(_turned(heading, target.pos_b), heading @ target.rot_b)
        moved = LOOKAHEAD * velocity
        turn = yaw_matrix(moved[:, 2])
        pos = _turned(turn, _turned(heading, obs.ee_pose.pos_b)) + moved * np.array([1.0, 1.0, 0.0])
        back = np.swapaxes(heading, 1, 2)
        return Target(_turned(back, pos), back @ turn @ heading @ matrix_from_rho6(obs.ee_pose.rot6_b))


class Decoupled:
    """The entry point; a variant is one of `learned`."""

    def __call__(self, robot: Robot, variant: str = "") -> Controller:
        """Create the controller. Raises: UnknownNameError, ControllerError, see `Learned`."""
        policy = learned(robot, variant or DEFAULT)
        return DecoupledController(robot, policy, f"decoupled:{variant}" if variant else "decoupled")

    def variant_for(self, variant: str, replicate: int) -> str:
        """As for the policy; `decoupled` alone walks by one policy whatever the replicate."""
        return learned.variant_for(variant, replicate) if variant else ""

    def variants(self) -> list[tuple[str, str]]:
        """Return the forms of a variant, with their descriptions."""
        return [
            ("", f"The legs of learned:{DEFAULT} walk where a follower says, the arm's IK reaches."),
            ("METHOD@SEED", "The same with the legs of that learned controller."),
        ]


def _heading(obs: Observation) -> Array:
    assert obs.proprioception is not None  # declared
    return heading_from_gravity(obs.proprioception.gravity_b)


def _turned(rot: Array, vectors: Array) -> Array:
    return np.einsum("nij,nj->ni", rot, vectors)


make = Decoupled()
