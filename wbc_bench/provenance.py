"""Where a result comes from: commit, package versions, machine, and digests over the code that computed it.

Which code counts follows from the imports of what computes an episode, so that a remark in a module that only
draws changes nothing, and a change to a module that a controller imports from its own folder does.
"""

import ast
import hashlib
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from wbc_bench.errors import ControllerError
from wbc_bench.isolation import blamed

PACKAGE = Path(__file__).parent
ROOT = "wbc_bench.evaluation.shard"  # what computes an episode, with all that it imports


class Commit(NamedTuple):
    """The git state of the harness; None and False where it is not a checkout."""

    sha: str | None
    dirty: bool  # tracked or new files differ from the commit, results aside


class Software(NamedTuple):
    """Digests over all that the rows of a shard depend on besides the manifest; SHA-256 in hexadecimal."""

    harness: str  # sources of the harness that an episode runs through, and versions of packages
    controller: str  # sources of the controller, the files it declares, and its own digest

    @property
    def digest(self) -> str:
        """Both in one: shards with the same digest were computed by the same code, committed or not."""
        return hashlib.sha256(f"{self.harness} {self.controller}".encode()).hexdigest()


def commit() -> Commit:
    """The commit that the running harness was checked out from."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=PACKAGE, capture_output=True, text=True, check=True, timeout=30
        ).stdout.strip()

    try:
        # An environment may stand inside somebody else's repository: that one does not track this file.
        git("ls-files", "--error-unmatch", Path(__file__).name)
        top = git("rev-parse", "--show-toplevel")
        changes = git("-C", top, "status", "--porcelain", "--", ".", ":(exclude)results")
        return Commit(git("rev-parse", "HEAD"), bool(changes))
    except (OSError, subprocess.SubprocessError):
        return Commit(None, False)


def versions() -> dict[str, str]:
    """Installed versions of Python, the harness, and every package of it or its extras, at first use."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    wanted = {"wbc-bench"}
    for requirement in metadata.requires("wbc-bench") or ():
        match = re.match(r"[\w.-]+", requirement)
        if match and not re.search(r"extra\s*==\s*.(test|docs).", requirement):
            wanted.add(match[0])
    found = {"python": platform.python_version()}
    for name in sorted(wanted):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # an extra that is not installed
    return found


def machine() -> dict[str, str | int | float]:
    """Processor, cores, memory [GiB] and operating system; nothing that names a person or a host."""
    model = platform.processor() or platform.machine()
    try:
        match = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
        model = match[1].strip() if match else model
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30  # [GiB]
    except (OSError, ValueError):
        memory = float("nan")
    return {
        "processor": model,
        "cores": os.cpu_count() or 0,
        "memory_gib": round(memory, 1),
        "system": platform.platform(terse=True),
    }


def facts(controller: object) -> dict[str, Any]:
    """What a record says of the code, packages, machine and time behind it."""
    now = commit()
    return {
        "software_sha256": software(controller).digest,
        "git_commit": now.sha,
        "git_dirty": now.dirty,
        "versions": versions(),
        "machine": machine(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def software(controller: object) -> Software:
    """The digests of the code that evaluates a controller.

    A controller counts with every module that it imports from its own package or folder, at the top or
    inside a function, with the files in `info.files`, with the controllers that are its attributes, and with
    what its method `digest()` returns, for state that no file holds, e.g. an environment variable.

    Raises: ControllerError, a declared file cannot be read or `digest()` fails.
    """
    digest = hashlib.sha256(str(getattr(controller, "checkpoint_sha256", None)).encode())
    for path in sources(type(controller).__module__):
        _add(digest, path.name, path.read_bytes())
    for path in map(Path, getattr(getattr(controller, "info", None), "files", ())):
        if path.exists() and not path.is_file():  # a pipe would wait for its writer
            raise ControllerError(f"file '{path}', declared in `info.files`, is not a file")
        try:
            _add(digest, path.name, path.read_bytes())
        except (OSError, ValueError) as error:  # the second of a name that no file can have
            raise ControllerError(
                f"file {str(path)!r}, declared in `info.files`, cannot be read: "
                f"{getattr(error, 'strerror', error)}"
            ) from error
    for part in vars(controller).values() if hasattr(controller, "__dict__") else ():
        if hasattr(part, "info") and hasattr(part, "act"):
            _add(digest, "part", software(part).controller.encode())
    own = getattr(controller, "digest", None)
    if callable(own):
        with blamed(f"controller '{type(controller).__name__}' failed in `digest`"):
            _add(digest, "digest()", str(own()).encode())
    return Software(digest_of_code(ROOT), digest.hexdigest())


def digest_of_code(module: str, *more: Path) -> str:
    """SHA-256 of a module of the harness, what it imports from it, more of its files, and versions."""
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    for path in (*sources(module), *more):
        _add(digest, path.relative_to(PACKAGE).as_posix(), path.read_bytes())
    return digest.hexdigest()


def _add(digest, name: str, data: bytes) -> None:
    digest.update(name.encode() + b"\0" + str(len(data)).encode() + b"\0" + data)


def sources(module: str) -> list[Path]:
    """Files of a loaded module and of all that it imports from its own package, or from its own folder.

    Facts (.toml) beside a module of a package belong to it. A module that was made interactively has no file.
    """
    top = module.partition(".")[0]
    file = getattr(sys.modules.get(top), "__file__", None)
    if file is None:
        return []
    first = Path(file).resolve()
    packaged = first.name == "__init__.py"
    home = first.parents[1 if packaged else 0]
    if not packaged and home.name in ("site-packages", "dist-packages"):
        return [first]  # its folder is everybody's
    seen: set[Path] = set()
    queue = [module]
    while queue:
        name = queue.pop()
        if name.partition(".")[0] != top and (packaged or name.startswith("wbc_bench")):
            continue  # another package; the harness has a digest of its own
        for path in (_files_of(name, home) if name != "__main__" else {first}) - seen:
            seen |= {path, *filter(Path.is_file, path.parent.glob("*.toml"))} if packaged else {path}
            queue += _imports(path, home)
    return sorted(seen)


def _files_of(module: str, home: Path) -> set[Path]:
    """The file of a module below `home`, and those of the packages around it; empty if it is not there."""
    *packages, _ = parts = module.split(".")
    stem = home.joinpath(*parts)
    found = {stem.with_suffix(".py"), stem / "__init__.py"}
    found |= {home.joinpath(*packages[: k + 1]) / "__init__.py" for k in range(len(packages))}
    return {path for path in found if path.is_file()}


def _imports(path: Path, home: Path) -> Iterator[str]:
    """Every module that a file may import; names taken from a package are tried as modules, too."""
    package = [part for part in path.relative_to(home).parent.parts] if path.is_relative_to(home) else []
    for module, level, name in _statements(path, path.stat().st_mtime_ns):
        if level:
            module = ".".join([*package[: len(package) - level + 1], *([module] if module else [])])
        yield module
        yield f"{module}.{name}"


@cache
def _statements(path: Path, changed: int) -> tuple[tuple[str, int, str], ...]:
    """(module, level of a relative import, name) of the imports of a file, less those for type checkers."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):
        return ()  # it counts by its bytes; importing it fails with a better message
    skipped: set[ast.AST] = set()
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            skipped |= {inner for part in node.body for inner in ast.walk(part)}
        elif node not in skipped and isinstance(node, ast.Import):
            found += [(alias.name, 0, "") for alias in node.names]
        elif node not in skipped and isinstance(node, ast.ImportFrom):
            found += [(node.module or "", node.level, alias.name) for alias in node.names]
    return tuple(found)
