"""Reading the tensors of a network: safetensors that hold exactly what is asked for, in float32."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import deserialize

from wbc_bench.errors import BenchError
from wbc_bench.readers import reading

TYPE = "F32"  # of safetensors


def decode_tensors(
    data: bytes, path: Path | str, kind: str, error: type[BenchError], wanted: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float32]]:
    """The tensors of the bytes of a safetensors file, which must be those of a network.

    Args:
        data: Bytes of the file.
        path: Where they came from.
        kind: What the file is.
        error: The error to raise.
        wanted: The tensors of the network by name: their shapes must match, one to one.

    Raises:
        BenchError: `error`: no safetensors, other names, shapes or types, or a number that is not finite.
    """
    with reading(kind, path, "a safetensors file", error):
        stored = dict(deserialize(data))

    def refuse(problem: str, names: Iterable[str]) -> None:
        if names := sorted(names):
            raise error(f"{kind} '{path}': {problem} {', '.join(names[:3])} ({len(names)} in all)")

    refuse("it lacks", wanted.keys() - stored.keys())
    refuse("it has tensors that the method does not know,", stored.keys() - wanted.keys())
    shapes = {name: (tuple(stored[name]["shape"]), shape) for name, shape in wanted.items()}
    refuse("wrong shape of", [f"{n} {a}, valid: {b}" for n, (a, b) in shapes.items() if a != b])
    types = {name: value["dtype"] for name, value in stored.items()}
    refuse("wrong type of", [f"{n} {found}, valid: {TYPE}" for n, found in types.items() if found != TYPE])
    tensors = {
        name: np.frombuffer(value["data"], "<f4").reshape(value["shape"]) for name, value in stored.items()
    }
    refuse("not a number in", [name for name, value in tensors.items() if not np.isfinite(value).all()])
    return tensors
