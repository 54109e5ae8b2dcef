"""A controller by its name: an installed one, or a class in a module or file of the user."""

import importlib
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from wbc_bench import provenance
from wbc_bench.controller import SIGNALS, Controller, ControllerInfo, SeededFactory
from wbc_bench.errors import BenchError, ControllerError, UnknownNameError, fault_of
from wbc_bench.installed import controllers
from wbc_bench.isolation import GlobalRandomness
from wbc_bench.robot import Robot

ControllerFactory = Callable[[Robot], Controller]


def load_controller(spec: str, robot: Robot) -> Controller:
    """The controller that SPEC names, built for a robot.

    SPEC is `name` or `name:variant` of an installed controller, or `module:attribute` of a user's own, the
    module importable or a file `path/to/file.py:attribute`. An installed factory is called with
    `(robot, variant)`, a user's with `(robot)`.

    Raises:
        UnknownNameError: no installed controller of that name (with the nearest names).
        ControllerError: it cannot be imported or built, or declares a signal that does not exist.
    """
    had_torch = "torch" in sys.modules
    controller = _load(spec, robot)
    # imported by this controller, it was not seeded yet when the controller was made
    return controller if had_torch or "torch" not in sys.modules else _load(spec, robot)


def _load(spec: str, robot: Robot) -> Controller:
    name, _, rest = spec.partition(":")
    installed = controllers()
    with _building(spec):
        if name in installed:
            controller = installed[name].load()(robot, rest)
        elif rest:
            controller = _load_attribute(name, rest)(robot)
        else:
            raise UnknownNameError("controller", spec, installed, "--controller; or give module:attribute")
        return _checked(controller, spec)


def build_controller(source: str | bytes, robot: Robot) -> Controller:
    """The controller of a spec, or of what `pack_controller` made: an object, or what makes one of a robot.

    Raises: ControllerError, UnknownNameError, see `load_controller`.
    """
    if isinstance(source, str):
        return load_controller(source, robot)
    with _building("handed over"):
        found = pickle.loads(source)
        name = getattr(found, "__name__", type(found).__name__)
        if isinstance(found, type) or not hasattr(found, "act"):
            found = found(robot)
        return _checked(found, name)


@contextmanager
def _building(spec: str) -> Iterator[None]:
    """What a user's code raises while a controller is made of it, in one line; global seeds are its own."""
    try:
        with GlobalRandomness(0).own():
            yield
    except (BenchError, KeyboardInterrupt):
        raise
    except ImportError as error:
        raise ControllerError(f"controller '{spec}' cannot be imported: {error}") from error
    except BaseException as error:
        raise ControllerError(f"controller '{spec}' cannot be made: {fault_of(error)}") from error


def pack_controller(controller: object) -> bytes:
    """A controller, or what makes one, as bytes that cross to a worker: every shard gets a fresh copy.

    Raises: ControllerError, it holds what cannot be copied, e.g. an open file.
    """
    import cloudpickle

    try:
        return cloudpickle.dumps(controller)
    except Exception as error:  # whatever its attributes raise
        raise ControllerError(
            f"controller {type(controller).__name__} cannot be copied to workers ({error}): "
            "hand over its class, or a function of the robot that makes it"
        ) from error


def _checked(controller: Controller, spec: str) -> Controller:
    """Raises: ControllerError, UnknownNameError, it does not say what it is and reads."""
    info = getattr(controller, "info", None)
    if not isinstance(info, ControllerInfo):
        raise ControllerError(
            f"controller '{spec}' has no `info`, valid: a wbc_bench.controller.ControllerInfo"
        )
    if not isinstance(info.name, str) or not info.name.strip():
        raise ControllerError(f"controller '{spec}' has the name {info.name!r}, valid: a text, not empty")
    for signal in sorted(info.signals):
        if signal not in SIGNALS:
            raise UnknownNameError("signal", signal, SIGNALS, f"declared by controller '{spec}'")
    return controller


def spec_of_replicate(spec: str, replicate: int) -> str:
    """The spec of the controller that meets one replicate: SPEC itself, unless its factory says otherwise.

    Raises: ControllerError, the factory cannot be imported.
    """
    name, _, variant = spec.partition(":")
    if name not in (installed := controllers()):
        return spec
    try:
        factory = installed[name].load()
    except ImportError as error:
        raise ControllerError(f"controller '{spec}' cannot be imported: {error}") from error
    return f"{name}:{factory.variant_for(variant, replicate)}" if isinstance(factory, SeededFactory) else spec


def _load_attribute(module: str, attribute: str):
    path = Path(module).resolve() if module.endswith(".py") else None
    if path is None:
        folder = str(Path.cwd())
    else:
        if not path.is_file():
            raise ControllerError(f"controller file '{module}' does not exist")
        if not path.stem.isidentifier():
            raise ControllerError(
                f"controller file '{module}': '{path.stem}' is no module name, valid: letters, digits and _"
            )
        folder, module = str(path.parent), path.stem
    if folder not in sys.path:
        sys.path.insert(0, folder)
    _forget_edited()
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise UnknownNameError(
            "controller", module, controllers(), "--controller; no such module either"
        ) from error
    if path is not None and Path(found.__file__ or "").resolve() != path:
        raise ControllerError(
            f"controller file '{path}': the name '{module}' belongs to {found.__file__ or 'Python'}, "
            "give the file another"
        )
    _LOADED[module] = _state_of(module)
    if not hasattr(found, attribute):
        raise ControllerError(f"controller '{module}:{attribute}': module has no '{attribute}'")
    return getattr(found, attribute)


_LOADED: dict[str, dict[Path, int]] = {}  # a user's module -> its files when it was imported


def _state_of(module: str) -> dict[Path, int]:
    """Files of a user's module and of what it imports from its folder, with their times of change [ns]."""
    return {path: path.stat().st_mtime_ns for path in provenance.sources(module)}


def _forget_edited() -> None:
    """Have edited modules imported anew: the digest of a controller is that of the files on disk."""
    for module, files in list(_LOADED.items()):
        if module in sys.modules and _state_of(module) != files:
            del _LOADED[module]
            importlib.invalidate_caches()
            for name, loaded in list(sys.modules.items()):
                file = getattr(loaded, "__file__", None)
                if file and Path(file).resolve() in files:
                    del sys.modules[name]
