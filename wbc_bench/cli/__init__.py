"""The command line: one module for a group of commands, each command a frozen dataclass."""
