"""The help of `wbc-train`: a sentence for every option, and a unit or a counted thing for every number."""

import ast
import inspect
import re
import typing
from dataclasses import fields, is_dataclass

import pytest

pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from wbc_baselines.learned.training import cli

COMMANDS = [typing.get_args(command)[0] for command in typing.get_args(cli.Command)]
UNIT = re.compile(r"\[(1|s|nat|control steps|control steps per environment)\]")
COUNT = re.compile(r"^(Number|Seed) of \w+")


def option_types(command: type) -> dict[type, None]:
    """The dataclasses whose fields are options of a command: itself, and those of nested fields."""
    found = {command: None}
    for hint in typing.get_type_hints(command).values():
        if isinstance(hint, type) and is_dataclass(hint):
            found |= option_types(hint)
    return found


TYPES = list({each: None for command in COMMANDS for each in option_types(command)})


def docstrings(kind: type) -> dict[str, str]:
    """Docstring of every field: the string that stands below it."""
    (body,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, text in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            assert isinstance(field.target, ast.Name)
            found[field.target.id] = inspect.cleandoc(str(ast.literal_eval(text.value)))
    return found


def is_number(hint: object) -> bool:
    """Whether an option takes numbers, one or several."""
    return any(each in (int, float) for each in (hint, *typing.get_args(hint)))


OPTIONS = [
    pytest.param(kind, field.name, id=f"{kind.__name__}.{field.name}")
    for kind in TYPES
    for field in fields(kind)
    if not is_dataclass(typing.get_type_hints(kind)[field.name])
]


@pytest.mark.parametrize(("kind", "name"), OPTIONS)
def test_every_option_is_described(kind, name):
    text = docstrings(kind).get(name, "")
    assert len(text.split()) >= 3, f"--{name} of {kind.__name__}: '{text}'"
    assert text.endswith("."), f"--{name} of {kind.__name__} does not end in a full stop: '{text}'"
    if is_number(typing.get_type_hints(kind)[name]):
        assert UNIT.search(text) or COUNT.search(text), f"--{name} of {kind.__name__} has no unit: '{text}'"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_shows_its_descriptions(command, capsys):
    """The docstrings reach the terminal, units included."""
    name = next(
        alias.name
        for choice in typing.get_args(cli.Command)
        if typing.get_args(choice)[0] is command
        for alias in typing.get_args(choice)[1:]
    )
    with pytest.raises(SystemExit) as stop:
        cli.main([name, "--help"])
    shown = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert stop.value.code == 0
    for kind in option_types(command):
        for option, text in docstrings(kind).items():
            first = " ".join(text.split()[:3])
            assert first in shown, f"--{option} of {name}"
            for unit in UNIT.finditer(text):
                assert unit.group() in shown, f"{unit.group()} of --{option}"


def test_a_number_without_a_unit_is_noticed():
    """What the check is for: the units and counts that it looks for are not in every sentence."""
    assert not UNIT.search("Learning rate of the policy.") and not COUNT.search(
        "Learning rate of the policy."
    )
    assert UNIT.search("Duration [control steps].") and COUNT.search("Number of environments.")
