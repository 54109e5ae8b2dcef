"""How a test calls the command line and reads its one line."""

import re

import pytest

from wbc_bench.cli.main import main


def fails(capsys, *arguments: object) -> str:
    """The one line that a mistaken command prints."""
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    assert stopped.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    *progress, line = captured.err.splitlines(keepends=True)
    assert line.startswith("error: ") and line.endswith("\n"), captured.err
    assert all(re.match(r"\d+/\d+ \w+, ", shown) for shown in progress), captured.err
    return line
