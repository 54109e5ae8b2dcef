"""ONNX files of one layer each, and the same in NumPy, for the tests of policies by their cards."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT


def weights(seed: int, rows: int, columns: int, size: float = 0.1) -> np.ndarray:
    """Random weights, small enough that the robot stands for a while."""
    draw = np.random.default_rng(seed).normal(size=(rows, columns))
    return (size * draw / np.sqrt(rows)).astype(np.float32)


def write(path: Path, nodes: list, inputs: dict, outputs: dict, constants: dict, **metadata: str) -> Path:
    """Write a graph; inputs and outputs are name -> shape."""
    values = [
        [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in part.items()]
        for part in (inputs, outputs)
    ]
    tensors = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "small", values[0], values[1], tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, metadata)
    path.write_bytes(model.SerializeToString())
    return path


def layer(path: Path, w: np.ndarray, batch: str | int | None = "batch", **metadata: str) -> Path:
    """`actions` = tanh(obs w); of vectors where `batch` is None."""
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["product"]),
        helper.make_node("Tanh", ["product"], ["actions"]),
    ]
    rows = [] if batch is None else [batch]
    shapes = {"obs": [*rows, w.shape[0]]}, {"actions": [*rows, w.shape[1]]}
    return write(path, nodes, *shapes, {"w": w}, **metadata)


def recurrent(path: Path, w: np.ndarray, u: np.ndarray, batch: str | int = "batch") -> Path:
    """`h_out` = tanh(obs w + h_in u), also written as `latent`; the state has its batch on axis 1."""
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["product"]),
        helper.make_node("Squeeze", ["h_in", "first"], ["h"]),
        helper.make_node("MatMul", ["h", "u"], ["carried"]),
        helper.make_node("Add", ["product", "carried"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["latent"]),
        helper.make_node("Unsqueeze", ["latent", "first"], ["h_out"]),
    ]
    size = u.shape[0]
    shapes = (
        {"obs": [batch, w.shape[0]], "h_in": [1, batch, size]},
        {"latent": [batch, size], "h_out": [1, batch, size]},
    )
    return write(path, nodes, *shapes, {"w": w, "u": u, "first": np.array([0], dtype=np.int64)})


def strip(path: Path, out: Path) -> Path:
    """A graph without what its exporter wrote beside it."""
    model = onnx.load(path)
    del model.metadata_props[:]
    out.write_bytes(model.SerializeToString())
    return out


def front(path: Path, frames: int, width: int) -> Path:
    """What another stack may have in front of a network.

    `command` (9) of `goal` (7), a position and a quaternion wxyz. Of `past`, frames of the oldest first:
    `newest` (width), its columns `body` (34) and `hand` (9), and `window` (frames, width), one step older.
    """
    nodes: list = []
    constants: dict[str, np.ndarray] = {}
    constants["one"], constants["two"] = np.array([[1.0], [2.0]], dtype=np.float32)

    def node(operator: str, *inputs: str, **attributes) -> str:
        name = f"v{len(nodes)}"
        nodes.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def integers(*values: int) -> str:
        name = f"i{len(constants)}"
        constants[name] = np.array(values, dtype=np.int64)
        return name

    def part(source: str, start: int, stop: int, axis: int = 1) -> str:
        return node("Slice", source, integers(start), integers(stop), integers(axis))

    w, x, y, z = (part("goal", k, k + 1) for k in range(3, 7))

    def twice(a: str, b: str, operator: str, c: str, d: str) -> str:
        return node("Mul", "two", node(operator, node("Mul", a, b), node("Mul", c, d)))

    first = [node("Sub", "one", twice(y, y, "Add", z, z)), twice(x, y, "Add", w, z), twice(x, z, "Sub", w, y)]
    second = [
        twice(x, y, "Sub", w, z),
        node("Sub", "one", twice(x, x, "Add", z, z)),
        twice(y, z, "Add", w, x),
    ]
    shaped = node("Reshape", "past", integers(-1, frames, width))
    nodes.append(helper.make_node("Concat", [part("goal", 0, 3), *first, *second], ["command"], axis=1))
    older = [part(shaped, 0, 1), part(shaped, 0, frames - 1)]
    nodes.append(helper.make_node("Concat", older, ["window"], axis=1))
    last = part(shaped, frames - 1, frames)
    nodes.append(helper.make_node("Squeeze", [last, integers(1)], ["newest"]))
    for name, start, stop in (("body", 0, 34), ("hand", 48, 57)):
        nodes.append(helper.make_node("Identity", [part("newest", start, stop)], [name]))
    shapes = (
        {"goal": ["batch", 7], "past": ["batch", frames * width]},
        {
            **{"command": ["batch", 9], "newest": ["batch", width], "window": ["batch", frames, width]},
            **{"body": ["batch", 34], "hand": ["batch", 9]},
        },
    )
    return write(path, nodes, *shapes, constants)
