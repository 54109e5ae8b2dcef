"""Policies as ONNX files: window and recurrent state are explicit inputs and outputs, normalisers are inside.

The checkpoint's card travels in the file, so that `onnx:FILE` is checked against the robot like a checkpoint.
"""

import hashlib
import tempfile
import warnings
from pathlib import Path

import msgspec
import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from wbc_baselines.learned import checkpoint
from wbc_baselines.learned.checkpoint import Card, CheckpointError
from wbc_baselines.learned.controller import LearnedController
from wbc_baselines.learned.estimators import make_estimator
from wbc_baselines.learned.methods import METHODS
from wbc_baselines.learned.policy import Policy, flow_of
from wbc_bench.files import write_atomic
from wbc_bench.robot import Robot

OPSET = 17
CARD = "card"  # key of the metadata


class _Positional(nn.Module):
    """A policy whose inputs and outputs are in the order of its flow, as the exporter wants them."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        flow = self.policy.flow
        found = self.policy(dict(zip(flow.inputs, values, strict=True)))
        return tuple(found[name] for name in flow.outputs)


def write_onnx(path: Path, policy: Policy, card: Card) -> None:
    """Write a policy and its card; the batch is free."""
    flow = policy.flow
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # of torch's two exporters the one that traces is deprecated, and needs no further package
        warnings.simplefilter("ignore", DeprecationWarning)
        raw = Path(folder) / "policy.onnx"
        torch.onnx.export(
            _Positional(policy).eval(),
            tuple(torch.zeros(2, *shape) for shape in flow.inputs.values()),
            str(raw),
            input_names=list(flow.inputs),
            # an output cannot be called as an input is
            output_names=[_output(name) for name in flow.outputs],
            dynamic_axes={name: {0: "batch"} for name in (*flow.inputs, *map(_output, flow.outputs))},
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(raw)
    onnx.helper.set_model_props(model, {CARD: msgspec.json.encode(card).decode()})
    write_atomic(path, model.SerializeToString(deterministic=True))


class OnnxEngine:
    """A policy computed by onnxruntime, on one thread."""

    def __init__(self, path: Path) -> None:
        """Raises: CheckpointError, the file is missing, damaged or not one of ours."""
        if not path.is_file():
            raise CheckpointError(f"there is no file '{path}' (onnx:FILE)")
        data = path.read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(data, options, ["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no other base
            raise CheckpointError(f"'{path}' is not an ONNX file that can be run: {error}") from error
        text = self._session.get_modelmeta().custom_metadata_map.get(CARD)
        if text is None:
            raise CheckpointError(f"'{path}' carries no card: write it by `wbc-bench export`")
        self.card, self.sha256 = (
            checkpoint.decode_card(text.encode(), str(path)),
            hashlib.sha256(data).hexdigest(),
        )
        self.flow = flow_of(make_estimator(METHODS[self.card.method].estimator))
        names = [value.name for value in self._session.get_inputs()]
        if names != list(self.flow.inputs):
            raise CheckpointError(
                f"'{path}' reads {', '.join(names)}, {self.card.method}: {', '.join(self.flow.inputs)}"
            )

    def __call__(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        """One control step of N robots."""
        arrays = {name: np.ascontiguousarray(values[name].numpy()) for name in self.flow.inputs}
        found = self._session.run([_output(name) for name in self.flow.outputs], arrays)
        return {n: torch.from_numpy(np.asarray(v)) for n, v in zip(self.flow.outputs, found, strict=True)}


def from_onnx(robot: Robot, variant: str) -> LearnedController:
    """The controller of `onnx:FILE`. Raises: CheckpointError, UnknownNameError."""
    engine = OnnxEngine(Path(variant))
    checkpoint.check_fit(engine.card, robot, None, variant)
    return LearnedController(robot, engine.card, engine, f"onnx:{variant}", engine.sha256)


def _output(name: str) -> str:
    return name if name == "action" else f"next_{name}"
