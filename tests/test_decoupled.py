"""`decoupled`: legs of a policy that is led by a carrot, the arm of `ik:arm`."""

import numpy as np
import pytest
from conftest import CalmRows

from wbc_baselines.decoupled import LIMITS, LOOKAHEAD, DecoupledController, make
from wbc_baselines.ik.arm_only import ArmController
from wbc_bench.controller import JointCommand, Observation, Target
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot
from wbc_bench.rotations import geodesic_angle, matrix_from_rho6

ROBOT = load_robot()


class Remembered:
    """Stands with one command and remembers what targets it was led by."""

    def __init__(self) -> None:
        self.info = load_controller("learned:transformer_gru@0", ROBOT).info
        self.carrots: list[Target] = []
        self.hands: list[np.ndarray] = []

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None:
        pass

    def act(self, obs: Observation, target: Target) -> JointCommand:
        assert obs.ee_pose is not None
        self.carrots.append(target)
        self.hands.append(obs.ee_pose.pos_b)
        assert geodesic_angle(target.rot_b, matrix_from_rho6(obs.ee_pose.rot6_b)).max() < LOOKAHEAD * 0.5
        return JointCommand(np.full((len(obs.active), 14), 0.01))


def test_legs_of_the_policy_and_the_arm_of_the_arm(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    policy, arm = Remembered(), ArmController(ROBOT)
    both = DecoupledController(ROBOT, policy, "decoupled")
    loop = ControlLoop(both, smoke, calm_rows(3))
    target = loop.sensors.target(loop.odometry)
    loop.reset(target)
    arm.reset(np.arange(3), loop.observation, target)
    for _ in range(5):
        expected = arm.act(loop.observation, target).q[:, 8:]
        moved = loop.advance(target).q
        np.testing.assert_array_equal(moved[:, :8], 0.01)
        np.testing.assert_array_equal(moved[:, 8:], expected)
        target = loop.sensors.target(loop.odometry, loop.step)
    ahead = [np.linalg.norm(c.pos_b - h, axis=1) for c, h in zip(policy.carrots, policy.hands, strict=True)]
    assert np.max(ahead) < LOOKAHEAD * (np.hypot(*LIMITS[:2]) + LIMITS[2])
    assert both.info.signals == {"proprioception", "ee_pose"}


@pytest.mark.filterwarnings("ignore:.*not trained on")
def test_it_reaches_what_the_arm_alone_reaches() -> None:
    protocol, path = find_protocol("nominal_v1")
    rows, _ = read_manifest(protocol, manifest_path(path))
    chosen = rows.take(np.flatnonzero(rows.stratum == "arm")[:6])
    outcomes = rollout(make(ROBOT), protocol, chosen).outcome
    assert (outcomes == "success").sum() >= 5, outcomes


def test_variants_are_those_of_learned() -> None:
    assert make(ROBOT).info.name == "decoupled"
    assert make(ROBOT, "no_latent@0").info.name == "decoupled:no_latent@0"
    assert (make.variant_for("", 2), make.variant_for("no_latent", 2)) == ("", "no_latent@2")
    with pytest.raises(BenchError, match="no_latnt"):
        make(ROBOT, "no_latnt@0")
