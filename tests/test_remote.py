"""Policies in another process: equal bits, and one line or a named outcome for those that do not behave."""

import runpy
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

import wbc_bench
from tiny_protocol import write_tiny
from wbc_bench.controller import ControllerInfo, JointCommand, Observation, Target
from wbc_bench.errors import BenchError, ControllerError
from wbc_bench.registry import load_controller
from wbc_bench.robot import Robot, load_robot


def serve(socket: zmq.Socket) -> None:
    """The loop of the example, which is a script and no module of a package."""
    runpy.run_path(str(Path(__file__).parents[1] / "examples" / "remote_policy.py"))["serve"](socket)


class Here:
    """The policy of the example, in this process."""

    def __init__(self, robot: Robot) -> None:
        self.default_q = robot.default_q
        self.info = ControllerInfo("here", frozenset({"ee_pose"}), 0.02, "tests")

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None:
        pass

    def act(self, obs: Observation, target: Target) -> JointCommand:
        assert obs.ee_pose
        q = np.tile(self.default_q, (len(obs.active), 1))
        q[:, 8] += np.arctan2(target.pos_b[:, 1], target.pos_b[:, 0]) + 0.1 * obs.ee_pose.pos_b[:, 0]
        return JointCommand(q)


@contextmanager
def served(loop: Callable[[zmq.Socket], None]) -> Iterator[str]:
    """A policy that answers in a thread; its address."""
    context = zmq.Context()
    socket = context.socket(zmq.REP)
    socket.setsockopt(zmq.LINGER, 0)
    port = socket.bind_to_random_port("tcp://127.0.0.1")

    def run() -> None:
        try:
            loop(socket)
        except zmq.ContextTerminated:
            pass
        finally:
            socket.close()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{port}"
    finally:
        context.term()
        thread.join(10)


def test_equal_bits_to_the_same_code_in_process(tmp_path: Path) -> None:
    protocol = str(write_tiny(tmp_path, replicates=1))
    here = wbc_bench.evaluate(Here, protocol)
    with served(serve) as address:
        there = wbc_bench.evaluate(f"remote:{address}", protocol)
    assert there.records[0].episodes_sha256 != "" and there.records[0].controller_name == "remote_lean"
    for name in ("steps", "position_error", "orientation_error", "action_variation", "energy", "outcome"):
        np.testing.assert_array_equal(there.episodes[name], here.episodes[name], err_msg=name)


def answering(act: Callable[[dict], bytes], **info: object) -> Callable[[zmq.Socket], None]:
    """A policy with an `act` of its own."""
    hello = {"name": "odd", "signals": [], "control_period": 0.02} | info

    def loop(socket: zmq.Socket) -> None:
        while True:
            asked = msgspec.msgpack.decode(socket.recv())
            answer = {"hello": hello, "reset": {}}.get(asked["type"])
            data = act(asked) if answer is None else msgspec.msgpack.encode(answer)
            socket.send(data)

    return loop


def command(shape: list[int], size: int = 6 * 14, dtype: str = "<f8") -> Callable[[dict], bytes]:
    packed = {"dtype": dtype, "shape": shape, "data": np.zeros(size).tobytes()}
    return lambda asked: msgspec.msgpack.encode({"q": packed})


def test_a_silent_policy_ends_its_episodes_with_a_named_outcome(tmp_path: Path) -> None:
    release = threading.Event()

    def slow(asked: dict) -> bytes:
        if asked["time"] > 0.05:
            release.wait(30)
        return command([6, 14])(asked)

    with served(answering(slow)) as address:
        results = wbc_bench.evaluate(f"remote:{address}?timeout=0.2", str(write_tiny(tmp_path, replicates=1)))
        release.set()
    assert set(results.episodes["outcome"]) == {"invalid"} and set(results.episodes["steps"]) == {3}


LIES = {
    "shape": (command([6, 13]), r"`q` has 84 numbers, its shape says \[6, 13\]"),
    "other shape": (command([14, 6]), r"returned commands of shape \(14, 6\), expected \(6, 14\)"),
    "negative": (command([-6, -14]), r"its shape says \[-6, -14\]"),
    "type": (command([6, 14], dtype="O"), "`q` of type 'O', valid: <f8, <f4, |b1"),
    "text": (lambda asked: b"\xff\xfe", "answered `act` with something else"),
    "nothing": (lambda asked: msgspec.msgpack.encode({}), "answered `act` .*missing required field `q`"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_policy_that_lies_is_one_line(tmp_path: Path, lie: str) -> None:
    act, said = LIES[lie]
    protocol = str(write_tiny(tmp_path, replicates=1))
    with served(answering(act)) as address, pytest.raises(ControllerError, match=said) as caught:
        wbc_bench.evaluate(f"remote:{address}", protocol)
    assert "\n" not in str(caught.value)


def test_an_odd_hello_or_address_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot()
    with (
        served(answering(command([6, 14]), signals=["sight"])) as address,
        pytest.raises(BenchError, match="unknown signal 'sight'"),
    ):
        load_controller(f"remote:{address}", robot)
    for variant in ("5605", "tcp://127.0.0.1:5605?wait=1", "tcp://127.0.0.1:5605?timeout=0"):
        with pytest.raises(ControllerError, match=r"valid: remote:tcp://127.0.0.1:PORT"):
            load_controller(f"remote:{variant}", robot)
    monkeypatch.setattr("wbc_bench.remote.HELLO_TIMEOUT", 0.1)
    with pytest.raises(ControllerError, match=r"no answer within 0.1 s"):
        load_controller("remote:tcp://127.0.0.1:9", robot)
