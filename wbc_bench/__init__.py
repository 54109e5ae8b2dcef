"""wbc-bench: whole-body controllers of a legged manipulator, measured on identical episodes."""

__version__ = "0.1.0"
