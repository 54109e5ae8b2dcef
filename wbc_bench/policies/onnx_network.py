"""ONNX files of others, run by onnxruntime on one thread; nothing in a file is executed but its graph."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wbc_bench.errors import ControllerError, missing_extra
from wbc_bench.policies.card import NetworkCard, StateCard
from wbc_bench.readers import read_bytes, reading

Array = NDArray[np.float64]
LARGEST = 1 << 20  # numbers of one row of an input or a state
PICKLED = (b"PK\x03\x04", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05")  # of torch.save and pickle


class OnnxNetwork:
    """One graph with the state that it hands to itself.

    A graph that was exported for a batch of one, or for vectors without a batch axis, is run row by row.
    """

    def __init__(self, card: NetworkCard, folder: Path, widths: dict[str, int], where: str) -> None:
        """`widths` are the numbers of columns of the values that are known before it; its own are added.

        Raises: ControllerError, the file cannot be run, or its inputs and outputs are not those of the card.
        """
        self.card, self.path, self._where = card, folder / card.file, f"{where}: network '{card.file}'"
        self._session = open_session(self.path)
        self._inputs = {value.name: value for value in self._session.get_inputs()}
        self._outputs = {value.name: value for value in self._session.get_outputs()}
        states = {state.input: state for state in card.state}
        self._same_names("inputs", [*card.inputs, *states], list(self._inputs))
        for name in [*card.outputs, *(state.output for state in card.state)]:
            if name not in self._outputs:
                self._refuse(f"has no output '{name}'", ", ".join(self._outputs))
        axes = {name: 0 for name in card.inputs} | {name: state.batch_axis for name, state in states.items()}
        self._shapes = {name: self._shape(name, axis) for name, axis in axes.items()}
        fixed = [name for name, axis in axes.items() if isinstance(self._inputs[name].shape[axis], int)]
        self._by_row = bool(fixed)
        self._check_outputs()
        for name in card.inputs:
            self._check_width(name, widths)
        for state in card.state:
            if state.initial and self._size(state.input) % widths[state.initial]:
                self._refuse(
                    f"state '{state.input}' is filled with '{state.initial}'", "a whole number of frames"
                )
        self._state: dict[str, Array] = {}
        widths.update({value: self._width_of(output) for output, value in card.outputs.items()})

    @property
    def widths(self) -> dict[str, int]:
        """Numbers that each input of the graph has."""
        return {name: self._size(name) for name in self._shapes}

    def reset(self) -> None:
        """Begin with new states."""
        self._state = {}

    def __call__(self, values: dict[str, Array]) -> dict[str, Array]:
        """What it writes, of values (N, width); the state moves on."""
        given = {}
        for name, sources in self.card.inputs.items():
            sources = (sources,) if isinstance(sources, str) else sources
            given[name] = np.concatenate([values[source] for source in sources], axis=1).astype(np.float32)
        count = len(next(iter(given.values())))
        if not self._state:
            self._state = {state.input: self._first(state, values, count) for state in self.card.state}
        given |= self._state
        names = [*self.card.outputs, *(state.output for state in self.card.state)]
        if self._by_row:
            rows = [
                self._run(names, {name: array[k : k + 1] for name, array in given.items()})
                for k in range(count)
            ]
            found = [np.concatenate(parts) for parts in zip(*rows, strict=True)]
        else:
            found = self._run(names, given)
        results = dict(zip(names, found, strict=True))
        for state in self.card.state:
            self._state[state.input] = results[state.output].reshape(count, -1)
        return {
            value: results[output].reshape(count, -1).astype(np.float64)
            for output, value in self.card.outputs.items()
        }

    def _run(self, names: list[str], rows: dict[str, Array]) -> list[Array]:
        """Outputs (N, ...) of rows (N, width)."""
        states, given = {state.input: state for state in self.card.state}, {}
        for name, array in rows.items():
            shaped = array.reshape(len(array), *self._shapes[name])
            axis = states[name].batch_axis if name in states else 0
            shaped = shaped[0] if _is_vector(self._inputs[name]) else np.moveaxis(shaped, 0, axis)
            given[name] = np.ascontiguousarray(shaped, dtype=np.float32)
        try:
            found = self._session.run(names, given)
        except Exception as error:  # onnxruntime has exceptions of its own
            text = " ".join(str(error).split())[:300]
            raise ControllerError(f"{self._where} cannot be run: {text}") from error
        axes = [0] * len(self.card.outputs) + [state.batch_axis for state in self.card.state]
        count = len(next(iter(rows.values())))
        return [
            np.moveaxis(np.asarray(array), axis, 0).reshape(count, -1)
            for array, axis in zip(found, axes, strict=True)
        ]

    def _first(self, state: StateCard, values: dict[str, Array], count: int) -> Array:
        size = self._size(state.input)
        if not state.initial:
            return np.zeros((count, size))
        frame = values[state.initial]
        return np.tile(frame, (1, size // frame.shape[1]))

    def _shape(self, name: str, axis: int) -> tuple[int, ...]:
        """The shape of one row of an input."""
        value = self._inputs[name]
        if value.type != "tensor(float)":
            self._refuse(f"input '{name}' is of type {value.type}", "tensor(float)")
        if not 0 <= axis < max(len(value.shape), 1):
            self._refuse(
                f"'{name}' has shape {value.shape} and `batch_axis` is {axis}", "an axis that it has"
            )
        batch = value.shape[axis] if value.shape else None
        vector = _is_vector(value)
        if isinstance(batch, int) and batch != 1 and not vector:
            self._refuse(f"input '{name}' is made for {batch} robots", "a variable batch, or one of 1")
        rest = [size for k, size in enumerate(value.shape) if k != axis or vector]
        if (
            not all(isinstance(size, int) and size > 0 for size in rest)
            or np.prod(rest, dtype=float) > LARGEST
        ):
            self._refuse(f"input '{name}' has shape {value.shape}", "one variable axis, and fixed others")
        return tuple(rest)

    def _size(self, name: str) -> int:
        return int(np.prod(self._shapes[name], dtype=int))

    def _width_of(self, output: str) -> int:
        """Columns of an output; 0 where the graph does not say."""
        value = self._outputs[output]
        rest = value.shape if _is_vector(value) else value.shape[1:]
        return int(np.prod(rest)) if all(isinstance(size, int) for size in rest) else 0

    def _check_width(self, name: str, widths: dict[str, int]) -> None:
        sources = self.card.inputs[name]
        parts = {s: widths[s] for s in ((sources,) if isinstance(sources, str) else sources)}
        if 0 not in parts.values() and sum(parts.values()) != self._size(name):
            told = " + ".join(f"{source} {width}" for source, width in parts.items())
            raise ControllerError(
                f"{self._where} reads {self._size(name)} numbers as '{name}', the card gives "
                f"{sum(parts.values())}: {told}"
            )

    def _check_outputs(self) -> None:
        """Refuse outputs that are not one row for each robot. Raises: ControllerError."""
        axes = [(name, 0) for name in self.card.outputs]
        axes += [(state.output, state.batch_axis) for state in self.card.state]
        for name, axis in axes:
            value = self._outputs[name]
            if axis >= len(value.shape):
                self._refuse(f"output '{name}' has shape {value.shape}", f"one with a batch on axis {axis}")
            if _is_vector(value) and not self._by_row:
                self._refuse(
                    f"output '{name}' has shape {value.shape} for all robots", "a row for each, as the inputs"
                )
        for state in self.card.state:
            given, wanted = self._outputs[state.output].shape, self._inputs[state.input].shape
            known = [one for one in (given, wanted) if all(isinstance(size, int) for size in one)]
            if len(known) == 2 and np.prod(given, dtype=float) != np.prod(wanted, dtype=float):
                self._refuse(
                    f"state '{state.input}' has shape {wanted}, its output '{state.output}' {given}",
                    "equal shapes",
                )

    def _same_names(self, what: str, given: list[str], wanted: list[str]) -> None:
        if sorted(given) != sorted(wanted):
            self._refuse(
                f"has {what} {', '.join(wanted)}, the card names {', '.join(given)}", "all of them, once"
            )

    def _refuse(self, problem: str, valid: str) -> None:
        raise ControllerError(f"{self._where} {problem}, valid: {valid}")


def _is_vector(value) -> bool:
    """Whether an input or output of a graph is that of one robot, without a batch axis."""
    return len(value.shape) == 1 and isinstance(value.shape[0], int)


def open_session(path: Path):
    """A session of an ONNX file, on one thread.

    Raises: ControllerError, onnxruntime is not installed, or the file is missing, too large, pickled, or no
        graph that can be run.
    """
    try:
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise ControllerError(missing_extra("a policy by its card", "policy", error)) from error
    data = read_bytes(path, "policy", ControllerError)
    if data.startswith(PICKLED):
        raise ControllerError(
            f"policy '{path}' is a pickled file, which could execute code and is not read, valid: an ONNX "
            "file, exported with torch.onnx.export where it was trained"
        )
    with reading("policy", path, "an ONNX file that can be run", ControllerError):
        session = _session(data)
        # names, also those of axes, may be no text, which is found when they are asked for
        _ = [(v.name, v.type, v.shape) for v in (*session.get_inputs(), *session.get_outputs())]
        _ = session.get_modelmeta().custom_metadata_map
        return session


@lru_cache(maxsize=4)
def _session(data: bytes):
    """A session of the bytes of a file; a session has no state, so that controllers may share it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return onnxruntime.InferenceSession(data, options, ["CPUExecutionProvider"], enable_fallback=0)
