"""The sizes of every method's networks: constants, context and state, and the tensors of a checkpoint.

Training computes the networks with torch (`networks`, `estimators`), an evaluation with NumPy
(`numpy_policy`); both take their sizes from here.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_baselines.learned.policy.inputs import (
    ACTIONS,
    COMMAND,
    CONTEXT_MAX,
    HISTORY,
    HISTORY_FRAME,
    LATENT,
    NEXT_OBSERVATION,
    OBSERVATION,
    PAPER_PRIVILEGED,
    PRIVILEGED,
    VELOCITY,
)

FLOOR = 1e-2  # added to a deviation, so that a constant column is not amplified. Source: rsl-rl-lib 5.5
HIDDEN = (512, 256, 128)  # of the actor. Source: SPIRAL-EDWIN/JC_umi-on-tron @f83d62e
FEATURES = VELOCITY + 2 * LATENT  # 131, of the features, the recurrent state and e. Source: paper, III-C
DECODER = (256, 128)
# of CENet. Source: Nahrendra et al. 2023 (DreamWaQ), section III-B
CENET_WINDOW, CENET_LATENT, CENET_ENCODER, CENET_DECODER = 5, 16, (128, 64), (64, 128)
# of the Transformer. Source: SPIRAL-EDWIN/JC_umi-on-tron @f83d62e; no dropout
MODEL, LAYERS, HEADS, FEED_FORWARD = 128, 2, 8, 512
HEAD = MODEL // HEADS
NORM_FLOOR = 1e-5  # added to the variance in a layer norm. Source: torch.nn.LayerNorm

Shapes = dict[str, tuple[int, ...]]


class Sizes(NamedTuple):
    """Columns of an estimator's context, of its recurrent state, and of its latent."""

    context: int
    state: int = 0
    latent: int = 0


SIZES = {
    "none": Sizes(0),
    "cenet": Sizes(VELOCITY + CENET_LATENT, 0, CENET_LATENT),
    "gru": Sizes(CONTEXT_MAX, FEATURES, LATENT),
    "transformer": Sizes(CONTEXT_MAX, 0, LATENT),
    "transformer_gru": Sizes(CONTEXT_MAX, FEATURES, LATENT),
    "oracle": Sizes(PRIVILEGED),
}
ORACLE_CONTEXTS = (PAPER_PRIVILEGED, PRIVILEGED)  # of the first oracles, and since


class Flow(NamedTuple):
    """Names and shapes of the inputs and outputs of a policy, without the batch axis in front.

    The names are those of exported ONNX files; `term` is the newest frame of the window.
    """

    inputs: Shapes
    outputs: tuple[str, ...]  # `window` and `state` are the next step's inputs


def flow_of(sizes: Sizes) -> Flow:
    """List the inputs and outputs of a policy whose estimator has these sizes."""
    inputs: Shapes = {"observation": (OBSERVATION,), "command": (COMMAND,)}
    outputs = ["action"]
    if sizes.latent:
        inputs |= {"term": (HISTORY_FRAME,), "window": (HISTORY, HISTORY_FRAME)}
        outputs.append("window")
        if sizes.state:
            inputs["state"] = (sizes.state,)
            outputs.append("state")
    elif sizes.context:
        inputs["privileged"] = (sizes.context,)
    return Flow(inputs, tuple(outputs))


def tensor_shapes(estimator: str, context: int) -> Shapes:
    """List the tensors of a checkpoint.

    Args:
        estimator: Name of the policy's estimator.
        context: Columns of its context.

    Returns:
        Shapes by name.
    """
    size = OBSERVATION + COMMAND + context
    found = _normalizer("actor.normalizer", size) | _mlp("actor.mlp", size, *HIDDEN, ACTIONS)
    if not SIZES[estimator].latent:
        return found
    found |= _normalizer("estimator.normalizer", HISTORY_FRAME)
    if estimator == "cenet":
        inputs, encoded = CENET_WINDOW * HISTORY_FRAME, VELOCITY + 2 * CENET_LATENT
        found |= _mlp("estimator.encoder", inputs, *CENET_ENCODER, encoded)
        return found | _mlp("estimator.decoder", context, *CENET_DECODER, NEXT_OBSERVATION)
    found |= _mlp("estimator.decoder", LATENT, *DECODER, NEXT_OBSERVATION)
    found |= _linear("estimator.encoder", HISTORY_FRAME, FEATURES) if estimator == "gru" else _transformer()
    return found | _memory() if SIZES[estimator].state else found


def sinusoids(length: int, size: int) -> NDArray[np.float32]:
    """Compute positional encodings (length, size). Source: Vaswani et al. 2017, section 3.5."""
    angle = np.arange(length)[:, None] * np.exp(np.arange(0, size, 2) * (-np.log(1e4) / size))
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(length, size).astype(np.float32)


def _linear(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _mlp(name: str, *sizes: int) -> Shapes:
    found: Shapes = {}
    for k, (inputs, outputs) in enumerate(pairwise(sizes)):
        found |= _linear(f"{name}.{2 * k}", inputs, outputs)  # every other module is an activation
    return found


def _normalizer(name: str, size: int) -> Shapes:
    return {f"{name}.mean": (size,), f"{name}.std": (size,)}


def _transformer() -> Shapes:
    found = _linear("estimator.encoder.embed", HISTORY_FRAME, MODEL)
    for k in range(LAYERS):
        layer = f"estimator.encoder.layers.{k}"
        found |= _linear(f"{layer}.qkv", MODEL, 3 * MODEL) | _linear(f"{layer}.out", MODEL, MODEL)
        for norm in ("norm1", "norm2"):
            found |= {f"{layer}.{norm}.weight": (MODEL,), f"{layer}.{norm}.bias": (MODEL,)}
        found |= _linear(f"{layer}.widen", MODEL, FEED_FORWARD)
        found |= _linear(f"{layer}.narrow", FEED_FORWARD, MODEL)
    return found | _linear("estimator.encoder.read_out", MODEL, FEATURES)


def _memory() -> Shapes:
    found = _linear("estimator.memory.out", FEATURES, FEATURES)
    for part in ("ih", "hh"):  # of the input and of the state; reset, update and new gate
        found |= {f"estimator.memory.cell.weight_{part}": (3 * FEATURES, FEATURES)}
        found |= {f"estimator.memory.cell.bias_{part}": (3 * FEATURES,)}
    return found
