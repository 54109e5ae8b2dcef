"""Reading the tensors of a network; torch is imported, so that only what has networks may import this."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from safetensors.torch import load
from torch import Tensor

from wbc_bench.errors import BenchError
from wbc_bench.readers import reading


def decode_tensors(
    data: bytes, path: Path | str, kind: str, error: type[BenchError], wanted: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The tensors of the bytes of a safetensors file, which must be those of a network.

    Args:
        data: Bytes of the file.
        path: Where they came from.
        kind: What the file is.
        error: The error to raise.
        wanted: The tensors of the network: names, shapes and types must match, one to one.

    Raises:
        BenchError: `error`: no safetensors, other names, shapes or types, or a number that is not finite.
    """
    with reading(kind, path, "a safetensors file", error):
        tensors = load(data)

    def refuse(problem: str, names: Iterable[str]) -> None:
        if names := sorted(names):
            raise error(f"{kind} '{path}': {problem} {', '.join(names[:3])} ({len(names)} in all)")

    refuse("it lacks", wanted.keys() - tensors.keys())
    refuse("it has tensors that the method does not know,", tensors.keys() - wanted.keys())
    shapes = {n: (tuple(tensors[n].shape), tuple(value.shape)) for n, value in wanted.items()}
    refuse("wrong shape of", [f"{n} {a}, valid: {b}" for n, (a, b) in shapes.items() if a != b])
    types = {n: (tensors[n].dtype, value.dtype) for n, value in wanted.items()}
    refuse("wrong type of", [f"{n} {a}, valid: {b}" for n, (a, b) in types.items() if a != b])
    refuse("not a number in", [name for name, value in tensors.items() if not value.isfinite().all()])
    return tensors
