"""A severity ladder of three factors over the tiny protocol."""

from pathlib import Path

from tiny_protocol import write_tiny

TOML = """
name = "climb"
description = "Three disturbances."
protocol = "tiny.toml"
episodes = 4

[factors.friction]
label = "Friction"
field = "randomization.friction"
mapping = "range"
levels = [0.8, 0.4]

[factors.noise]
label = "Noise"
field = "noise"
mapping = "scale"
unit = "of the base's"
levels = [1.0, 2.0, 4.0]

[factors.delay]
label = "Command delay"
field = "randomization.command_delay"
mapping = "range"
unit = "s"
levels = [0.0, 0.02]
"""


def write_ladder(folder: Path, old: str = "", new: str = "") -> Path:
    """Write the tiny protocol with its manifest, and a ladder beside it whose text `old` is replaced."""
    write_tiny(folder)
    assert old in TOML
    path = folder / "climb.toml"
    path.write_text(TOML.replace(old, new, 1) if old else TOML)
    return path
