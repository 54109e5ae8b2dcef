"""The observers of the IK controller against robots whose payload and gains are known."""

import numpy as np
import pinocchio as pin
import pytest

from wbc_baselines.ik import make
from wbc_baselines.ik.config import TUNED
from wbc_baselines.ik.controller import ARM, PERIOD
from wbc_baselines.ik.load import GainObserver, Payload
from wbc_baselines.ik.model import WholeBodyModel, configuration
from wbc_bench.robot import RobotConfig, load_robot

ROBOT = load_robot(RobotConfig(variant="paper"))
MODEL = WholeBodyModel(ROBOT)


def tilted() -> np.ndarray:
    """A configuration (21,) that is not symmetric, its base turned."""
    joints = ROBOT.default_q + np.random.default_rng(3).uniform(-0.2, 0.2, 14)
    return configuration(np.array([0.1, -0.2, 0.8]), pin.exp3(np.array([0.05, -0.1, 0.3])), joints)


def test_the_payload_is_what_the_arm_carries_beyond_its_own_weight():
    """Torques of a second model, whose hand is heavier by a point mass, in a noise of 0.8 N m."""
    mass, q, rng = 0.7, tilted(), np.random.default_rng(0)
    loaded = WholeBodyModel(ROBOT)
    frame = loaded.model.frames[loaded.tcp]
    point = pin.Inertia(mass, np.zeros(3), np.zeros((3, 3)))
    loaded.model.appendBodyToJoint(frame.parentJoint, point, frame.placement)
    loaded.data = loaded.model.createData()
    MODEL.update(q)
    own, hand = MODEL.gravity_torques(q)[6:], MODEL.jacobian(MODEL.tcp)[:, 14:]
    with_load = loaded.gravity_torques(q)[6:]
    payload, seen, lift = Payload(np.zeros(2), np.zeros(2)), np.array([True, False]), np.tile(hand[2], (2, 1))
    for _ in range(300):
        noise = rng.uniform(-0.8, 0.8, (2, 6))
        payload.update(TUNED, PERIOD, seen, lift, with_load[ARM] - own[ARM] + noise)
    assert payload.mass[0] == pytest.approx(mass, abs=0.03)
    assert payload.mass[1] == 0.0  # the second robot was not observed
    for _ in range(300):
        payload.update(TUNED, PERIOD, seen, lift, np.zeros((2, 6)))
    assert payload.mass[0] == pytest.approx(0.0, abs=0.15)  # the load was put down 6 s ago


def test_an_arm_that_hangs_shows_no_payload():
    payload = Payload(np.zeros(1), np.zeros(1))
    payload.update(TUNED, PERIOD, np.ones(1, dtype=bool), np.zeros((1, 6)), np.full((1, 6), 0.5))
    assert payload.mass == 0.0


def test_gains_are_found_in_noise_and_stay_nominal_where_nothing_shows_them():
    rng, count, s = np.random.default_rng(1), 40, TUNED
    factor = rng.uniform(0.9, 1.1, (count, 14))
    observer = GainObserver(PERIOD, s, ROBOT.kp, ROBOT.kd, ROBOT.effort)
    observer.reset(count)
    pos = np.tile(ROBOT.default_q, (count, 1))
    asked = np.where(np.arange(14) < 10, 8.0, 0.0)  # [N m] the last four joints carry nothing
    for _ in range(250):
        command = pos + asked / ROBOT.kp
        torque = factor * asked + rng.uniform(-0.8, 0.8, (count, 14))
        seen = pos + rng.uniform(-0.003, 0.003, pos.shape)  # what the filter leaves
        observer.update(command, seen, np.zeros_like(pos), torque)
    error = observer.factor - factor
    assert np.abs(error[:, :10]).max() < 0.03
    assert np.abs(observer.factor[:, 10:] - 1).max() < 0.05


def test_a_saturated_drive_does_not_change_its_gain():
    observer = GainObserver(PERIOD, TUNED, ROBOT.kp, ROBOT.kd, ROBOT.effort)
    observer.reset(1)
    far = ROBOT.default_q[None] + 10.0
    for _ in range(100):
        observer.update(far, ROBOT.default_q[None], np.zeros((1, 14)), ROBOT.effort[None])
    assert observer.factor == pytest.approx(np.ones((1, 14)))


def test_the_first_robot_has_no_observers_and_the_papers_has():
    for variant, observes in (("limx_adapter", False), ("paper", True)):
        controller = make(load_robot(RobotConfig(variant=variant)))
        assert controller._s.observe_torques is observes
