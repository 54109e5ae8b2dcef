"""Policies of ONNX files, computed by onnxruntime on one thread."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from wbc_baselines.learned.policy import inputs
from wbc_baselines.learned.policy.architecture import SIZES, flow_of
from wbc_baselines.learned.policy.card import CheckpointError, decode_card
from wbc_baselines.learned.policy.methods import METHODS
from wbc_bench.readers import is_file, read_bytes, reading

OPSET = 17
Array = NDArray[np.float32]
CARD, DIGEST = "card", b"sha256"  # keys of the metadata


class OnnxEngine:
    """A policy computed by onnxruntime, on one thread."""

    def __init__(self, path: Path) -> None:
        """Open an exported policy.

        Args:
            path: ONNX file.

        Raises:
            CheckpointError: The file is missing, damaged, or was not exported by this package.
        """
        if not is_file(path):
            raise CheckpointError(f"there is no file '{path}' (onnx:FILE)")
        data = read_bytes(path, "policy", CheckpointError)
        check_seal(data, path)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        with reading("policy", path, "an ONNX file that can be run", CheckpointError):
            self._session = onnxruntime.InferenceSession(
                data, options, ["CPUExecutionProvider"], enable_fallback=0
            )
            text = self._session.get_modelmeta().custom_metadata_map.get(CARD)
        if text is None:
            raise CheckpointError(f"'{path}' carries no card, valid: a file that `export` of wbc-bench wrote")
        self.card, self.sha256 = decode_card(text.encode(), str(path)), hashlib.sha256(data).hexdigest()
        sizes = SIZES[METHODS[self.card.method].estimator]
        self.flow = flow_of(sizes._replace(context=self.card.dimensions.context))
        self._check_flow(path)

    def _check_flow(self, path: Path) -> None:
        """Raises: CheckpointError, inputs or outputs are not those of the card's method."""
        wanted = {name: ["tensor(float)", *shape] for name, shape in self.flow.inputs.items()}
        found = {value.name: [value.type, *value.shape[1:]] for value in self._session.get_inputs()}
        if found != wanted:
            raise CheckpointError(f"'{path}' reads {found}, valid for {self.card.method}: {wanted}")
        names, outputs = [value.name for value in self._session.get_outputs()], list(self.flow.outputs)
        if names != [output_name(name) for name in outputs]:
            raise CheckpointError(f"'{path}' writes {names}, valid for {self.card.method}: {outputs}")

    def begin(self, frame: Array) -> dict[str, Array]:
        """See `controller.Engine`."""
        found = {}
        if "window" in self.flow.inputs:
            found["window"] = frame[:, None].repeat(inputs.HISTORY, axis=1)
        if "state" in self.flow.inputs:
            found["state"] = np.zeros((len(frame), *self.flow.inputs["state"]), np.float32)
        return found

    def __call__(
        self, values: Mapping[str, Array], carried: dict[str, Array]
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """See `controller.Engine`."""
        given = {**values, **carried}
        arrays = {name: np.ascontiguousarray(given[name]) for name in self.flow.inputs}
        results = self._session.run([output_name(name) for name in self.flow.outputs], arrays)
        found = {name: np.asarray(value) for name, value in zip(self.flow.outputs, results, strict=True)}
        return found, {name: found.pop(name) for name in carried}


def seal(data: bytes) -> bytes:
    """The SHA-256 of a model as one more entry of its metadata, to be appended to its bytes.

    A message of protocol buffers may be continued by further fields, so that the digest can cover all bytes
    before it. Source: onnx.proto, ModelProto.metadata_props = 14, StringStringEntryProto.key = 1, value = 2.
    """

    def field(number: int, content: bytes) -> bytes:
        assert len(content) < 128  # a length in one byte
        return bytes([number << 3 | 2, len(content)]) + content

    return field(14, field(1, DIGEST) + field(2, hashlib.sha256(data).hexdigest().encode()))


def check_seal(data: bytes, path: Path) -> None:
    """Check that a file ends in the digest of what stands before; it is not parsed otherwise.

    Raises:
        CheckpointError: There is no digest, or it is that of other bytes.
    """
    size, digits = len(seal(b"")), 64
    model, end = data[:-size], data[-size:]
    if end == seal(model):
        return
    if end[:-digits] != seal(b"")[:-digits]:
        raise CheckpointError(
            f"'{path}' is not an ONNX file that can be run here: it carries no card and digest at its end, "
            "so it was cut short or not exported by this version of wbc-bench"
        )
    raise CheckpointError(
        f"'{path}' is altered: SHA-256 {hashlib.sha256(model).hexdigest()[:12]} of {len(model)} bytes, "
        f"it says {end[-digits:][:12].decode(errors='replace')}"
    )


def output_name(name: str) -> str:
    return name if name == "action" else f"next_{name}"
