"""How a controller is found: installed names, a user's module or file, and what is said of the others."""

import sys
from pathlib import Path

import pytest

from wbc_bench.controller import DEPLOYABLE, SIGNALS
from wbc_bench.errors import ControllerError, UnknownNameError
from wbc_bench.installed import controllers
from wbc_bench.registry import load_controller
from wbc_bench.robot import Robot, load_robot

SOURCE = """
import numpy as np
from wbc_bench.controller import ControllerInfo, JointCommand

class Mine:
    def __init__(self, robot):
        self.robot = robot
        self.info = ControllerInfo("mine", frozenset({signals}), 0.02, __file__)

    def reset(self, episodes, obs, target):
        pass

    def act(self, obs, target):
        return JointCommand(np.tile(self.robot.default_q, (len(obs.active), 1)))

def silent(robot):
    return object()
"""


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A user's working folder with `my_ctrl.py`; imports are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    before = set(sys.modules)
    (tmp_path / "my_ctrl.py").write_text(SOURCE.format(signals={"ee_pose"}))
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_installed_by_name(robot: Robot) -> None:
    assert {"hold", "ik"} <= set(controllers())
    hold = load_controller("hold", robot)
    assert hold.info.name == "hold" and hold.info.signals == frozenset()


@pytest.mark.parametrize(("spec", "near"), [("hodl", "hold"), ("holdd", "hold"), ("hodl:fast", "hold")])
def test_a_slip_is_answered_with_the_nearest_name(folder: Path, robot: Robot, spec: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=rf"unknown controller '.*did you mean {near}\? valid: .*hold"):
        load_controller(spec, robot)


def test_unknown_variant(robot: Robot) -> None:
    with pytest.raises(UnknownNameError, match="unknown variant of hold 'fast'"):
        load_controller("hold:fast", robot)


@pytest.mark.parametrize("spec", ["my_ctrl:Mine", "my_ctrl.py:Mine", "./my_ctrl.py:Mine"])
def test_a_users_own(folder: Path, robot: Robot, spec: str) -> None:
    controller = load_controller(spec, robot)
    assert controller.info.name == "mine" and controller.info.signals == {"ee_pose"}
    assert controller.robot is robot  # type: ignore[attr-defined]


def test_a_file_elsewhere(folder: Path, robot: Robot) -> None:
    path = folder / "deep" / "down" / "their_ctrl.py"
    path.parent.mkdir(parents=True)
    path.write_text("import helper_beside\n" + SOURCE.format(signals=set()))
    (path.parent / "helper_beside.py").write_text("")
    assert load_controller(f"{path}:Mine", robot).info.source == str(path)


def test_two_files_of_one_name_are_not_confused(folder: Path, robot: Robot) -> None:
    load_controller("my_ctrl.py:Mine", robot)
    other = folder / "other" / "my_ctrl.py"
    other.parent.mkdir()
    other.write_text(SOURCE.format(signals=set()))
    with pytest.raises(
        ControllerError, match=r"other/my_ctrl.py': the name 'my_ctrl' belongs to .*my_ctrl.py"
    ):
        load_controller(f"{other}:Mine", robot)
    (folder / "json.py").write_text(SOURCE.format(signals=set()))
    with pytest.raises(ControllerError, match="the name 'json' belongs to"):
        load_controller("json.py:Mine", robot)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("my_ctrl:Yours", "controller 'my_ctrl:Yours': module has no 'Yours'"),
        ("my_ctrl.py:Yours", "module has no 'Yours'"),
        ("my_ctrl:silent", "controller 'my_ctrl:silent' has no `info`"),
        ("absent.py:Mine", "controller file 'absent.py' does not exist"),
        ("absent:Mine", "unknown controller 'absent'"),
        ("json.absent:Mine", "cannot be imported: No module named 'json.absent'"),
    ],
)
def test_what_cannot_be_loaded(folder: Path, robot: Robot, spec: str, message: str) -> None:
    with pytest.raises((ControllerError, UnknownNameError), match=message) as caught:
        load_controller(spec, robot)
    assert "\n" not in str(caught.value)


def test_a_missing_library_is_named(folder: Path, robot: Robot) -> None:
    (folder / "greedy.py").write_text("import no_such_library\n")
    with pytest.raises(ControllerError, match=r"'greedy:Mine' cannot be imported: .*no_such_library"):
        load_controller("greedy:Mine", robot)


def test_a_bug_in_the_module_is_not_a_missing_attribute(folder: Path, robot: Robot) -> None:
    (folder / "buggy.py").write_text("import math\nmath.tau.nonsense\n")
    with pytest.raises(ControllerError, match=r"AttributeError: .*nonsense.* \(buggy.py:2"):
        load_controller("buggy:Mine", robot)


def test_signals_that_do_not_exist(folder: Path, robot: Robot) -> None:
    (folder / "wishful.py").write_text(SOURCE.format(signals={"ee_pos"}))
    with pytest.raises(
        UnknownNameError, match=r"unknown signal 'ee_pos' .*wishful:Mine.*did you mean ee_pose"
    ):
        load_controller("wishful:Mine", robot)


def test_deployable_signals_exist() -> None:
    assert set(SIGNALS) > DEPLOYABLE == {"proprioception", "ee_pose"}
