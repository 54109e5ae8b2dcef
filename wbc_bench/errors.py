"""Errors a user can cause. Each is one line: the value, what is valid, and where it came from."""

import difflib
from collections.abc import Iterable


class BenchError(Exception):
    """A mistake in the input; the command line prints it in one line and exits with code 2."""


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
