"""The commands that messages of the two packages print, found in the source."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = (ROOT / "wbc_bench", ROOT / "baselines" / "wbc_baselines")


def printed_commands(program: str) -> Iterator[tuple[str, list[str]]]:
    """Yield (place, words after the program) of every command in backticks, or that is a string of its own.

    Docstrings are for readers of the code and are left out. What an f-string inserts is read as `1`.
    """
    for path in sorted(path for folder in FOLDERS for path in folder.rglob("*.py")):
        for line, text in _strings(ast.parse(path.read_text(encoding="utf-8"))):
            found = re.findall(rf"`{program}([^`]*)`", text)
            found += re.findall(rf"\A{program}( [a-z]\w* [^`]+)\Z", text)
            for command in found:
                yield f"{path.name}:{line}", command.split()


def _strings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of every string that is no docstring."""
    left_out = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    joined = [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
    left_out |= {id(part) for node in joined for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in left_out:
            yield node.lineno, node.value
    for node in joined:
        yield node.lineno, "".join(p.value if isinstance(p, ast.Constant) else "1" for p in node.values)  # pyright: ignore
