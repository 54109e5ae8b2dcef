"""Policies of ONNX files, computed by onnxruntime on one thread."""

import hashlib
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from wbc_baselines.learned.policy.card import CheckpointError, decode_card
from wbc_baselines.learned.policy.estimators import make_estimator
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.policy.policy import flow_of

OPSET = 17
CARD = "card"  # key of the metadata


class OnnxEngine:
    """A policy computed by onnxruntime, on one thread."""

    def __init__(self, path: Path) -> None:
        """Open an exported policy.

        Args:
            path: ONNX file.

        Raises:
            CheckpointError: The file is missing, damaged, or was not exported by this package.
        """
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
            decode_card(text.encode(), str(path)),
            hashlib.sha256(data).hexdigest(),
        )
        self.flow = flow_of(make_estimator(METHODS[self.card.method].estimator))
        names = [value.name for value in self._session.get_inputs()]
        if names != list(self.flow.inputs):
            raise CheckpointError(
                f"'{path}' reads {', '.join(names)}, {self.card.method}: {', '.join(self.flow.inputs)}"
            )

    def __call__(self, values: dict[str, Tensor]) -> dict[str, Tensor]:
        """Compute one control step of N robots."""
        arrays = {name: np.ascontiguousarray(values[name].numpy()) for name in self.flow.inputs}
        found = self._session.run([_output(name) for name in self.flow.outputs], arrays)
        return {n: torch.from_numpy(np.asarray(v)) for n, v in zip(self.flow.outputs, found, strict=True)}


def _output(name: str) -> str:
    return name if name == "action" else f"next_{name}"
