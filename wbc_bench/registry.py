"""A controller by its name: an installed one, or a class in a module or file of the user."""

import importlib
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from wbc_bench.controller import SIGNALS, Controller, ControllerInfo, PerReplicate
from wbc_bench.errors import BenchError, ControllerError, UnknownNameError
from wbc_bench.robot import Robot

ENTRY_POINTS = "wbc_bench.controllers"


def controllers() -> dict[str, EntryPoint]:
    """Installed controllers by name."""
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def load_controller(spec: str, robot: Robot) -> Controller:
    """The controller that SPEC names, built for a robot.

    SPEC is `name` or `name:variant` of an installed controller, or `module:attribute` of a user's own, the
    module importable or a file `path/to/file.py:attribute`. An installed factory is called with
    `(robot, variant)`, a user's with `(robot)`.

    Raises:
        UnknownNameError: no installed controller of that name (with the nearest names).
        ControllerError: it cannot be imported or built, or declares a signal that does not exist.
    """
    name, _, rest = spec.partition(":")
    installed = controllers()
    try:
        if name in installed:
            controller = installed[name].load()(robot, rest)
        elif rest:
            controller = _load_attribute(name, rest)(robot)
        else:
            raise UnknownNameError("controller", spec, installed, "--controller; or give module:attribute")
    except BenchError:
        raise
    except ImportError as error:
        raise ControllerError(f"controller '{spec}' cannot be imported: {error}") from error
    info = getattr(controller, "info", None)
    if not isinstance(info, ControllerInfo):
        raise ControllerError(
            f"controller '{spec}' has no `info`, valid: a wbc_bench.controller.ControllerInfo"
        )
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
    return f"{name}:{factory.of_replicate(variant, replicate)}" if isinstance(factory, PerReplicate) else spec


def _load_attribute(module: str, attribute: str):
    path = Path(module).resolve() if module.endswith(".py") else None
    if path is None:
        folder = str(Path.cwd())
    else:
        if not path.exists():
            raise ControllerError(f"controller file '{module}' does not exist")
        folder, module = str(path.parent), path.stem
    if folder not in sys.path:
        sys.path.insert(0, folder)
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
    if not hasattr(found, attribute):
        raise ControllerError(f"controller '{module}:{attribute}': module has no '{attribute}'")
    return getattr(found, attribute)
