"""A card computes what hand-written code of the same policy computes; a wrong card is one line."""

from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import CalmRows
from onnx import helper

import wbc_bench
from small_networks import layer, recurrent, weights, write
from tiny_protocol import write_tiny
from wbc_bench.cli.main import main
from wbc_bench.controller import Controller, ControllerInfo, JointCommand, Observation, Signal, Target
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError, ControllerError
from wbc_bench.evaluation.control_loop import ControlLoop
from wbc_bench.policies.follower import Follower
from wbc_bench.registry import load_controller
from wbc_bench.robot import JOINT_NAMES, load_robot
from wbc_bench.rotations import heading_from_gravity

ROBOT = load_robot()
LEGS, ARM = JOINT_NAMES[:8], JOINT_NAMES[8:]
INTERLEAVED = (*(name for pair in zip(LEGS[:4], LEGS[4:], strict=True) for name in pair), *ARM)
SHUFFLED = tuple(np.array(JOINT_NAMES)[np.random.default_rng(1).permutation(14)].tolist())


class Both:
    """Drives with one controller and asks a second one the same."""

    def __init__(self, first: Controller, second: Controller) -> None:
        one, other = first.info, second.info
        self.info = one._replace(signals=one.signals | other.signals, commands=one.commands | other.commands)
        self._pair, self.steps, self.worst = (first, second), 0, 0.0

    def prepare(self, protocol: EvalProtocol) -> None:
        for one in self._pair:
            if hasattr(one, "prepare"):
                one.prepare(protocol)  # type: ignore[attr-defined]

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None:
        for one in self._pair:
            one.reset(episodes, obs, target)

    def act(self, obs: Observation, target: Target) -> JointCommand:
        first, second = (one.act(obs, target) for one in self._pair)
        self.steps += 1
        for name in ("q", "kp", "kd", "torque"):
            a, b = getattr(first, name), getattr(second, name)
            assert (a is None) == (b is None), name
            if a is not None:
                self.worst = max(self.worst, np.abs(a - b)[obs.active].max())
        return second


def together(
    first: Controller, second: Controller, protocol: EvalProtocol, steps: int, count: int = 4, least: int = 20
) -> float:
    """The largest difference of their commands over an episode with noise, pushes and random dynamics."""
    rows, _ = read_manifest(find_protocol("smoke_v1")[0], manifest_path(find_protocol("smoke_v1")[1]))
    episodes = msgspec.structs.replace(protocol.episodes, horizon=steps * protocol.control_period)
    both = Both(first, second)
    moved = [
        result.q
        for result in ControlLoop(
            both, msgspec.structs.replace(protocol, episodes=episodes), rows.take(slice(0, count))
        ).run()
    ]
    assert np.ptp(np.array(moved)[:, 0], axis=0).max() > 1e-3  # it does something
    assert both.steps >= least
    return both.worst


def test_a_policy_of_ones_own_without_its_card(own_policy: Path, smoke: EvalProtocol) -> None:
    trained = load_controller("learned:transformer_gru@0", ROBOT)
    again = load_controller(f"policy:{own_policy / 'card.toml'}", ROBOT)
    assert again.info.commands == frozenset() and again.info.signals == trained.info.signals
    with pytest.warns(UserWarning, match="not trained on"):
        assert together(trained, again, smoke, steps=500, count=2, least=500) < 1e-5


class Reference:
    """A policy as its author would write it for this bench, in NumPy alone."""

    def __init__(self, compute: Callable, period: float = 0.02, parts: tuple = ("action",)) -> None:
        signals: frozenset[Signal] = frozenset({"proprioception", "ee_pose"})
        self.info = ControllerInfo("reference", signals, period, "tests", commands=frozenset(parts))
        self._compute = compute

    def reset(self, episodes: np.ndarray, obs: Observation, target: Target) -> None:
        self.memory: dict = {"action": np.zeros((len(episodes), 14)), "frames": []}

    def act(self, obs: Observation, target: Target) -> JointCommand:
        return self._compute(self.memory, obs, target)


def order(names: tuple[str, ...]) -> list[int]:
    return [JOINT_NAMES.index(name) for name in names]


def commanded(action: np.ndarray, names: tuple[str, ...], scale: np.ndarray, **parts) -> JointCommand:
    q = np.tile(ROBOT.default_q, (len(action), 1))
    q[:, order(names)] = ROBOT.default_q[order(names)] + scale * action
    return JointCommand(q, action=action, **parts)


def card(folder: Path, text: str) -> str:
    (folder / "card.toml").write_text(text)
    return f"policy:{folder / 'card.toml'}"


@pytest.mark.parametrize("batch", ["batch", 1, None], ids=["batched", "batch 1", "vectors"])
@pytest.mark.parametrize("names", [INTERLEAVED, SHUFFLED], ids=["interleaved", "shuffled"])
def test_another_joint_order_with_scales(
    tmp_path: Path, smoke: EvalProtocol, batch: str | int | None, names: tuple[str, ...]
) -> None:
    w, scale = weights(0, 51, 14, 3.0), np.linspace(0.1, 0.4, 14)
    layer(tmp_path / "net.onnx", w, batch)

    def compute(memory: dict, obs: Observation, target: Target) -> JointCommand:
        assert obs.proprioception
        gyro, gravity, pos, vel, _ = obs.proprioception
        k = order(names)
        parts = [0.25 * gyro, gravity, pos[:, k] - ROBOT.default_q[k], 0.05 * np.clip(vel[:, k], -2, 2)]
        parts += [memory["action"], target.pos_b - [0.3, 0.0, 0.5]]
        memory["action"] = np.tanh(np.hstack(parts).astype(np.float32) @ w)
        return commanded(memory["action"], names, scale)

    spec = card(
        tmp_path,
        f"""
name = "other"
joints = {list(names)}
[[observation]]
name = "policy"
terms = [
    {{ term = "base_ang_vel", scale = 0.25 }}, {{ term = "projected_gravity" }}, {{ term = "joint_pos_rel" }},
    {{ term = "joint_vel_rel", scale = 0.05, clip = [-2.0, 2.0] }}, {{ term = "last_action" }},
    {{ term = "target_pos", offset = [0.3, 0.0, 0.5] }},
]
[[network]]
file = "net.onnx"
inputs = {{ obs = "policy" }}
outputs = {{ actions = "action" }}
[action]
scale = {scale.tolist()}
""",
    )
    assert together(Reference(compute), load_controller(spec, ROBOT), smoke, 100) < 1e-5


@pytest.mark.parametrize("newest", [True, False], ids=["newest first", "oldest first"])
@pytest.mark.parametrize("layout", ["term", "frame"])
@pytest.mark.parametrize("start", ["repeat", "zeros"])
def test_history(tmp_path: Path, smoke: EvalProtocol, newest: bool, layout: str, start: str) -> None:
    w = weights(1, 4 * 17, 14, 3.0)
    layer(tmp_path / "net.onnx", w)

    def compute(memory: dict, obs: Observation, target: Target) -> JointCommand:
        assert obs.proprioception
        frame = [obs.proprioception.gravity_b, obs.proprioception.joint_vel]
        frames = memory["frames"]
        empty = frame if start == "repeat" else [0 * part for part in frame]
        frames[:] = [frame, *(frames or [empty] * 3)][:4]
        chosen = frames if newest else frames[::-1]
        if layout == "frame":
            parts = [part for one in chosen for part in one]
        else:
            parts = [one[k] for k in range(2) for one in chosen]
        return commanded(np.tanh(np.hstack(parts).astype(np.float32) @ w), JOINT_NAMES, np.full(14, 0.2))

    spec = card(
        tmp_path,
        f"""
name = "past"
[[observation]]
name = "policy"
history = 4
history_order = "{"newest_first" if newest else "oldest_first"}"
history_layout = "{layout}"
history_start = "{start}"
terms = [{{ term = "projected_gravity" }}, {{ term = "joint_vel" }}]
[[network]]
file = "net.onnx"
inputs = {{ obs = "policy" }}
outputs = {{ actions = "action" }}
[action]
scale = 0.2
""",
    )
    assert together(Reference(compute), load_controller(spec, ROBOT), smoke, 60) < 1e-5


@pytest.mark.parametrize("batch", ["batch", 1], ids=["batched", "batch 1"])
def test_two_files_with_recurrent_state_at_100_hz(
    tmp_path: Path, smoke: EvalProtocol, batch: str | int
) -> None:
    """An encoder with a state, an actor of its latent, gains of its own, a filter, and legs alone."""
    w, u, v = weights(2, 17, 5, 3.0), weights(3, 5, 5, 1.0), weights(4, 8, 8, 2.0)
    recurrent(tmp_path / "encoder.onnx", w, u, batch)
    layer(tmp_path / "actor.onnx", v, batch)
    kp, kd = np.where(np.arange(14) < 8, 60.0, ROBOT.kp), np.where(np.arange(14) < 8, 2.0, ROBOT.kd)

    def compute(memory: dict, obs: Observation, target: Target) -> JointCommand:
        assert obs.proprioception
        pro = obs.proprioception
        seen = np.hstack([pro.base_ang_vel_b, pro.joint_pos - ROBOT.default_q]).astype(np.float32)
        memory["h"] = np.tanh(seen @ w + memory.get("h", np.zeros((len(seen), 5))) @ u)
        raw = np.tanh(np.hstack([memory["h"], pro.gravity_b]).astype(np.float32) @ v)
        memory["f"] = 0.4 * raw + 0.6 * memory.get("f", raw)
        count = len(seen)
        q = np.tile(ROBOT.default_q, (count, 1))
        q[:, :8] += 0.3 * memory["f"]
        return JointCommand(q, kp=np.tile(kp, (count, 1)), kd=np.tile(kd, (count, 1)), action=raw)

    spec = card(
        tmp_path,
        """
name = "pair"
control_period = 0.01
[[observation]]
name = "seen"
terms = [{ term = "base_ang_vel" }, { term = "joint_pos_rel" }]
[[observation]]
name = "gravity"
terms = [{ term = "projected_gravity" }]
[[network]]
file = "encoder.onnx"
inputs = { obs = "seen" }
outputs = { latent = "latent" }
state = [{ input = "h_in", output = "h_out", batch_axis = 1 }]
[[network]]
file = "actor.onnx"
inputs = { obs = ["latent", "gravity"] }
outputs = { actions = "action" }
[action]
joints = LEGS
scale = 0.3
filter = 0.4
kp = 60.0
kd = 2.0
""".replace("LEGS", str(list(LEGS))),
    )
    controller = load_controller(spec, ROBOT)
    assert controller.info.commands == {"kp", "kd", "action"} and len(controller.info.files) == 3
    reference = Reference(compute, 0.01, ("kp", "kd", "action"))
    assert together(reference, controller, smoke, 60) < 1e-5


TERMS = """
name = "words"
quaternion = "xyzw"
[[observation]]
name = "policy"
terms = [
    { term = "ee_pos", frame = "world" }, { term = "ee_quat" }, { term = "ee_pos_error" },
    { term = "ee_rot6", layout = "rows" },
    { term = "target_pos", frame = "arm" }, { term = "gait_phase", frequency = 2.0, phases = [0.0, 0.5] },
    { term = "velocity_commands", value = [0.1, 0.2, 0.3] },
]
[[network]]
file = "net.onnx"
inputs = { obs = "policy" }
outputs = { actions = "action" }
"""


def test_words_of_the_vocabulary_by_hand(tmp_path: Path, smoke: EvalProtocol, calm_rows: CalmRows) -> None:
    layer(tmp_path / "net.onnx", weights(5, 26, 14))
    controller = load_controller(card(tmp_path, TERMS), ROBOT)
    loop = ControlLoop(controller, smoke, calm_rows(2))
    state = loop.state
    target = loop.sensors.target(loop.odometry)
    next(loop.run())
    values = controller.values["policy"][0]  # type: ignore[attr-defined]
    base, rot = state.base_rot_w[0], state.base_rot_w[0].T @ state.ee_rot_w[0]
    np.testing.assert_allclose(values[:3], state.ee_pos_w[0], atol=1e-12)
    x, y, z, w = values[3:7]
    np.testing.assert_allclose(
        np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]), rot[:, 0], atol=1e-9
    )
    ee_b = base.T @ (state.ee_pos_w[0] - state.base_pos_w[0])
    np.testing.assert_allclose(values[7:10], target.pos_b[0] - ee_b, atol=1e-12)
    np.testing.assert_allclose(values[10:16], rot[:2].ravel(), atol=1e-12)
    np.testing.assert_allclose(values[16:19], target.pos_b[0] - [0.02616, 0.0, 0.0225], atol=1e-12)
    np.testing.assert_allclose(values[19:23], [0.0, 1.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(values[23:], [0.1, 0.2, 0.3], atol=1e-12)


def test_a_walking_policy_reads_the_follower(
    tmp_path: Path, smoke: EvalProtocol, calm_rows: CalmRows
) -> None:
    layer(tmp_path / "net.onnx", weights(5, 5, 8))
    spec = card(tmp_path, WALKER.replace("LEGS", str(list(LEGS))))
    controller = load_controller(spec, ROBOT)
    assert controller.info.signals == {"proprioception"}
    follower = Follower(ROBOT, 0.7, (0.4, 0.1, 0.2), (0.03, 0.05))
    loop = ControlLoop(controller, smoke, calm_rows(3))
    target = loop.sensors.target(loop.odometry)
    loop.reset(target)
    level = heading_from_gravity(loop.observation.proprioception.gravity_b)  # type: ignore[union-attr]
    pos, rot = np.einsum("nij,nj->ni", level, target.pos_b), level @ target.rot_b
    follower.start(pos, rot)
    expected = follower.command(pos, rot)
    command = loop.advance(target).q
    values = controller.values["policy"]  # type: ignore[attr-defined]
    np.testing.assert_allclose(values, np.column_stack([2 * expected, np.zeros((3, 2))]), atol=1e-12)
    assert np.abs(expected).max() > 0.05
    arm = load_controller("ik:arm", ROBOT)
    fresh = ControlLoop(arm, smoke, calm_rows(3))
    fresh.reset(target)
    np.testing.assert_array_equal(command[:, 8:], fresh.advance(target).q[:, 8:])


WALKER = """
name = "walker"
[[observation]]
name = "policy"
terms = [{ term = "velocity_commands", scale = 2.0 }, { term = "constant", value = [0.0, 0.0] }]
[[network]]
file = "net.onnx"
inputs = { obs = "policy" }
outputs = { actions = "action" }
[action]
joints = LEGS
scale = 0.1
others = "ik:arm"
[follower]
gain = 0.7
limits = [0.4, 0.1, 0.2]
"""


def test_a_policy_is_a_row(tmp_path: Path) -> None:
    layer(tmp_path / "net.onnx", weights(0, 3, 14))
    spec = card(tmp_path, PLAIN)
    results = wbc_bench.evaluate(spec, str(write_tiny(tmp_path, replicates=1)))
    assert "| plain ‡ | 6/6 |" in str(results) and results.records[0].commands == ["action"]


PLAIN = """
name = "plain"
[[observation]]
name = "policy"
terms = [{ term = "projected_gravity" }]
[[network]]
file = "net.onnx"
inputs = { obs = "policy" }
outputs = { actions = "action" }
[action]
scale = 0.1
"""
MISTAKES = {
    "unknown term": (
        '"projected_gravity"',
        '"projected_gravty"',
        "unknown term .*did you mean projected_gravity",
    ),
    "unknown joint": ('name = "plain"', 'joints = ["J1", "J7"]\nname = "plain"', "unknown joint 'J7'"),
    "unknown key": ("scale = 0.1", "scales = 0.1", "unknown field `scales`.*action"),
    "dimension": (
        '"projected_gravity" }',
        '"joint_pos" }',
        "reads 3 numbers as 'obs', the card gives 14: policy 14",
    ),
    "missing value": (
        '{ obs = "policy" }',
        '{ obs = "polcy" }',
        "reads 'polcy', which is missing; valid: policy",
    ),
    "cycle": ('{ obs = "policy" }', '{ obs = "action" }', "reads 'action', which is written by .*: a cycle"),
    "no action": ('= "action"', '= "act"', "no network writes 'action'"),
    "missing input": ("inputs = { obs", "inputs = { other", "has inputs obs, the card names other"),
    "missing output": ("{ actions =", "{ action =", "has no output 'action', valid: actions"),
    "scale": ("scale = 0.1", "scale = [0.1, 0.2]", "action.scale has 2 numbers, valid: 1 or 14"),
    "not finite": ("scale = 0.1", "scale = nan", "action.scale is nan, valid: finite numbers"),
    "gain": ("scale = 0.1", "scale = 0.1\nkp = -1.0", "action.kp is -1.0, valid: 0 or more"),
    "file": ("net.onnx", "absent.onnx", "absent.onnx' does not exist"),
    "robot": ('name = "plain"', 'robot = "paper"\nname = "plain"', "is for the robot variant 'paper'"),
    "frame": ('"projected_gravity"', '"projected_gravity", frame = "world"', "frame is world, valid: base"),
    "no velocity": (
        '"projected_gravity"',
        '"velocity_commands"',
        "value is empty, valid: numbers, or a table",
    ),
    "follower": ("[action]", "[follower]\n[action]", "follower is given, valid: a term `velocity_commands`"),
    "follower's gain": (
        "[action]",
        "[follower]\ngain = -1.0\n[action]",
        "follower.gain is -1.0, valid: 0 or",
    ),
    "period": (
        'name = "plain"',
        'control_period = 0.0\nname = "plain"',
        "control_period is 0.0, valid: above",
    ),
    "TOML": ("[action]", "[action", "card.toml"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_wrong_card_is_one_line(tmp_path: Path, mistake: str, capsys: pytest.CaptureFixture[str]) -> None:
    layer(tmp_path / "net.onnx", weights(0, 3, 14))
    old, new, said = MISTAKES[mistake]
    assert old in PLAIN
    spec = card(tmp_path, PLAIN.replace(old, new, 1))
    with pytest.raises(BenchError, match=said):
        load_controller(spec, ROBOT)
    with pytest.raises(SystemExit) as ended:
        main(["eval", "--controller", spec, "--protocol", "smoke_v1", "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


def test_one_output_for_all_robots_is_refused(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["product"]),
        helper.make_node("ReduceMean", ["product"], ["actions"], axes=[0], keepdims=0),
    ]
    shapes = {"obs": ["batch", 3]}, {"actions": [14]}
    write(tmp_path / "net.onnx", nodes, *shapes, {"w": weights(0, 3, 14)})
    with pytest.raises(
        ControllerError, match=r"'actions' has shape \[14\] for all robots, valid: a row for each"
    ):
        load_controller(card(tmp_path, PLAIN), ROBOT)


def test_others_of_another_period_are_refused(tmp_path: Path) -> None:
    layer(tmp_path / "net.onnx", weights(5, 5, 8))
    text = WALKER.replace("LEGS", str(list(LEGS)))
    with pytest.raises(ControllerError, match=r"'ik:arm' runs every 0.02 s, the card every 0.04 s"):
        load_controller(card(tmp_path, "control_period = 0.04" + text), ROBOT)


@pytest.mark.parametrize("content", ["pickle", "torch", "cut", "text"])
def test_nothing_of_a_file_is_executed(tmp_path: Path, content: str) -> None:
    """A pickled file is refused by its first bytes; a damaged graph by the runtime."""
    import pickle
    import zipfile

    class Evil:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    path = tmp_path / "net.onnx"
    layer(path, weights(0, 3, 14))
    if content == "pickle":
        path.write_bytes(pickle.dumps(Evil()))
    elif content == "torch":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps(Evil()))
    else:
        path.write_bytes(path.read_bytes()[:60] if content == "cut" else b"no graph")
    with pytest.raises(ControllerError, match=r"pickled file|ONNX file that can be run"):
        load_controller(card(tmp_path, PLAIN), ROBOT)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("name", [b"obs", b"actions", b"batch"])
def test_a_graph_with_names_that_are_no_text_is_one_line(tmp_path: Path, capfd, name: bytes) -> None:
    """The runtime's own wrapper would print to standard output and try the same again."""
    path = layer(tmp_path / "net.onnx", weights(0, 3, 14))
    path.write_bytes(path.read_bytes().replace(name, b"\xf0" + name[1:]))
    with pytest.raises(ControllerError, match=r"net\.onnx' is damaged or not an ONNX file"):
        load_controller(card(tmp_path, PLAIN), ROBOT)
    assert capfd.readouterr() == ("", "")
