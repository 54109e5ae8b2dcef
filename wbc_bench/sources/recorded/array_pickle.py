"""Arrays of a pickle, read without unpickling: nothing of the file is ever imported or called.

`pickle.load` runs what a file says. Here the opcodes are decoded by `pickletools`, which executes nothing,
and a small stack machine knows those of lists, dicts, tuples, numbers and texts, and the few calls with which
numpy writes an array. Those build stand-ins of our own; everything else of a file is refused by its name.
"""

import math
import pickletools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wbc_bench.errors import SourceError
from wbc_bench.readers import read_bytes, reading

KIND = "trajectories"
MAX_OPCODES = 1_000_000  # 200 episodes of 7 arrays take 40,000
MAX_DIMENSIONS = 8

_NUMPY = ("numpy", "numpy.core.multiarray", "numpy._core.multiarray", "numpy._core.numeric")
_NUMPY += ("numpy.core.numeric",)
_CALLS = {  # names that numpy writes into a pickle; none of them is looked up
    *((module, name) for module in _NUMPY for name in ("_reconstruct", "ndarray", "dtype", "scalar")),
    *((module, "_frombuffer") for module in _NUMPY),
    ("_codecs", "encode"),  # of bytes, in protocol 2
    ("__builtin__", "bytes"),  # of none, there
}


@dataclass
class _Name:
    """A name of the file that is known, in the place of what it names."""

    name: str


@dataclass
class _Type:
    """The type of an array's numbers."""

    code: str
    order: str = "="

    @property
    def numpy(self) -> np.dtype:
        """Raises: ValueError, no plain numbers."""
        kind = np.dtype(self.code).newbyteorder(self.order)  # pyright: ignore[reportArgumentType]
        if kind.kind not in "biuf" or kind.itemsize > 8:
            raise ValueError(f"numbers of type '{self.code[:20]}', valid: plain ones of at most 8 bytes")
        return kind


@dataclass
class _Array:
    """An array as its file describes it, not yet made."""

    shape: tuple[int, ...] = ()
    kind: _Type = field(default_factory=lambda: _Type("u1"))
    data: bytes = b""
    order: Any = "C"

    @property
    def numpy(self) -> np.ndarray:
        """Raises: ValueError, the bytes are not those of the shape."""
        shape, kind = self.shape, self.kind.numpy
        sizes = all(type(size) is int and 0 <= size < 1 << 40 for size in shape)
        if not sizes or len(shape) > MAX_DIMENSIONS or math.prod(shape) * kind.itemsize != len(self.data):
            raise ValueError(f"an array of {len(self.data)} bytes is not of its shape")
        return np.frombuffer(self.data, kind).reshape(shape, order=self.order)


class _Mark:
    """Where the items of a list, dict or tuple begin."""


def load(path: Path) -> Any:
    """The value of a pickle: lists, dicts of texts, tuples, numbers, texts, bytes and arrays, see `array`.

    Raises: SourceError, the file is missing, damaged, too large, or holds anything else.
    """
    data = read_bytes(path, KIND, SourceError)
    with reading(KIND, path, "a pickle of arrays, dicts, lists and numbers", SourceError):
        return _run(data)


def array(value: Any, path: Path, what: str) -> np.ndarray:
    """An array that `load` found, and the caller calls `what`. Raises: SourceError, it is none."""
    if not isinstance(value, _Array):
        raise SourceError(f"{KIND} '{path}': {what} is no array of numpy")
    with reading(f"{KIND} '{path}':", what, "an array of plain numbers", SourceError):
        return value.numpy


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_LITERALS = {"BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE"}
_LITERALS |= {"BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"}
_EMPTY = {"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def _run(data: bytes) -> Any:
    """Raises: ValueError and others, the file is damaged or holds what is not allowed."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for count, (opcode, value, _) in enumerate(pickletools.genops(data)):
        if count > MAX_OPCODES:
            raise ValueError(f"more than {MAX_OPCODES} opcodes")
        name: str = opcode.name
        if name in ("PROTO", "FRAME"):
            continue
        if name == "STOP":
            return stack.pop()
        if name in _LITERALS:
            stack.append(value)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _EMPTY:
            stack.append(_EMPTY[name]())
        elif name in _TUPLES:
            stack.append(tuple(_pop(stack, _TUPLES[name])))
        elif name == "TUPLE":
            stack.append(tuple(_items(stack)))
        elif name == "MARK":
            stack.append(_Mark)
        elif name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
            memo[len(memo) if name == "MEMOIZE" else int(value or 0)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(memo[int(value or 0)])
        elif name in ("APPEND", "APPENDS"):
            items = _items(stack) if name == "APPENDS" else _pop(stack, 1)
            _of(stack, list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            items = _items(stack) if name == "SETITEMS" else _pop(stack, 2)
            keys = items[::2]
            if not all(type(key) in (str, int) for key in keys):  # others may hash for ever
                raise ValueError("a dict with keys that are neither texts nor integers")
            _of(stack, dict).update(zip(keys, items[1::2], strict=True))
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            words = value.split(" ", 1) if isinstance(value, str) else _pop(stack, 2)
            stack.append(_known(*words))
        elif name == "REDUCE":
            call, arguments = _pop(stack, 2)
            stack.append(_call(call, arguments))
        elif name == "BUILD":
            (state,) = _pop(stack, 1)
            _build(stack[-1], state)
        else:
            raise ValueError(f"opcode {name}, which no pickle of arrays needs")
    raise ValueError("it has no end")


def _pop(stack: list[Any], count: int) -> list[Any]:
    items = stack[-count:]
    if len(items) < count or any(item is _Mark for item in items):
        raise ValueError("a value is missing")
    del stack[-count:]
    return items


def _items(stack: list[Any]) -> list[Any]:
    """What stands above the last mark, and remove both."""
    items = []
    while (item := stack.pop()) is not _Mark:
        items.append(item)
    return items[::-1]


def _of(stack: list[Any], kind: type) -> Any:
    if type(stack[-1]) is not kind:
        raise ValueError(f"items of what is no {kind.__name__}")
    return stack[-1]


def _known(module: Any, name: Any) -> _Name:
    if (module, name) not in _CALLS:
        raise ValueError(f"it names '{str(module)[:60]}.{str(name)[:60]}', which is not called here")
    return _Name(name)


def _call(call: Any, arguments: Any) -> Any:
    """What a known name makes of its arguments: our own stand-ins. Raises: ValueError."""
    match call, arguments:
        case _Name("_reconstruct"), (_Name("ndarray"), _, _):
            return _Array()
        case _Name("dtype"), (str(code), *_):
            return _Type(code)
        case _Name("scalar"), (_Type() as kind, bytes(data)):
            return _Array((), kind, data).numpy.item()
        case _Name("_frombuffer"), (
            bytes() | bytearray() as data,
            _Type() as kind,
            tuple(shape),
            "C" | "F" as order,
        ):
            return _Array(shape, kind, bytes(data), order)
        case _Name("encode"), (str(text), "latin1"):
            return text.encode("latin1")
        case _Name("bytes"), ():
            return b""
    raise ValueError("a call that no array needs")


def _build(made: Any, state: Any) -> None:
    """Give a stand-in its state, as numpy writes it. Raises: ValueError."""
    match made, state:
        case _Type(), (int(), "<" | ">" | "|" | "=" as order, None, None, None, *_):
            made.order = order
        case _Array(), (int(), tuple(shape), _Type() as kind, bool(fortran), bytes(data)):
            made.shape, made.kind, made.data = shape, kind, data
            made.order = "F" if fortran else "C"
        case _:
            raise ValueError("a state that is none of an array")
