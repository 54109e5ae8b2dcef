"""The input normaliser of a graph: which mean and deviation a policy subtracts from which of its inputs."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import ControllerError, missing_extra
from wbc_bench.policies.edits import ORDERS
from wbc_bench.readers import read_bytes, reading
from wbc_bench.robot import JOINT_NAMES, NUM_LEG_JOINTS, Robot

Array = NDArray[np.float64]
_PASS = ("Identity", "Unsqueeze", "Flatten", "Cast", "Reshape", "Squeeze")
_DEPTH = 8  # nodes between an input and its normaliser


class Normalizer(NamedTuple):
    """Of one input of a graph."""

    mean: Array  # (width,)
    std: Array | None  # (width,)


def read_normalizers(path: Path, widths: dict[str, int]) -> dict[str, Normalizer]:
    """Input of a graph -> what is subtracted from it, where the graph begins with that.

    Args:
        path: ONNX file.
        widths: Numbers that each input has.

    Raises: ControllerError, the file cannot be read.
    """
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError as error:
        raise ControllerError(missing_extra("a check of a policy", "policy", error)) from error
    with reading("policy", path, "an ONNX file", ControllerError):
        graph = onnx.load_model_from_string(read_bytes(path, "policy", ControllerError)).graph
        constants = {t.name: numpy_helper.to_array(t).astype(np.float64).ravel() for t in graph.initializer}
    readers: dict[str, list] = {}
    for node in graph.node:
        for name in node.input:
            readers.setdefault(name, []).append(node)

    def constant(node, operator: str) -> Array | None:
        if node.op_type != operator or len(node.input) != 2:
            return None
        return constants.get(node.input[1])

    def search(name: str, offset: int, width: int, depth: int) -> Normalizer | None:
        for node in readers.get(name, ()):
            mean = constant(node, "Sub")
            if mean is not None and len(mean) >= offset + width:
                stds = [constant(after, "Div") for after in readers.get(node.output[0], ())]
                whole = next((std for std in stds if std is not None and len(std) == len(mean)), None)
                std = None if whole is None else whole[offset : offset + width]
                return Normalizer(mean[offset : offset + width], std)
            start = offset if node.op_type in _PASS else None
            if node.op_type == "Concat":
                before = list(node.input)[: list(node.input).index(name)]
                if all(one in widths for one in before):
                    start = offset + sum(widths[one] for one in before)
            if start is not None and depth:
                found = search(node.output[0], start, width, depth - 1)
                if found is not None:
                    return found
        return None

    found = {name: search(name, 0, width, _DEPTH) for name, width in widths.items()}
    return {name: one for name, one in found.items() if one is not None}


def asymmetry(mean: Array, names: tuple[str, ...], robot: Robot) -> float:
    """Root mean square of what mirrored legs differ by in a mean of joint positions; NaN without both legs.

    Whoever turns left as often as right has means of left and right joints that mirror each other.
    """
    half, found = NUM_LEG_JOINTS // 2, []
    for k in range(half):
        left, right = JOINT_NAMES[k], JOINT_NAMES[k + half]
        if left in names and right in names:
            sign = 1.0 if np.isclose(robot.lower[k], robot.lower[k + half]) else -1.0
            found.append(mean[names.index(left)] - sign * mean[names.index(right)])
    return float(np.sqrt(np.mean(np.square(found)))) if found else float("nan")


def symmetry_by_order(mean: Array, names: tuple[str, ...], robot: Robot) -> dict[str, float]:
    """The `asymmetry` of a mean whose columns stand for joints in each usual order, the card's first."""
    values = {"as in the card": asymmetry(mean, names, robot)}
    for text, order in ORDERS.items():
        chosen = tuple(name for name in order if name in names)
        if chosen != names:
            values[text] = asymmetry(mean, chosen, robot)
    return values
