"""Where a result comes from: commit, package versions, machine, and one digest over all code that made it."""

import hashlib
import inspect
import os
import platform
import re
import subprocess
import sys
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

PACKAGE = Path(__file__).parent
SOURCE_SUFFIXES = (".py", ".toml")
# Parts of the harness that no episode depends on: editing a table must not part a run from its shards.
BYSTANDERS = frozenset(
    {"protocols", "paper_values", "freeze", "cli", "__main__", "publish", "report", "tables", "plots"}
    | {"markup", "analysis", "stats", "store", "progress", "provenance"}
    | {"sources", "track", "tracking", "demo", "door_records", "records"}
    | {"gallery", "workspace", "latents", "introspection", "viewer"}
)


class Commit(NamedTuple):
    """The git state of the harness; None and False where it is not a checkout."""

    sha: str | None
    dirty: bool  # tracked or new files differ from the commit, results aside


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
    """Installed versions of Python, the harness, and every package that it or its extras ask for."""
    wanted = {"wbc-bench"}
    for requirement in metadata.requires("wbc-bench") or ():
        match = re.match(r"[\w.-]+", requirement)
        if match and not re.search(r"extra\s*==\s*.test.", requirement):
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
        "software_sha256": software_digest(controller),
        "git_commit": now.sha,
        "git_dirty": now.dirty,
        "versions": versions(),
        "machine": machine(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def software_digest(controller: object) -> str:
    """SHA-256 over the sources that an episode depends on, its controller's too, and the package versions.

    Two shards with the same digest were computed by the same code, committed or not.
    """
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    digest.update(str(getattr(controller, "checkpoint_sha256", None)).encode())
    harness = (p for p in _sources(PACKAGE) if Path(p.relative_to(PACKAGE).parts[0]).stem not in BYSTANDERS)
    for path in [*harness, *_sources(_home(controller))]:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _home(controller: object) -> Path | None:
    """The top folder of the package a controller comes from, or the one file when it is not in a package."""
    module = sys.modules.get(type(controller).__module__.partition(".")[0])
    file = getattr(module, "__file__", None)
    if file is None:
        try:
            return Path(inspect.getfile(type(controller)))
        except (TypeError, OSError):
            return None  # built interactively: there is no source to read
    return Path(file).parent if hasattr(module, "__path__") else Path(file)


def _sources(home: Path | None) -> list[Path]:
    if home is None:
        return []
    if home.is_file():
        return [home]
    return sorted(path for path in home.rglob("*") if path.suffix in SOURCE_SUFFIXES and path.is_file())
