"""A controller by its name: an installed one, or a class in a module or file of the user."""

import importlib
import inspect
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

from wbc_bench import provenance
from wbc_bench.controller import (
    COMMAND_PARTS,
    SIGNALS,
    Controller,
    ControllerInfo,
    HasVariants,
    SeededFactory,
)
from wbc_bench.errors import ControllerError, UnknownNameError
from wbc_bench.files import real_path
from wbc_bench.installed import controllers
from wbc_bench.isolation import blamed, import_alone_from
from wbc_bench.robot import Robot

ControllerFactory = Callable[[Robot], Controller]


def load_controller(spec: str, robot: Robot) -> Controller:
    """The controller that SPEC names, built for a robot.

    SPEC is `name` or `name:variant` of an installed controller, or `module:attribute` of a user's own, the
    module importable or a file `path/to/file.py:attribute`. An installed factory is called with
    `(robot, variant)`, a user's with `(robot)`, or with `(robot, key=value, ...)` for
    `file.py:attribute?key=value&...`.

    Raises:
        UnknownNameError: no installed controller of that name, or a key that the user's factory does not take
            (with the nearest names).
        ControllerError: it cannot be imported or built, or declares a signal that does not exist.
    """
    had_torch = "torch" in sys.modules
    controller = _load(spec, robot)
    if had_torch or "torch" not in sys.modules:
        return controller
    _forget(list(_LOADED))
    return _load(spec, robot)  # imported by this controller, it was not seeded yet when that was made


def _load(spec: str, robot: Robot) -> Controller:
    name, _, rest = spec.partition(":")
    options = {}
    if name in controllers():
        factory, arguments = _installed(controllers()[name], spec), (robot, rest)
    elif rest:
        attribute, _, query = rest.partition("?")
        with _importing(spec):
            factory, arguments = _load_attribute(name, attribute), (robot,)
        options = arguments_of(query, factory, spec)
    else:
        where = "--controller; or give module:attribute"
        raise UnknownNameError("controller", spec, controllers(), where)
    # streams that begin anew: what an import draws is not drawn again where the module is loaded already
    with blamed(f"controller '{spec}' cannot be made"):
        return _checked(factory(*arguments, **options), spec)


def arguments_of(query: str, factory: Any, spec: str) -> dict[str, Any]:
    """The arguments in `key=value&...`: integers, numbers, `true`, `false`, other values are text.

    Raises:
        ControllerError: a part that is no `key=value`, or a key that is given twice.
        UnknownNameError: a key that the factory does not take.
    """
    found: dict[str, Any] = {}
    for part in query.split("&") if query else ():
        key, equals, value = part.partition("=")
        if not equals or not key.isidentifier():
            raise ControllerError(f"controller '{spec}': argument '{part}', valid: key=value, joined by &")
        if key in found:
            raise ControllerError(f"controller '{spec}': argument '{key}' is given twice, valid: once")
        found[key] = _value(value)
    with blamed(f"controller '{spec}' cannot be made"):
        parameters = list(inspect.signature(factory).parameters.values()) if found else []
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    known = [p.name for p in parameters[1:] if p.kind in named]  # the robot comes first
    if not any(parameter.kind == inspect.Parameter.VAR_KEYWORD for parameter in parameters):
        for key in found:
            if key not in known:
                raise UnknownNameError("argument", key, known, f"controller '{spec}'")
    return found


def _value(text: str) -> Any:
    for parse in (int, float):
        with suppress(ValueError):
            return parse(text)
    return {"true": True, "false": False}.get(text, text)


def _installed(point: EntryPoint, spec: str) -> Any:
    """The factory of an installed controller. Raises: ControllerError, it cannot be imported."""
    with _importing(spec):
        return point.load()


def build_controller(source: str | bytes, robot: Robot) -> Controller:
    """The controller of a spec, or of what `pack_controller` made: an object, or what makes one of a robot.

    Raises: ControllerError, UnknownNameError, see `load_controller`.
    """
    if isinstance(source, str):
        return load_controller(source, robot)
    with blamed("controller 'handed over' cannot be made"):
        found = pickle.loads(source)
        name = getattr(found, "__name__", type(found).__name__)
        if isinstance(found, type) or not hasattr(found, "act"):
            found = found(robot)
        return _checked(found, name)


@contextmanager
def _importing(spec: str) -> Iterator[None]:
    """Where a controller's modules are imported; its faults are one line."""
    with blamed(f"controller '{spec}' cannot be imported"):
        try:
            yield
        except ImportError as error:  # what is missing says enough
            raise ControllerError(f"controller '{spec}' cannot be imported: {error}") from error


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
    if isinstance(info.control_period, bool) or not isinstance(info.control_period, int | float):
        raise ControllerError(
            f"controller '{spec}' has the control period {info.control_period!r}, valid: a number [s]"
        )
    if not all(isinstance(file, str | Path) for file in info.files):
        raise ControllerError(f"controller '{spec}' has `info.files` {info.files!r}, valid: paths")
    for signal in sorted(info.signals):
        if signal not in SIGNALS:
            raise UnknownNameError("signal", signal, SIGNALS, f"declared by controller '{spec}'")
    for part in sorted(info.commands):
        if part not in COMMAND_PARTS:
            where = f"in `info.commands` of controller '{spec}'"
            raise UnknownNameError("part of a command", part, COMMAND_PARTS, where)
    return controller


def spec_of_replicate(spec: str, replicate: int) -> str:
    """The spec of the controller that meets one replicate: SPEC itself, unless its factory says otherwise.

    Raises: ControllerError, the factory cannot be imported, or fails.
    """
    name, _, variant = spec.partition(":")
    if name not in controllers():
        return spec
    factory = _installed(controllers()[name], spec)
    if not isinstance(factory, SeededFactory):
        return spec
    with blamed(f"controller '{name}' failed in `variant_for`"):
        met = factory.variant_for(variant, replicate)
    if not isinstance(met, str):
        raise ControllerError(f"controller '{name}' returned {met!r} from `variant_for`, valid: a text")
    return f"{name}:{met}"


def variants_of(point: EntryPoint) -> list[tuple[str, str]]:
    """(variant, description) of an installed controller, as its factory names them.

    Raises: ControllerError, the factory cannot be imported, or fails.
    """
    factory = _installed(point, point.name)
    if not isinstance(factory, HasVariants):
        return [("", "")]
    with blamed(f"controller '{point.name}' failed in `variants`"):
        return [(str(variant), str(description)) for variant, description in factory.variants()]


def _load_attribute(module: str, attribute: str):
    path = real_path(module) if module.endswith(".py") else None
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
    import_alone_from(folder)
    _forget_edited()
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise UnknownNameError(
            "controller", module, controllers(), "--controller; no such module either"
        ) from error
    if path is not None and real_path(found.__file__ or "") != path:
        raise ControllerError(
            f"controller file '{path}': the name '{module}' belongs to {found.__file__ or 'Python'}, "
            "give the file another"
        )
    _LOADED[module] = _state_of(module)
    _refuse_namesakes(module)
    if not hasattr(found, attribute):
        raise ControllerError(f"controller '{module}:{attribute}': module has no '{attribute}'")
    return getattr(found, attribute)


_LOADED: dict[str, dict[Path, int]] = {}  # a user's module -> its files when it was imported


def _state_of(module: str) -> dict[Path, int]:
    """Files of a user's module and of what it imports from its folder, with their times of change [ns]."""
    return {path: path.stat().st_mtime_ns for path in provenance.sources(module)}


def _refuse_namesakes(module: str) -> None:
    """Raises: ControllerError, two folders have modules of one name, and one would run with the other's."""
    own = {_name_of(path): path for path in _LOADED[module]}
    for files in list(_LOADED.values()):
        for path in files:
            there = own.get(_name_of(path), path)
            if there != path and path.is_file():
                _forget([module])
                raise ControllerError(
                    f"controller module '{module}' needs '{there}', and another controller '{path}', "
                    "of the same name: give one of them another, or evaluate them in processes of their own"
                )


def _name_of(path: Path) -> str:
    """Name of a file's module in its folder of the path, e.g. `package.part`; the file where it is none."""
    folders = [folder for folder in map(Path, sys.path) if path.is_relative_to(folder)]
    if path.suffix != ".py" or not folders:
        return str(path)
    nearest = max(folders, key=lambda folder: len(folder.parts))
    return ".".join(path.relative_to(nearest).with_suffix("").parts).removesuffix(".__init__")


def _forget_edited() -> None:
    """Have edited modules imported anew: the digest of a controller is that of the files on disk."""
    loaded = [name for name in _LOADED if name in sys.modules]
    _forget([name for name in loaded if _state_of(name) != _LOADED[name]])


def _forget(modules: Iterable[str]) -> None:
    """Have modules of the user imported anew, with what they import from their folders."""
    for module in modules:
        files = _LOADED.pop(module)
        importlib.invalidate_caches()
        for name, loaded in list(sys.modules.items()):
            file = getattr(loaded, "__file__", None)
            if file and real_path(file) in files:
                del sys.modules[name]
