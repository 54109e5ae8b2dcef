"""Structs with a schema, told apart by their meaning."""

import hashlib
from typing import Any

import msgspec


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
        return msgspec.to_builtins(value, order="deterministic")
    later = getattr(type(value), "LATER", frozenset())
    config = type(value).__struct_config__
    found = {} if config.tag is None else {config.tag_field: config.tag}  # first, as msgspec writes it
    for field in msgspec.structs.fields(value):
        item = getattr(value, field.name)
        if field.name not in later or item != field.default:
            found[field.encode_name] = meaning(item)
    return found
