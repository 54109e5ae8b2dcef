"""ONNX: the file computes what torch computes, over whole episodes, and is checked like a checkpoint."""

from pathlib import Path

import numpy as np
import onnx
import pytest

from policies import TorchEngine, networks, write
from wbc_baselines.learned.policy.inputs import HISTORY_FRAME
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.onnx_engine import OnnxEngine, seal
from wbc_bench.cli.main import main
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.errors import BenchError
from wbc_bench.evaluation.rollout import rollout
from wbc_bench.registry import load_controller
from wbc_bench.robot import RobotConfig, load_robot

STEPS = 500


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> dict[str, Path]:
    """Every method as ONNX, by the command line."""
    folder, files = tmp_path_factory.mktemp("export"), {}
    for method in METHODS:
        files[method] = folder / f"{method}.onnx"
        spec = f"learned:{write(folder, method)}"
        main(["export", "--controller", spec, "--format", "onnx", "-o", str(files[method])])
    return files


@pytest.mark.parametrize("method", METHODS)
def test_torch_and_onnxruntime_agree_over_an_episode(exported, method):
    """500 steps, each engine on its own window and state, over correlated observations."""
    engines = TorchEngine(*networks(method)), OnnxEngine(exported[method])
    assert engines[0].flow == engines[1].flow
    rng = np.random.default_rng(0)
    shapes = {name: s for name, s in engines[0].flow.inputs.items() if name not in ("window", "state")}
    given = {name: np.zeros((3, *shape), np.float32) for name, shape in shapes.items()}
    carried: list[dict] = [dict(engine.begin(np.ones((3, HISTORY_FRAME), np.float32))) for engine in engines]
    worst, moved = 0.0, 0.0
    for _ in range(STEPS):
        for name, value in given.items():
            given[name] = 0.9 * value + rng.standard_normal(value.shape, np.float32)
        actions = []
        for k, engine in enumerate(engines):
            found, carried[k] = engine(given, carried[k])
            actions.append(found["action"])
        worst = max(worst, np.abs(actions[0] - actions[1]).max())
        moved = max(moved, np.abs(actions[0]).max())
    assert worst < 1e-5 and moved > 0.01
    for name in carried[0]:
        np.testing.assert_allclose(carried[0][name], carried[1][name], atol=1e-5)


def test_window_and_state_are_explicit(exported):
    graph = onnx.load(exported["transformer_gru"]).graph
    assert [x.name for x in graph.input] == ["observation", "command", "term", "window", "state"]
    assert [x.name for x in graph.output] == ["action", "next_window", "next_state"]
    assert [d.dim_value for d in graph.input[3].type.tensor_type.shape.dim] == [0, 10, 57]
    assert [x.name for x in onnx.load(exported["oracle"]).graph.input] == [
        "observation",
        "command",
        "privileged",
    ]
    assert [x.name for x in onnx.load(exported["no_latent"]).graph.input] == ["observation", "command"]


@pytest.mark.parametrize("method", ["transformer_gru", "oracle"])
def test_both_drive_the_robot_alike(exported, method, smoke: EvalProtocol, calm_rows):
    robot = load_robot()
    ours = load_controller(f"learned:{exported[method].with_name(f'{method}@0.safetensors')}", robot)
    theirs = load_controller(f"onnx:{exported[method]}", robot)
    assert theirs.info.signals == ours.info.signals
    a, b = (rollout(controller, smoke, calm_rows(2)) for controller in (ours, theirs))
    np.testing.assert_array_equal(a.steps, b.steps)
    np.testing.assert_allclose(
        a.action[:, :20], b.action[:, :20], atol=1e-4
    )  # later, contacts amplify rounding


def test_the_record_names_the_file(exported):
    from hashlib import sha256

    controller = load_controller(f"onnx:{exported['gru']}", load_robot())
    assert controller.checkpoint_sha256 == sha256(exported["gru"].read_bytes()).hexdigest()


def test_the_same_checkpoint_gives_the_same_bytes(exported, tmp_path):
    again = tmp_path / "again.onnx"
    checkpoint = exported["gru"].with_name("gru@0.safetensors")
    main(["export", "--controller", f"learned:{checkpoint}", "-o", str(again)])
    assert again.read_bytes() == exported["gru"].read_bytes()


def test_mistakes(exported, tmp_path):
    def fails(spec: str, word: str, config: RobotConfig = RobotConfig()) -> None:  # noqa: B008  (frozen)
        with pytest.raises(BenchError, match=word):
            load_controller(spec, load_robot(config))

    fails(f"onnx:{tmp_path / 'none.onnx'}", "there is no file")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(exported["gru"].read_bytes()[:1000])
    fails(f"onnx:{broken}", "not an ONNX file that can be run")
    plain = onnx.load(exported["gru"])
    del plain.metadata_props[:]
    onnx.save(plain, broken)
    fails(f"onnx:{broken}", "carries no card")
    fails(f"onnx:{exported['gru']}", r"ee_xyz\[0\]", RobotConfig(tcp="link6"))


@pytest.mark.parametrize("place", [0.0, 0.3, 0.6, 0.9, 0.99999])
def test_a_flipped_bit_is_refused(exported, tmp_path, place):
    """Weights, graph, card, and the digest itself: the digest at the end covers all bytes before it."""
    data = bytearray(exported["gru"].read_bytes())
    data[int(place * len(data))] ^= 1
    path = tmp_path / "flipped.onnx"
    path.write_bytes(data)
    with pytest.raises(BenchError, match="is altered: SHA-256") as caught:
        load_controller(f"onnx:{path}", load_robot())
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_digest_is_an_entry_of_the_metadata(exported):
    from hashlib import sha256

    data = exported["gru"].read_bytes()
    entries = {entry.key: entry.value for entry in onnx.load(exported["gru"]).metadata_props}
    assert set(entries) == {"card", "sha256"} and len(entries["sha256"]) == 64
    model = data[: -len(seal(b""))]
    assert entries["sha256"] == sha256(model).hexdigest() and model + seal(model) == data


def test_another_graph_under_the_card_is_refused(exported, tmp_path):
    """Also where the digest was made to fit."""
    model = onnx.load(exported["gru"])
    for change, word in (("input", "reads"), ("output", "writes")):
        other = onnx.load(exported["no_latent"])
        card = next(entry.value for entry in model.metadata_props if entry.key == "card")
        if change == "output":
            other.graph.output[0].name = "moved"
            other.graph.node[-1].output[0] = "moved"
            card = next(entry.value for entry in other.metadata_props if entry.key == "card")
        onnx.helper.set_model_props(other, {"card": card})
        data = other.SerializeToString()
        path = tmp_path / "other.onnx"
        path.write_bytes(data + seal(data))
        with pytest.raises(BenchError, match=word):
            load_controller(f"onnx:{path}", load_robot())


@pytest.mark.parametrize("words", [["--controller", "hold"], ["--format", "tflite"]], ids=["hold", "format"])
def test_what_cannot_be_exported(exported, words, capsys, tmp_path):
    spec = f"learned:{exported['gru'].with_name('gru@0.safetensors')}"
    with pytest.raises(SystemExit) as stopped:
        main(["export", "--controller", spec, "-o", str(tmp_path / "x.onnx"), *words])
    assert stopped.value.code == 2
    assert "unknown format" in capsys.readouterr().err and not (tmp_path / "x.onnx").exists()
