"""The variants' motors: torque by speed, and the PD loop inside of it."""

import mujoco
import numpy as np
import pytest

from wbc_bench.robot import Robot, RobotConfig, load_robot

PAPER = load_robot(RobotConfig(variant="paper"))


def torque(robot: Robot, model: mujoco.MjModel, pos: np.ndarray, vel: np.ndarray, command: np.ndarray):
    data = mujoco.MjData(model)
    data.qpos[7:], data.qvel[6:], data.ctrl[:] = pos, vel, command
    mujoco.mj_forward(model, data)
    return data.actuator_force.copy()


def test_torque_is_pd_within_the_limit_and_the_speed_torque_curve() -> None:
    """Written out anew: in both directions, driving and braking, far beyond the limits too."""
    motor = PAPER.facts.variant.motor
    assert motor is not None
    model, rng = PAPER.model(), np.random.default_rng(0)
    speed, limit = PAPER.velocity, PAPER.effort
    seen = set()
    for _ in range(300):
        pos, vel = rng.uniform(PAPER.lower, PAPER.upper), rng.uniform(-1.5, 1.5, 14) * speed
        command = pos + rng.normal(size=14) * limit / PAPER.kp
        wanted = PAPER.kp * (command - pos) - PAPER.kd * vel
        high = np.minimum(limit, motor.stall * limit * (1 - vel / speed))
        low = np.maximum(-limit, -motor.stall * limit * (1 + vel / speed))
        expected = np.minimum(np.maximum(wanted, np.maximum(low, -limit)), np.maximum(high, -limit))
        expected = np.clip(expected, -limit, limit)
        np.testing.assert_allclose(torque(PAPER, model, pos, vel, command), expected, atol=1e-9)
        seen |= {"free"} if (expected == wanted).any() else set()
        seen |= {"curve"} if ((np.abs(expected) < limit - 1e-9) & (expected != wanted)).any() else set()
        seen |= {"limit"} if (np.abs(expected) == limit).any() else set()
    assert seen == {"free", "curve", "limit"}


def test_a_slow_motor_is_the_position_actuator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Away from its limits the motor's internal controller is the PD loop of the other variant, in motion."""
    import msgspec

    from wbc_bench.robot import build_spec

    def model_with(motor) -> mujoco.MjModel:
        variant = msgspec.structs.replace(PAPER.facts.variant, motor=motor)
        return build_spec(msgspec.structs.replace(PAPER.facts, variant=variant), PAPER.config).compile()

    paths = []
    for model in (model_with(PAPER.facts.variant.motor), model_with(None)):
        data = mujoco.MjData(model)
        data.qpos[2], data.qpos[7:] = 2.0, PAPER.default_q  # in the air
        path = []
        for step in range(200):
            data.ctrl[:] = PAPER.default_q + 0.05 * np.sin(0.02 * step)
            mujoco.mj_step(model, data)
            path.append(data.qpos.copy())
        paths.append(np.array(path))
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-9)
    assert np.abs(paths[0][-1, 7:] - PAPER.default_q).max() > 0.01


def test_ankles_do_not_pass_their_speed_limit_under_their_own_torque() -> None:
    """In the air, commanded from one end of the range to the other: without the curve 15 rad/s are passed."""
    import msgspec

    from wbc_bench.robot import build_spec

    def fastest(motor) -> np.ndarray:
        variant = msgspec.structs.replace(PAPER.facts.variant, motor=motor)
        facts = msgspec.structs.replace(PAPER.facts, variant=variant)
        spec = build_spec(facts, PAPER.config)
        spec.option.gravity = [0, 0, 0]
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[2], data.qpos[7:] = 2.0, PAPER.default_q
        ankles = [3, 7]
        speeds = []
        for step in range(300):
            data.ctrl[:] = PAPER.default_q
            data.ctrl[ankles] = 3.0 if step % 100 < 50 else -3.0
            mujoco.mj_step(model, data)
            speeds.append(np.abs(data.qvel[6:][ankles]).max())
        return np.max(speeds)

    limit = PAPER.velocity[3]
    assert fastest(None) > 1.5 * limit
    assert fastest(PAPER.facts.variant.motor) < 1.1 * limit
