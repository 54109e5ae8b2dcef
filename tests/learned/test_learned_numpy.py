"""Policies by NumPy against the same policies by torch, and what an evaluation then does without."""

import subprocess
import sys

import msgspec
import numpy as np
import pytest
import torch
from conftest import CalmRows

from policies import TorchEngine, networks, numpy_policy, write
from tiny_protocol import write_tiny
from wbc_baselines.learned.policy import checkpoint, weights
from wbc_baselines.learned.policy.architecture import ORACLE_CONTEXTS, tensor_shapes
from wbc_baselines.learned.policy.card import new_card
from wbc_baselines.learned.policy.controller import LearnedController
from wbc_baselines.learned.policy.estimators import Estimator, Oracle
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.networks import Actor
from wbc_bench.episodes.protocol import EvalProtocol
from wbc_bench.evaluation.observation import Sensors
from wbc_bench.evaluation.simulation import Simulation
from wbc_bench.robot import load_robot

STEPS, COUNT = 200, 3
SHIPPED = weights.available("limx_adapter")


def policy_of(name: str) -> tuple[str, Actor, Estimator]:
    """Method and networks of METHOD, untrained, or of METHOD@SEED."""
    if "@" in name:
        card, actor, estimator = checkpoint.load(weights.find(name, "limx_adapter"))
        return card.method, actor, estimator
    return name, *networks(name)


class Both:
    """NumPy acts, torch computes the same; each carries its own window and state."""

    def __init__(self, method: str, actor: Actor, estimator: Estimator) -> None:
        self.engines = numpy_policy(method, actor, estimator), TorchEngine(actor, estimator)
        self.flow = self.engines[0].flow
        assert self.flow == self.engines[1].flow
        self.found: list[list[dict[str, np.ndarray]]] = []

    def begin(self, frame):
        return [engine.begin(frame) for engine in self.engines]

    def __call__(self, values, carried):
        results = [engine(values, mine) for engine, mine in zip(self.engines, carried, strict=True)]
        self.found.append([found for found, _ in results])
        return self.found[-1][0], [after for _, after in results]


@pytest.mark.parametrize("name", [*METHODS, *SHIPPED])
def test_numpy_computes_what_torch_computes(name, smoke: EvalProtocol, calm_rows: CalmRows):
    """In closed loop, also where the robot has fallen, and the latent too."""
    method, actor, estimator = policy_of(name)
    both = Both(method, actor, estimator)
    longer = msgspec.structs.replace(smoke.episodes, horizon=STEPS * smoke.control_period)
    smoke = msgspec.structs.replace(smoke, episodes=longer)
    controller = LearnedController(load_robot(), new_card(method, 0, 0, 0.0, smoke), both, "both", "")
    rows = calm_rows(COUNT, noise_scale=np.ones(COUNT))
    simulation, sensors = Simulation(smoke, rows), Sensors(smoke, rows, controller.info.signals)
    active = np.ones(COUNT, dtype=bool)
    for step in range(STEPS):
        state = simulation.state()
        obs, target = sensors.observe(step, 0.02 * step, state, active), sensors.target(state)
        if step == 0:
            controller.reset(np.arange(COUNT), obs, target)
        simulation.step(controller.act(obs, target).q, active)
    wanted = {"action", "latent"} if METHODS[method].estimates else {"action"}
    for mine, theirs in both.found:
        assert mine.keys() == theirs.keys() == wanted
        for key, value in mine.items():
            assert value.dtype == np.float32
            np.testing.assert_allclose(value, theirs[key], atol=2e-5, rtol=0)
    assert np.ptp([mine["action"] for mine, _ in both.found], axis=0).max() > 0.01


def test_an_oracle_of_the_paper_s_columns():
    torch.manual_seed(0)
    estimator, rng = Oracle(80), np.random.default_rng(0)
    actor = Actor(80)
    mine, theirs = numpy_policy("oracle", actor, estimator), TorchEngine(actor, estimator)
    assert mine.flow == theirs.flow and mine.flow.inputs["privileged"] == (80,)
    values = {name: rng.standard_normal((5, *s), np.float32) for name, s in mine.flow.inputs.items()}
    np.testing.assert_allclose(mine(values, None)[0]["action"], theirs(values, {})[0]["action"], atol=2e-5)


@pytest.mark.parametrize("method", METHODS)
def test_the_tensors_are_those_of_the_networks(method):
    def found(actor: Actor, estimator: Estimator) -> dict[str, tuple[int, ...]]:
        parts = (("actor", actor), ("estimator", estimator))
        return {f"{part}.{n}": tuple(v.shape) for part, m in parts for n, v in m.state_dict().items()}

    name = METHODS[method].estimator
    actor, estimator = networks(method)
    assert tensor_shapes(name, estimator.context_dim) == found(actor, estimator)
    if name == "oracle":
        for context in ORACLE_CONTEXTS:
            assert tensor_shapes(name, context) == found(Actor(context), Oracle(context))


CODE = """
import sys
from wbc_bench.cli.main import main
main(sys.argv[1:])
print("imported:", *({"torch", "onnxruntime"} & sys.modules.keys()))
"""


@pytest.mark.parametrize("kind", ["learned", "onnx"])
def test_an_evaluation_imports_no_torch(kind, tmp_path):
    spec = f"learned:{write(tmp_path, 'transformer_gru')}"
    if kind == "onnx":
        from wbc_bench.cli.main import main

        pytest.importorskip("onnxruntime")
        main(["export", "--controller", spec, "-o", str(tmp_path / "policy.onnx")])
        spec = f"onnx:{tmp_path / 'policy.onnx'}"
    tiny, out = write_tiny(tmp_path), tmp_path / "out"
    line = ["eval", "--controller", spec, "--protocol", str(tiny), "--out", str(out), "--workers", "1"]
    done = subprocess.run([sys.executable, "-c", CODE, *line], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].split() == ["imported:"] + ["onnxruntime"] * (kind == "onnx")
