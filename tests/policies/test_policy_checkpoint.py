"""PyTorch checkpoints as policies: the numbers of the network that wrote them, and no code of theirs."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commands import fails
from wbc_bench.cli.main import main
from wbc_bench.errors import ControllerError
from wbc_bench.policies.state_dict import onnx_of, read_perceptron

torch = pytest.importorskip("torch")
ort = pytest.importorskip("onnxruntime")


def perceptron(seed: int, activation: Any = torch.nn.ELU) -> Any:
    torch.manual_seed(seed)
    return torch.nn.Sequential(
        torch.nn.Linear(20, 32), activation(), torch.nn.Linear(32, 16), activation(), torch.nn.Linear(16, 14)
    )


def named(network: Any, prefix: str) -> dict[str, Any]:
    return {f"{prefix}{name}": value for name, value in network.state_dict().items()}


def answer(path: Path, obs: np.ndarray) -> np.ndarray:
    return ort.InferenceSession(str(path)).run(None, {"obs": obs})[0]


OBS = np.random.default_rng(0).normal(size=(7, 20)).astype(np.float32)


def test_a_checkpoint_of_the_rsl_rl_that_is_installed_answers_as_its_actor(tmp_path: Path) -> None:
    """With its normalizer; that of the critic and the state of the optimizer are left alone."""
    models = pytest.importorskip("rsl_rl.models")
    tensordict = pytest.importorskip("tensordict")
    torch.manual_seed(1)
    seen = tensordict.TensorDict({"policy": 3 * torch.randn(50, 20) + 1}, batch_size=[50])
    groups = {"actor": ["policy"], "critic": ["policy"]}
    distribution = {
        "class_name": "rsl_rl.modules:GaussianDistribution",
        "init_std": 1.0,
        "std_type": "scalar",
    }
    actor = models.MLPModel(
        seen, groups, "actor", 14, hidden_dims=[32, 16], activation="elu", obs_normalization=True,
        distribution_cfg=distribution,
    )  # fmt: skip
    critic = models.MLPModel(seen, groups, "critic", 1, hidden_dims=[32, 16], obs_normalization=True)
    for _ in range(3):
        actor.update_normalization(seen)
    saved = {"actor_state_dict": actor.state_dict(), "critic_state_dict": critic.state_dict(), "iter": 3}
    saved["optimizer_state_dict"] = torch.optim.Adam(actor.parameters()).state_dict()
    torch.save(saved, tmp_path / "model.pt")
    main(["policy", "import", str(tmp_path / "model.pt")])
    with torch.no_grad():
        wanted = actor(tensordict.TensorDict({"policy": torch.from_numpy(OBS)}, batch_size=[7])).numpy()
    np.testing.assert_allclose(answer(tmp_path / "model.onnx", OBS), wanted, atol=1e-5)
    card = (tmp_path / "model.toml").read_text()
    assert "Elu was taken" in card and 'file = "model.onnx"' in card
    assert "other networks of the checkpoint: critic_state_dict.mlp" in card


@pytest.mark.parametrize("activation", ["Elu", "Relu", "Tanh"])
def test_an_older_layout_and_other_activations(tmp_path: Path, activation: str) -> None:
    """One state dict with `actor.` and `critic.`, and the normalizer beside it as variance."""
    network = perceptron(2, {"Elu": torch.nn.ELU, "Relu": torch.nn.ReLU, "Tanh": torch.nn.Tanh}[activation])
    mean, std = torch.randn(1, 20), torch.rand(1, 20) + 0.5
    saved = {
        "model_state_dict": named(network, "actor.")
        | named(perceptron(3), "critic.")
        | {"std": torch.ones(14)},
        "obs_norm_state_dict": {"_mean": mean, "_var": std**2, "count": torch.tensor(5)},
        "iter": 5,
        "infos": None,
    }
    torch.save(saved, tmp_path / "old.pt")
    found = read_perceptron(tmp_path / "old.pt")
    (tmp_path / "old.onnx").write_bytes(onnx_of(found, activation))  # pyright: ignore[reportArgumentType]
    with torch.no_grad():
        wanted = network((torch.from_numpy(OBS) - mean) / (std + 1e-2)).numpy()
    np.testing.assert_allclose(answer(tmp_path / "old.onnx", OBS), wanted, atol=1e-5)
    assert found.others == ["model_state_dict.critic"]


def test_a_plain_state_dict_without_a_normalizer(tmp_path: Path) -> None:
    network = perceptron(4)
    torch.save(network.state_dict(), tmp_path / "plain.pth")
    main(["policy", "import", str(tmp_path / "plain.pth")])
    with torch.no_grad():
        np.testing.assert_allclose(
            answer(tmp_path / "plain.onnx", OBS), network(torch.from_numpy(OBS)).numpy(), atol=1e-5
        )
    assert "no mean and deviation" in (tmp_path / "plain.toml").read_text()


class Runs:
    """What a pickle could do."""

    def __reduce__(self):
        return Path.touch, (Path("ran"),)


@pytest.mark.parametrize(
    "saved, message",
    [
        ({"actor": Runs()}, "cannot be read, valid: a state dict"),
        ({"iter": 3}, "has no tensors"),
        (named(perceptron(0), "actor.") | named(perceptron(1), "student_actor."), "'actor', 'student_actor'"),
        ({"critic.0.weight": torch.ones(3, 3)}, "'critic', valid: one of an actor"),
        ({"actor.0.weight": torch.ones(3, 4)}, "or has no bias"),
        (
            {f"actor.{k}.weight": torch.ones(3, 4) for k in (0, 2)}
            | {f"actor.{k}.bias": torch.ones(3) for k in (0, 2)},
            "does not follow the one before",
        ),
    ],
)
def test_what_is_no_policy_is_one_line_and_nothing_is_run_or_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, saved, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(saved, "bad.pt")
    assert message in fails(capsys, "policy", "import", "bad.pt")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.pt"]


def test_files_that_are_no_checkpoints(tmp_path: Path, capsys) -> None:
    with pytest.raises(ControllerError, match="is no file"):
        read_perceptron(tmp_path / "none.pt")
    (tmp_path / "a.pt").write_bytes(b"PK\x03\x04 not a zip")
    assert "cannot be read" in fails(capsys, "policy", "import", tmp_path / "a.pt")
    torch.save(perceptron(0).state_dict(), tmp_path / "b.pt")
    (tmp_path / "b.onnx").write_bytes(b"mine")
    assert "b.onnx' exists" in fails(capsys, "policy", "import", tmp_path / "b.pt")
    assert (tmp_path / "b.onnx").read_bytes() == b"mine" and not (tmp_path / "b.toml").exists()
