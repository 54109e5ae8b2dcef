"""Errors a user can cause. Each is one line: the value, what is valid, and where it came from."""

import difflib
import traceback
from collections.abc import Iterable
from pathlib import Path


class BenchError(Exception):
    """A mistake in the input; the command line prints it in one line and exits with code 2."""

    def __str__(self) -> str:
        """One line, also where a name from a file holds line breaks or control characters."""
        return "".join(c if c.isprintable() else " " for c in super().__str__())


class UnknownNameError(BenchError):
    """A name that is not in a list of valid ones, with the nearest of them."""

    def __init__(self, kind: str, name: str, valid: Iterable[str], where: str) -> None:
        self._arguments = (kind, name, tuple(valid), where)
        names = sorted(self._arguments[2])
        near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        super().__init__(f"unknown {kind} '{name}' ({where}): {hint}valid: {', '.join(names) or 'none'}")

    def __reduce__(self):
        return type(self), self._arguments  # so that it crosses from a worker process


class ProtocolError(BenchError):
    """A protocol file that cannot be read or asks for the impossible."""


class ManifestError(BenchError):
    """A manifest that is missing, altered, or does not belong to its protocol."""


class ControllerError(BenchError):
    """A controller that cannot be loaded or breaks the interface."""


class StoreError(BenchError):
    """A results folder that cannot be used, or records that must not be mixed."""


class SourceError(BenchError):
    """A source of targets that cannot be read or opened, or a target that is none."""


LONGEST_TEXT = 500  # characters of somebody else's message

_PACKAGES = {  # distribution of a module that has another name
    "imageio_ffmpeg": "imageio-ffmpeg",
    "mujoco_warp": "mujoco-warp",
    "pink": "pin-pink",
    "pinocchio": "pin",
    "rerun": "rerun-sdk",
    "rsl_rl": "rsl-rl-lib",
    "sklearn": "scikit-learn",
    "warp": "warp-lang",
    "zmq": "pyzmq",
}


def missing_extra(what: str, extra: str, error: ImportError) -> str:
    """An import that failed because an optional part is not installed, in one line with the remedy.

    Args:
        what: The thing that cannot be used, e.g. "a film".
        extra: Optional dependency group of wbc-bench that brings the package.
        error: The failed import.
    """
    module = (error.name or "").partition(".")[0]
    package = f"the package {_PACKAGES.get(module, module)}" if module else "more packages"
    return f"{what} needs {package}: pip install 'wbc-bench[{extra}]' ({error})"


def fault_of(error: BaseException) -> str:
    """An exception of somebody else's code in one line, with the frames that lead to it.

    Frames of the harness are left out: `KeyError: 'x' (mine.py:23 in act > helper.py:4 in scale)`.
    """
    frames = [
        f"{Path(frame.filename).name}:{frame.lineno} in {frame.name}"
        for frame in traceback.extract_tb(error.__traceback__)
        if not Path(frame.filename).is_relative_to(Path(__file__).parent)
        and not frame.filename.startswith("<frozen ")
        and "importlib" not in Path(frame.filename).parts
    ]
    try:
        text = " ".join(str(error).split())
    except Exception:  # an exception whose text raises
        text = "(it cannot say what)"
    if len(text) > LONGEST_TEXT:
        text = f"{text[:LONGEST_TEXT]}..."
    hint = "; a signal that `info.signals` does not declare is None" if "'NoneType' object" in text else ""
    return f"{type(error).__name__}: {text}{hint}" + (f" ({' > '.join(frames[-4:])})" if frames else "")
