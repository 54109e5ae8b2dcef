"""Commands that carry gains, velocities and torques: what the motors do, how late, and how it is counted."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import CalmRows

import wbc_bench
from tiny_protocol import write_tiny
from user_controllers import write_controller
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError, ControllerError
from wbc_bench.evaluation.drives import Drive, equivalent_position
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.results import metrics
from wbc_bench.robot import Robot, RobotConfig, load_robot

VARIANTS = ("limx_adapter", "paper")


class Driver:
    """A controller of a function of (step, joint positions): what to put into the command."""

    def __init__(self, command: Callable[[int, int], JointCommand], *parts) -> None:
        self.info = ControllerInfo("driver", frozenset(), 0.02, "tests", commands=frozenset(parts))
        self._command = command

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None:
        self.calls = 0

    def act(self, obs: Observation, target: Target) -> JointCommand:
        self.calls += 1
        return self._command(self.calls - 1, len(obs.active))


@pytest.fixture(params=VARIANTS)
def protocol(request: pytest.FixtureRequest, smoke: EvalProtocol) -> EvalProtocol:
    """Half a second with one variant of the robot."""
    episodes = msgspec.structs.replace(smoke.episodes, horizon=0.5)
    success = msgspec.structs.replace(smoke.success, window=0.1)
    robot = RobotConfig(variant=request.param)
    return msgspec.structs.replace(smoke, episodes=episodes, success=success, robot=robot)


@pytest.fixture(scope="module")
def disturbed(smoke: EvalProtocol) -> EpisodeManifest:
    return read_manifest(smoke, manifest_path(find_protocol("smoke_v1")[1]))[0].take(slice(0, 4))


def drive(robot: Robot, count: int, **parts: np.ndarray | float) -> Drive:
    values = {"kp": robot.kp, "kd": robot.kd, "qd": 0.0, "torque": 0.0} | parts
    return Drive(**{name: np.broadcast_to(value, (count, 14)).copy() for name, value in values.items()})


def limits(robot: Robot, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest torque at a speed, written out anew; see tests/robot/test_motor.py."""
    low, high = -robot.effort, robot.effort
    if robot.facts.variant.motor is not None:
        stall = robot.facts.variant.motor.stall * robot.effort
        high = np.clip(stall * (1 - speed / robot.velocity), low, high)
        low = np.clip(-stall * (1 + speed / robot.velocity), low, np.maximum(high, low))
    return np.broadcast_to(low, speed.shape), np.broadcast_to(high, speed.shape)


@pytest.mark.parametrize("zero_gain", [False, True])
def test_motors_exert_the_law_within_their_limits(
    protocol: EvalProtocol, disturbed: EpisodeManifest, zero_gain: bool
) -> None:
    """tau = kp k_p (q - p) + kd k_d (qd - v) + torque with the episode's factors k, sampled step by step."""
    robot, rng, count = load_robot(protocol.robot), np.random.default_rng(3), len(disturbed)
    physics = msgspec.structs.replace(protocol.physics, decimation=1)
    protocol = msgspec.structs.replace(protocol, physics=physics)
    simulation = Simulation(protocol, disturbed)
    everyone, reached = np.ones(count, dtype=bool), set()
    for _ in range(20):
        before = simulation.state()
        q = robot.default_q + rng.normal(0, 0.1, (count, 14))
        given = Drive(
            kp=np.zeros((count, 14)) if zero_gain else rng.uniform(0, 60, (count, 14)),
            kd=rng.uniform(0, 3, (count, 14)),
            qd=rng.normal(0, 1, (count, 14)),
            torque=rng.normal(0, 15, (count, 14)),
        )
        after = simulation.step(q, everyone, drive=given)
        kp, kd = given.kp * disturbed.kp_scale, given.kd * disturbed.kd_scale
        wanted = kp * (q - before.joint_pos) + kd * (given.qd - before.joint_vel) + given.torque
        low, high = limits(robot, before.joint_vel)
        expected = np.clip(wanted, low, high)
        np.testing.assert_allclose(after.joint_torque, expected, atol=1e-5)
        reached |= {"free"} if (expected == wanted).any() else set()
        reached |= {"limit"} if (expected != wanted).any() else set()
    assert reached == {"free", "limit"}


def test_the_variants_own_values_are_no_other_command(
    protocol: EvalProtocol, disturbed: EpisodeManifest
) -> None:
    """Bit for bit, whether they are written out, left out by one who may write them, or never mentioned."""
    robot = load_robot(protocol.robot)

    def q(step: int, count: int) -> np.ndarray:
        return np.tile(robot.default_q + 0.1 * np.sin(0.3 * step), (count, 1))

    def written(step: int, count: int) -> JointCommand:
        own = [np.tile(part, (count, 1)) for part in (robot.kp, robot.kd)]
        return JointCommand(q(step, count), None, *own, *np.zeros((2, count, 14)))

    def sometimes(step: int, count: int) -> JointCommand:
        return written(step, count) if step % 3 == 1 else JointCommand(q(step, count))

    parts = ("kp", "kd", "qd", "torque")
    plain = rollout(Driver(lambda step, count: JointCommand(q(step, count))), protocol, disturbed)
    for other in (written, sometimes, lambda step, count: JointCommand(q(step, count))):
        batch = rollout(Driver(other, *parts), protocol, disturbed)
        for name in ("position_error", "ee_pos_w", "command", "work", "steps"):
            np.testing.assert_array_equal(getattr(batch, name), getattr(plain, name), err_msg=name)


def test_the_whole_command_is_late(protocol: EvalProtocol, calm_rows: CalmRows) -> None:
    """A torque given at control step 3 acts `delay` later and not before, to the physics step."""
    rows = calm_rows(3, command_delay=np.array([0.0, 0.006, 0.024]))
    robot, everyone = load_robot(protocol.robot), np.ones(3, dtype=bool)
    physics = msgspec.structs.replace(protocol.physics, decimation=1)  # 2 ms a control step
    simulation = Simulation(msgspec.structs.replace(protocol, physics=physics), rows)
    plain = Simulation(msgspec.structs.replace(protocol, physics=physics), rows)
    q, first = np.tile(robot.default_q, (3, 1)), {}
    for step in range(20):
        push = drive(robot, 3, torque=5.0, kp=0.9 * robot.kp) if step == 3 else None
        pushed = simulation.step(q, everyone, drive=push)
        before = plain.step(q, everyone)
        for row in np.flatnonzero((pushed.joint_torque != before.joint_torque).any(axis=1)):
            first.setdefault(int(row), step)
    assert first == {0: 3, 1: 6, 2: 15}


def test_equivalent_position_gives_the_same_torque() -> None:
    rng = np.random.default_rng(0)
    q, pos, vel = rng.normal(size=(3, 5, 14))
    given = Drive(*rng.uniform(0.1, 5, (2, 5, 14)), *rng.normal(size=(2, 5, 14)))
    same = equivalent_position(q, given)
    wanted = given.kp * (q - pos) + given.kd * (given.qd - vel) + given.torque
    np.testing.assert_allclose(given.kp * (same - pos) - given.kd * vel, wanted, atol=1e-12)
    assert np.isnan(equivalent_position(q, given._replace(kp=np.zeros((5, 14))))).all()


def test_metrics_are_of_the_own_action(protocol: EvalProtocol, calm_rows: CalmRows) -> None:
    """A torque that swings is no constant position, and an action of its own is counted in its own units."""
    robot, rows = load_robot(protocol.robot), calm_rows(2)

    def swinging(step: int, count: int) -> JointCommand:
        q, torque = np.tile(robot.default_q, (count, 1)), np.zeros((count, 14))
        torque[:, 8] = 0.2 * (-1) ** step  # [N m]
        return JointCommand(q, torque=torque)

    batch = rollout(Driver(swinging, "torque"), protocol, rows)
    assert batch.action.shape[2] == 28
    np.testing.assert_allclose(metrics.action_variation(batch), (0.4 / robot.effort[8]) ** 2)
    np.testing.assert_allclose(metrics.action_variation_rad(batch), (0.4 / robot.kp[8]) ** 2)

    def own(step: int, count: int) -> JointCommand:
        return swinging(step, count)._replace(action=np.full((count, 3), float(step % 2)))

    np.testing.assert_allclose(
        metrics.action_variation(rollout(Driver(own, "torque", "action"), protocol, rows)), 3.0
    )

    def soft(step: int, count: int) -> JointCommand:
        return swinging(step, count)._replace(kp=np.zeros((count, 14)))

    assert np.isnan(metrics.command_rate(rollout(Driver(soft, "torque", "kp"), protocol, rows))).all()


def test_a_part_that_is_not_a_number_ends_its_episode(protocol: EvalProtocol, calm_rows: CalmRows) -> None:
    robot = load_robot(protocol.robot)

    def odd(step: int, count: int) -> JointCommand:
        torque = np.zeros((count, 14))
        torque[1, 4] = np.nan if step == 5 else 0.0
        return JointCommand(np.tile(robot.default_q, (count, 1)), torque=torque)

    batch = rollout(Driver(odd, "torque"), protocol, calm_rows(2))
    assert batch.steps[1] == 5 and batch.outcome[1] == "invalid" and batch.steps[0] > 5


@pytest.mark.parametrize(
    ("declared", "parts", "said"),
    [
        ("", {"torque": (2, 14)}, r"returned `torque`, which its info does not declare, valid: .*commands="),
        ("kp", {"kp": (2, 7)}, r"returned `kp` of shape \(2, 7\), expected \(2, 14\)"),
        ("action", {}, "returned no `action`, valid: one with every command"),
        ("action", {"action": (2,)}, r"returned `action` of shape \(2,\)"),
    ],
)
def test_a_wrong_part_is_one_line(
    smoke: EvalProtocol, calm_rows: CalmRows, declared: str, parts: dict, said: str
) -> None:
    robot = load_robot(smoke.robot)
    arrays = {name: np.ones(shape) for name, shape in parts.items()}
    driver = Driver(
        lambda step, count: JointCommand(np.tile(robot.default_q, (count, 1)))._replace(**arrays),
        *declared.split(),
    )
    with pytest.raises(ControllerError, match=said) as caught:
        rollout(driver, smoke, calm_rows(2))
    assert "\n" not in str(caught.value)


def test_a_negative_gain_is_one_line(smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    q = np.tile(load_robot(smoke.robot).default_q, (2, 1))
    driver = Driver(lambda step, count: JointCommand(q, kd=-np.ones((2, 14))), "kd")
    with pytest.raises(ControllerError, match="a `kd` of -1 at control step 0, valid: 0 or more"):
        rollout(driver, smoke, calm_rows(2))


def test_record_and_table_say_what_is_commanded(tmp_path: Path) -> None:
    spec = write_controller(tmp_path, "soft_gains", "return JointCommand(q, kp=np.full(q.shape, 50.0))")
    path = Path(spec.removesuffix(":Mine"))
    path.write_text(path.read_text().replace('"a test")', '"a test", commands=frozenset({"kp"}))'))
    results = wbc_bench.evaluate(spec, str(write_tiny(tmp_path)))
    assert results.records[0].commands == ["kp"]
    text = str(results)
    assert "‡ |" in text and "‡ commands more than joint positions" in text and ": kp." in text
    plain = wbc_bench.evaluate("hold", str(tmp_path / "tiny.toml"))
    assert plain.records[0].commands == [] and "‡" not in str(plain)


def test_a_part_that_does_not_exist(tmp_path: Path) -> None:
    spec = write_controller(tmp_path, "odd_part")
    path = Path(spec.removesuffix(":Mine"))
    path.write_text(path.read_text().replace('"a test")', '"a test", commands=frozenset({"tau"}))'))
    with pytest.raises(BenchError, match=r"unknown part of a command 'tau' .*valid: action, kd, kp"):
        wbc_bench.evaluate(spec, str(write_tiny(tmp_path)))
