"""Export of policies as ONNX files, with window and recurrent state as explicit inputs and outputs.

The normalizers are part of the graph. The file contains the checkpoint's card, so that `onnx:FILE` is checked
against the robot like a checkpoint, and ends in the digest of its bytes.
"""

import tempfile
import warnings
from pathlib import Path

import msgspec
import onnx
import torch
from torch import Tensor, nn

from wbc_baselines.learned.policy.card import PolicyCard
from wbc_baselines.learned.policy.onnx_engine import CARD, OPSET, output_name, seal
from wbc_baselines.learned.policy.policy import Policy
from wbc_bench.files import write_atomic


class _Positional(nn.Module):
    """A policy with positional inputs and outputs in the order of its flow, as the exporter requires."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        flow = self.policy.flow
        found = self.policy(dict(zip(flow.inputs, values, strict=True)))
        return tuple(found[name] for name in flow.outputs)


def write_onnx(path: Path, policy: Policy, card: PolicyCard) -> None:
    """Write a policy and its card, with a variable batch size.

    Args:
        path: ONNX file to write.
        policy: Policy to export.
        card: Card of its checkpoint.
    """
    flow = policy.flow
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # torch's tracing exporter is deprecated, but the other one needs a further package
        warnings.simplefilter("ignore", DeprecationWarning)
        raw = Path(folder) / "policy.onnx"
        torch.onnx.export(
            _Positional(policy).eval(),
            tuple(torch.zeros(2, *shape) for shape in flow.inputs.values()),
            str(raw),
            input_names=list(flow.inputs),
            # an output cannot have the name of an input
            output_names=[output_name(name) for name in flow.outputs],
            dynamic_axes={name: {0: "batch"} for name in (*flow.inputs, *map(output_name, flow.outputs))},
            opset_version=OPSET,
            dynamo=False,
        )
        model = onnx.load(raw)
    onnx.helper.set_model_props(model, {CARD: msgspec.json.encode(card).decode()})
    data = model.SerializeToString(deterministic=True)
    write_atomic(path, data + seal(data))
