"""The help of `wbc-train`: a sentence for every option, and a unit or a counted thing for every number."""

import pytest

from option_help import COUNT, UNIT, check_option, check_parses, check_shown, commands, options
from printed_commands import printed_commands

pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from wbc_baselines.learned.training import cli

COMMANDS = list(commands(cli.Command))


@pytest.mark.parametrize(("kind", "name"), options(kind for _, kind in COMMANDS))
def test_every_option_is_described(kind, name):
    check_option(kind, name)


@pytest.mark.parametrize(("words", "command"), COMMANDS, ids=[" ".join(words) for words, _ in COMMANDS])
def test_every_command_shows_its_descriptions(words, command, capsys):
    """The docstrings reach the terminal, units included."""
    check_shown(words, command, cli.main, capsys)


def test_a_number_without_a_unit_is_noticed():
    """What the check is for: the units and counts that it looks for are not in every sentence."""
    assert not UNIT.search("Learning rate of the policy.") and not COUNT.search(
        "Learning rate of the policy."
    )
    assert UNIT.search("Duration [control steps].") and COUNT.search("Number of environments.")


PRINTED = list(printed_commands("wbc-train"))


@pytest.mark.parametrize(("place", "words"), PRINTED, ids=[" ".join(words) for _, words in PRINTED])
def test_every_command_that_a_message_prints_can_be_given(place, words, capsys):
    check_parses(words, cli.Command, cli.main, capsys)


def test_version(capsys):
    from importlib.metadata import version

    cli.main(["--version"])
    assert capsys.readouterr().out == f"wbc-train {version('wbc-bench')}\n"
