"""An ONNX file from the weights of a PyTorch checkpoint, which has a network's numbers but not its graph.

The files are read without unpickling: no code in them runs.
"""

import re
from collections import defaultdict
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import ControllerError, missing_extra
from wbc_bench.readers import is_file

Activation = Literal["Elu", "Relu", "Tanh", "Selu", "LeakyRelu"]  # names of ONNX operators
LARGEST = 1 << 28  # [B] of a checkpoint
EPSILON = 1e-2  # added to the deviation; source: rsl_rl, EmpiricalNormalization
OPSET, IR_VERSION = 17, 8


class Perceptron(NamedTuple):
    """Layers of a policy, after a normalizer of its inputs where there is one."""

    layers: list[tuple[NDArray[np.float32], NDArray[np.float32]]]  # weight (out, in) and bias (out,) of each
    mean: NDArray[np.float32] | None  # (in,)
    std: NDArray[np.float32] | None  # (in,)
    others: list[str]  # networks of the checkpoint that are no part of it


def read_perceptron(path: Path) -> Perceptron:
    """Read the policy of a checkpoint: the only chain of layers, or that of the actor.

    Raises:
        ControllerError: The file cannot be read, is no state dict, or has no such chain, or several.
    """
    tensors = _tensors(path)
    chains: dict[str, dict[int, str]] = defaultdict(dict)
    for name, value in tensors.items():
        match = re.fullmatch(r"(.*?)(\d+)\.weight", name)
        if match and value.ndim == 2:
            chains[match[1]][int(match[2])] = name
    actors = [prefix for prefix in chains if "actor" in prefix] or [
        prefix for prefix in chains if "critic" not in prefix and "value" not in prefix
    ]
    if len(actors) != 1:
        names = ", ".join(repr(prefix.rstrip(".")) for prefix in sorted(actors or chains)) or "none"
        raise ControllerError(
            f"checkpoint '{path}' has the chains of layers {names}, valid: one of an actor, as in rsl_rl"
        )
    chosen = actors[0]
    layers = []
    for _, name in sorted(chains[chosen].items()):
        weight, bias = tensors[name], tensors.get(f"{name.removesuffix('weight')}bias")
        if (
            bias is None
            or bias.shape != weight.shape[:1]
            or (layers and layers[-1][0].shape[0] != weight.shape[1])
        ):
            raise ControllerError(
                f"checkpoint '{path}': layer '{name}' does not follow the one before, or has no bias"
            )
        layers.append((weight, bias))
    mean, std = _normalizer(tensors, layers[0][0].shape[1])
    return Perceptron(layers, mean, std, sorted(prefix.rstrip(".") for prefix in chains if prefix != chosen))


def onnx_of(network: Perceptron, activation: Activation) -> bytes:
    """The graph of a policy: normalizer, layers with `activation` between them; `obs` -> `actions`.

    Raises: ControllerError without onnx.
    """
    try:
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise ControllerError(missing_extra("a policy of a checkpoint", "policy", error)) from error
    nodes, constants, last = [], {}, "obs"
    if network.mean is not None and network.std is not None:
        constants |= {"mean": network.mean, "scale": network.std + np.float32(EPSILON)}
        nodes += [helper.make_node("Sub", [last, "mean"], ["centred"])]
        nodes += [helper.make_node("Div", ["centred", "scale"], ["normalized"])]
        last = "normalized"
    for k, (weight, bias) in enumerate(network.layers):
        end = k == len(network.layers) - 1
        constants |= {f"weight_{k}": weight, f"bias_{k}": bias}
        out = "actions" if end else f"layer_{k}"
        nodes.append(helper.make_node("Gemm", [last, f"weight_{k}", f"bias_{k}"], [out], transB=1))
        if not end:
            nodes.append(helper.make_node(activation, [out], [f"hidden_{k}"]))
        last = f"hidden_{k}"
    shapes = {"obs": network.layers[0][0].shape[1], "actions": network.layers[-1][0].shape[0]}
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", shapes[name]])] for name in shapes
    ]
    tensors = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "policy", ends[0], ends[1], tensors)
    opset = [helper.make_opsetid("", OPSET)]
    return helper.make_model(graph, opset_imports=opset, ir_version=IR_VERSION).SerializeToString()


def _tensors(path: Path) -> dict[str, NDArray[np.float32]]:
    """All tensors of a checkpoint by their dotted names."""
    try:
        import torch
    except ImportError as error:
        raise ControllerError(missing_extra("a PyTorch checkpoint", "learned", error)) from error
    valid = "a state dict of PyTorch, of tensors and plain values alone"
    if not is_file(path):
        raise ControllerError(f"checkpoint '{path}' is no file, valid: {valid}")
    if path.stat().st_size > LARGEST:
        raise ControllerError(
            f"checkpoint '{path}' has {path.stat().st_size} bytes, valid: at most {LARGEST}"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of many kinds: no zip, a pickle with code in it, a damaged tensor
        raise ControllerError(f"checkpoint '{path}' cannot be read, valid: {valid}") from error
    found: dict[str, NDArray[np.float32]] = {}
    queue: list[tuple[str, Any]] = [("", content)]
    while queue:
        name, value = queue.pop()
        if isinstance(value, dict):
            queue += [(f"{name}.{key}" if name else str(key), part) for key, part in value.items()]
        elif isinstance(value, torch.Tensor) and value.is_floating_point() and "optimizer" not in name:
            found[name] = value.detach().to(torch.float32).contiguous().numpy()
    if not found:
        raise ControllerError(f"checkpoint '{path}' has no tensors, valid: {valid}")
    return found


def _normalizer(
    tensors: dict[str, NDArray[np.float32]], width: int
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Mean and deviation of the policy's inputs, (width,) each, where the checkpoint has them."""
    for name, mean in tensors.items():
        if name.endswith("_mean") and "critic" not in name and mean.size == width:
            stem = name.removesuffix("_mean")
            std, var = tensors.get(f"{stem}_std"), tensors.get(f"{stem}_var")
            if std is None and var is not None:
                std = np.sqrt(var)
            if std is not None and std.size == width:
                return mean.reshape(-1), std.reshape(-1)
    return None, None
