"""Where targets come from when no manifest asks: a script, a stream, a person, a policy."""

from wbc_bench.sources.interface import FRAMES, Frame, Seen, Source, StampedTarget, from_world, to_world
from wbc_bench.sources.registry import load_source, source_names

__all__ = [
    "FRAMES",
    "Frame",
    "Seen",
    "Source",
    "StampedTarget",
    "from_world",
    "load_source",
    "source_names",
    "to_world",
]
