"""Where code of a controller runs: its faults are one line, and global random streams are its own.

It may draw from those of Python, NumPy and PyTorch without knowing. Its results must then depend neither on
what ran before in the process nor on how many workers there are, and must not change what others draw.
"""

# ruff: noqa: NPY002  (the legacy generator is what is kept apart here)
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from wbc_bench.errors import BenchError, ControllerError, fault_of


class GlobalRandomness:
    """Streams of one user of the global generators, which begin at a seed and go on where they were left.

    PyTorch's begins at the seed when it is imported before they are used; whoever imports it inside finds it
    unseeded until the next time. So `registry` makes a controller that imports it a second time.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._inside: dict[str, Any] | None = None

    @contextmanager
    def own(self) -> Iterator[None]:
        """Inside, the global generators are this user's; afterwards they are as they were."""
        outside = _states()
        try:
            if self._inside is None:
                random.seed(self._seed)
                np.random.seed(self._seed % 2**32)
                self._inside = {name: state for name, state in _states().items() if name != "torch"}
            self._restore(self._inside)
            yield
        finally:
            self._inside = _states()
            self._restore(outside)

    def _restore(self, states: dict[str, Any]) -> None:
        random.setstate(states["random"])
        np.random.set_state(states["numpy"])
        torch: Any = sys.modules.get("torch")
        if "torch" in states:
            torch.random.set_rng_state(states["torch"])
        elif torch is not None:  # imported since; by itself it begins at the entropy of the machine
            torch.random.manual_seed(self._seed)


@contextmanager
def blamed(doing: str, randomness: GlobalRandomness | None = None) -> Iterator[None]:
    """Where a controller's code runs; what it raises, `SystemExit` too, comes back with its own frames.

    Args:
        doing: What fails when it fails, e.g. "controller 'mine' failed in `act`".
        randomness: Its global random streams; new ones when not given.

    Raises:
        ControllerError: It raised what is no `BenchError`.
        KeyboardInterrupt: It raised one, or the user did: a worker knows. The line is its note.
    """
    try:
        with (randomness or GlobalRandomness(0)).own():
            yield
    except BenchError:
        raise
    except KeyboardInterrupt as error:
        error.add_note(f"{doing}: {fault_of(error)}")
        raise
    except BaseException as error:
        raise ControllerError(f"{doing}: {fault_of(error)}") from error


class _Alone(SourceFileLoader):
    """Imports a module with global random streams of its own, which begin anew."""

    def exec_module(self, module: ModuleType) -> None:
        with GlobalRandomness(0).own():
            super().exec_module(module)


class _UsersModules(MetaPathFinder):
    """Finds the modules of folders of users, to be imported alone.

    What one of them draws at its import then depends neither on who imported it first nor on what that one
    drew before, and shifts nothing for whoever imports it, at the top or in the midst of a function.
    """

    def __init__(self) -> None:
        self.folders: set[str] = set()

    def find_spec(self, fullname: str, path: Any = None, target: ModuleType | None = None) -> Any:
        places = [place for place in sys.path if place in self.folders] if path is None else path
        spec = PathFinder.find_spec(fullname, places, target)
        if spec is None or type(spec.loader) is not SourceFileLoader:
            return None
        if not any(Path(spec.loader.path).is_relative_to(folder) for folder in self.folders):
            return None
        spec.loader = _Alone(spec.loader.name, spec.loader.path)
        return spec


_USERS_MODULES = _UsersModules()


def import_alone_from(folder: str) -> None:
    """Have modules below a folder found first, and imported with random streams of their own."""
    _USERS_MODULES.folders.add(folder)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    if _USERS_MODULES not in sys.meta_path:
        sys.meta_path.insert(0, _USERS_MODULES)


def _states() -> dict[str, Any]:
    states = {"random": random.getstate(), "numpy": np.random.get_state()}
    torch = sys.modules.get("torch")  # never imported for this alone: it takes a second
    if torch is not None:
        states["torch"] = torch.random.get_rng_state()
    return states
