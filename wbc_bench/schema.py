"""TOML files with a schema: read with one clear line for every mistake, and told apart by their meaning."""

import hashlib
from pathlib import Path
from typing import TypeVar

import msgspec

from wbc_bench.errors import BenchError

T = TypeVar("T", bound=msgspec.Struct)


def read_toml(path: Path, schema: type[T], kind: str, error: type[BenchError]) -> T:
    """The struct of a TOML file that is a `kind` ("protocol", ...).

    Raises: `error`: missing, unreadable, an unknown key or a wrong type; names the path of the field.
    """
    try:
        return msgspec.toml.decode(path.read_bytes(), type=schema)
    except FileNotFoundError as cause:
        raise error(f"{kind} file '{path}' does not exist") from cause
    except (OSError, msgspec.DecodeError, UnicodeDecodeError) as cause:
        raise error(f"{kind} {path}: {cause}") from cause


def meaning_digest(struct: msgspec.Struct) -> str:
    """SHA-256 over the canonical JSON of every field but the description."""
    fields = msgspec.to_builtins(struct)
    del fields["description"]
    return hashlib.sha256(msgspec.json.encode(fields, order="deterministic")).hexdigest()
