"""TOML files with a schema: read with one clear line for every mistake, and told apart by their meaning."""

import hashlib
from pathlib import Path
from typing import Any, TypeVar

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
    """SHA-256 over the canonical JSON of what a struct means: every field but the description.

    A field in `LATER` of its struct is left out while it has its default: it joined the schema after files of
    it were released, whose digests must stay what they are.
    """
    fields = meaning(struct)
    fields.pop("description", None)
    return hashlib.sha256(msgspec.json.encode(fields, order="deterministic")).hexdigest()


def meaning(value: Any) -> Any:
    """What a struct means in the types of JSON, as `meaning_digest` takes it."""
    if isinstance(value, tuple):
        return [meaning(item) for item in value]
    if not isinstance(value, msgspec.Struct):
        return msgspec.to_builtins(value)
    later = getattr(type(value), "LATER", frozenset())
    found = {}
    for field in msgspec.structs.fields(value):
        item = getattr(value, field.name)
        if field.name not in later or item != field.default:
            found[field.encode_name] = meaning(item)
    config = type(value).__struct_config__
    if config.tag is not None:
        found[config.tag_field] = config.tag
    return found
