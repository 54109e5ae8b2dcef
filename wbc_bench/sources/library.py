"""A source by its name."""

from pathlib import Path

from wbc_bench.errors import UnknownNameError
from wbc_bench.protocol import PROTOCOL_DIR
from wbc_bench.sources.interface import Source
from wbc_bench.sources.player import PlayedStream
from wbc_bench.sources.scripted import Script, ScriptedSource, load_script
from wbc_bench.sources.stream import ADDRESS, StreamSource

SOURCE_DIR = PROTOCOL_DIR / "sources"


def script_names() -> list[str]:
    """Names of the library of scripts."""
    return sorted(path.stem for path in SOURCE_DIR.glob("*.toml"))


def source_names() -> list[str]:
    """Everything that `load_source` knows by name."""
    return [*script_names(), "stream"]


def find_script(name: str) -> Script:
    """A script of the library, or of a .toml file.

    Raises: UnknownNameError (with the nearest names), SourceError.
    """
    if name.endswith(".toml"):
        return load_script(Path(name))
    if name not in script_names():
        raise UnknownNameError("source", name, source_names(), "--source; or give a .toml file")
    return load_script(SOURCE_DIR / f"{name}.toml")


def load_source(name: str, address: str = ADDRESS, allow_remote: bool = False) -> Source:
    """The source of a name: `stream`, a script of the library or of a .toml file, or `stream:SCRIPT`.

    Raises: UnknownNameError (with the nearest names), SourceError.
    """
    if name == "stream":
        return StreamSource(address, allow_remote=allow_remote)
    if name.startswith("stream:"):
        script = ScriptedSource(find_script(name.removeprefix("stream:")))
        return PlayedStream(script, StreamSource(address, allow_remote=allow_remote))
    return ScriptedSource(find_script(name))
