"""The help of `wbc-bench`: a sentence for every option, and a unit or a counted thing for every number."""

import pytest

from option_help import check_option, check_parses, check_shown, commands, options
from printed_commands import printed_commands
from wbc_bench.cli import main

COMMANDS = list(commands(main.Command))


@pytest.mark.parametrize(("kind", "name"), options(kind for _, kind in COMMANDS))
def test_every_option_is_described(kind, name):
    check_option(kind, name)


@pytest.mark.parametrize(("words", "command"), COMMANDS, ids=[" ".join(words) for words, _ in COMMANDS])
def test_every_command_shows_its_descriptions(words, command, capsys):
    check_shown(words, command, main.main, capsys)


def test_all_commands_are_walked():
    names = [" ".join(words) for words, _ in COMMANDS]
    assert len(names) == len(set(names)) >= 19
    assert {"ablation", "demo eval", "protocol freeze", "robot show", "list"} <= set(names)


PRINTED = list(printed_commands("wbc-bench"))


@pytest.mark.parametrize(("place", "words"), PRINTED, ids=[" ".join(words) for _, words in PRINTED])
def test_every_command_that_a_message_prints_can_be_given(place, words, capsys):
    check_parses(words, main.Command, main.main, capsys)


def test_printed_commands_are_found():
    """In backticks and as strings that become part of a message."""
    found = [" ".join(words) for _, words in PRINTED]
    assert {"report", "report --results 1", "protocol freeze 1"} <= set(found)
