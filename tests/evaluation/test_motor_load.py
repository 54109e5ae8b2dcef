"""The load of motors against sums by hand, and slip against a sole that is dragged."""

import msgspec
import numpy as np
import pytest
from conftest import CalmRows

from wbc_bench.episodes.protocol import EvalProtocol, Physics
from wbc_bench.evaluation.motor_load import LoadMeter
from wbc_bench.evaluation.rollout import LOADED, _slip
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.robot import load_robot

PHYSICS = Physics(timestep=0.002, decimation=3)


def test_a_sample_counts_positive_power_and_limits_of_those_that_moved():
    robot = load_robot()
    meter = LoadMeter(robot, np.array([1.0, 0.5, 1.0]), PHYSICS)
    torque, speed = np.zeros((2, 3, 14))
    torque[:, 0], torque[:, 1] = 0.6 * robot.effort[0], 2.0
    speed[:, 0], speed[:, 1] = -1.0, 0.5  # the first joint takes power back: it does not count
    speed[0, 5] = robot.velocity[5]
    meter.begin()
    meter.sample(torque, speed, np.array([True, True, False]))
    assert meter.load.work == pytest.approx([1.0 * 0.006, 1.0 * 0.006, 0.0])
    assert meter.load.at_torque_limit.tolist() == [False, True, False]  # the second has half of its strength
    assert meter.load.at_speed_limit.tolist() == [True, False, False]


def test_every_physics_step_of_a_period_is_sampled_in_turn():
    meter = LoadMeter(load_robot(), np.ones(1), PHYSICS)
    due = []
    for _ in range(7):
        meter.begin()
        due.append(meter.due)
    assert due == [1, 2, 3, 1, 2, 3, 1]


def test_work_is_torque_times_way(smoke: EvalProtocol, calm_rows: CalmRows):
    """With one physics step per control step every step is sampled, and speed times step is the way."""
    protocol = msgspec.structs.replace(smoke, physics=Physics(timestep=0.002, decimation=1))
    simulation = Simulation(protocol, calm_rows(2))
    rng, active = np.random.default_rng(0), np.ones(2, dtype=bool)
    before = simulation.state()
    for _ in range(20):
        state = simulation.step(simulation.robot.default_q + rng.uniform(-0.3, 0.3, (2, 14)), active)
        way = state.joint_pos - before.joint_pos
        assert simulation.load.work == pytest.approx(np.maximum(simulation._torque * way, 0).sum(axis=1))
        assert (simulation.load.work > 0).all()
        before = state


def test_slip_is_the_horizontal_way_of_loaded_soles(smoke: EvalProtocol, calm_rows: CalmRows):
    state = Simulation(smoke, calm_rows(3)).state()
    force = np.zeros((3, 2, 3))
    force[:, :, 2] = LOADED + 1
    before = state._replace(foot_force_w=force)
    lifted = force.copy()
    lifted[1, 0, 2] = LOADED - 1
    moved = before.foot_pos_w + np.array([0.03, 0.04, 0.5])
    moved[2] = before.foot_pos_w[2]
    assert _slip(before, before._replace(foot_pos_w=moved, foot_force_w=lifted)) == pytest.approx(
        [0.1, 0.05, 0]
    )
