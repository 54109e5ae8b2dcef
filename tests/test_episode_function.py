"""Controllers of a function of one episode, arguments in a spec, and answers to a user's mistakes."""

from pathlib import Path

import numpy as np
import pytest

import wbc_bench
from tiny_protocol import write_tiny
from user_controllers import CONTROLLER
from wbc_bench.errors import BenchError, ControllerError, UnknownNameError
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot

WHOLE = """
import numpy as np
from wbc_bench import ControllerInfo, JointCommand

class Whole:
    def __init__(self, robot, gain=0.1, name="whole", high=False):
        self.robot, self.gain = robot, gain
        self.info = ControllerInfo(name, frozenset({"proprioception"}), 0.02, __file__)
        assert isinstance(gain, float) and isinstance(high, bool)

    def reset(self, episodes, obs, target):
        self.sum = np.zeros((len(episodes), 14))

    def act(self, obs, target):
        self.sum += obs.proprioception.joint_vel
        return JointCommand(self.robot.default_q + self.gain * target.pos_b[:, :1] + 0.001 * self.sum)
"""
ONE = """
from wbc_bench import JointCommand, per_episode

@per_episode(signals={"proprioception"}, name="one")
class One:
    def __init__(self, robot, gain=0.1):
        self.robot, self.gain, self.sum = robot, gain, 0.0

    def __call__(self, obs, target):
        self.sum = self.sum + obs.proprioception.joint_vel
        assert obs.proprioception.gravity_b.shape == (3,) and target.rot_b.shape == (3, 3)
        return self.robot.default_q + self.gain * target.pos_b[0] + 0.001 * self.sum

@per_episode
def still(robot, obs, target):
    return robot.default_q

@per_episode(commands={"kp"})
def soft(robot, obs, target):
    return JointCommand(robot.default_q, kp=0.5 * robot.kp)

@per_episode
def short(robot, obs, target):
    return robot.default_q[:7]

@per_episode
def nothing(robot, obs, target):
    pass
"""


def written(folder: Path, name: str, text: str) -> str:
    (folder / f"{name}.py").write_text(text)
    return str(folder / f"{name}.py")


def test_a_function_of_one_episode_is_the_batched_controller(tmp_path: Path) -> None:
    protocol = str(write_tiny(tmp_path, replicates=1))
    whole, one = written(tmp_path, "whole_ctrl", WHOLE), written(tmp_path, "one_ctrl", ONE)
    a = wbc_bench.evaluate(f"{whole}:Whole", protocol, out=tmp_path / "out")
    b = wbc_bench.evaluate(f"{one}:One", protocol, out=tmp_path / "out")
    for name in ("steps", "position_error", "action_variation"):
        np.testing.assert_allclose(a.episodes[name], b.episodes[name], rtol=1e-9)
    assert b.records[0].controller_name == "one" and "| one | 6/6 |" in str(b)
    other = wbc_bench.evaluate(f"{one}:One?gain=0.3", protocol, out=tmp_path / "out")
    assert np.all(other.episodes["position_error"] != b.episodes["position_error"])
    assert (tmp_path / "out" / "runs" / "tiny").is_dir()
    soft = wbc_bench.evaluate(f"{one}:soft", protocol)
    assert soft.records[0].commands == ["kp"]


def test_a_wrapped_function_travels_as_an_object(tmp_path: Path) -> None:
    made = wbc_bench.per_episode(lambda robot, obs, target: robot.default_q, signals=(), name="lambda")
    protocol = str(write_tiny(tmp_path, replicates=1))
    results = wbc_bench.evaluate(made, protocol)
    np.testing.assert_array_equal(
        results.episodes["position_error"], wbc_bench.evaluate("hold", protocol).episodes["position_error"]
    )
    instance = wbc_bench.evaluate(made(load_robot()), protocol)
    np.testing.assert_array_equal(results.episodes["duration"], instance.episodes["duration"])


def test_arguments_of_a_class(tmp_path: Path) -> None:
    spec = f"{written(tmp_path, 'args_ctrl', WHOLE)}:Whole"
    controller = load_controller(f"{spec}?gain=0.25&name=mine&high=true", load_robot())
    assert controller.info.name == "mine" and controller.gain == 0.25  # type: ignore[attr-defined]
    with pytest.raises(UnknownNameError, match=r"unknown argument 'gian' .*did you mean gain\?"):
        load_controller(f"{spec}?gian=1.0", load_robot())
    with pytest.raises(ControllerError, match=r"argument 'gain', valid: key=value"):
        load_controller(f"{spec}?gain", load_robot())
    with pytest.raises(ControllerError, match=r"argument 'gain' is given twice"):
        load_controller(f"{spec}?gain=1.0&gain=2.0", load_robot())
    with pytest.raises(ControllerError, match=r"cannot be made: AssertionError"):
        load_controller(f"{spec}?gain=much", load_robot())


MISTAKES = {
    "return q": r"returned ndarray from `act`, valid: .*JointCommand; return JointCommand\(q\)",
    "return": r"returned NoneType from `act`, valid: .*JointCommand; is a `return` missing\?",
    "obs.ee_pose.pos_b": r"`pos_b` is of that signal: declare .*{'ee_pose', 'proprioception'}\)",
    "obs.privileged.friction": r"`friction` is of that signal: declare .*'privileged', 'proprioception'",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_line_with_the_fix(tmp_path: Path, line: str) -> None:
    name = f"mistake_{list(MISTAKES).index(line)}"
    spec = written(tmp_path, name, CONTROLLER.format(body=f"        {line}\n"))
    with pytest.raises(ControllerError, match=MISTAKES[line]) as caught:
        wbc_bench.evaluate(f"{spec}:Mine", str(write_tiny(tmp_path)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "short",
            r"'short' returned positions of shape \(7,\) for one episode, valid: .*\(14,\)",
        ),
        ("nothing", r"'nothing' returned positions of NoneType for one episode"),
    ],
)
def test_a_function_that_returns_something_else(tmp_path: Path, name: str, said: str) -> None:
    spec = written(tmp_path, f"{name}_ctrl", ONE)
    with pytest.raises(BenchError, match=said):
        wbc_bench.evaluate(f"{spec}:{name}", str(write_tiny(tmp_path)))
