"""What a command's options are and what their help says, for the tests of `wbc-bench` and `wbc-train`."""

import ast
import inspect
import re
import typing
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, is_dataclass

import pytest
import tyro

UNIT = re.compile(r"\[(1|s|nat|N m|control steps|control steps per environment)\]")
COUNT = re.compile(r"^(Number|Seed|Index|TCP port) of \w+")


def commands(union: object, *above: str) -> Iterator[tuple[tuple[str, ...], type]]:
    """Yield (words that are typed, dataclass) of every command, nested ones included."""
    for choice in typing.get_args(union):
        kind, alias = typing.get_args(choice)
        if is_dataclass(kind):
            assert isinstance(kind, type)
            yield (*above, alias.name), kind
        else:
            yield from commands(kind, *above, alias.name)


def option_types(command: type) -> dict[type, None]:
    """The dataclasses whose fields are options of a command: itself, and those of nested fields."""
    found = {command: None}
    for hint in typing.get_type_hints(command).values():
        if isinstance(hint, type) and is_dataclass(hint):
            found |= option_types(hint)
    return found


def docstrings(kind: type) -> dict[str, str]:
    """Docstring of every field, inherited ones included: the string that stands below it."""
    found = {}
    for each in reversed([base for base in kind.__mro__ if is_dataclass(base)]):
        (body,) = ast.parse(inspect.getsource(each)).body
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                assert isinstance(field.target, ast.Name)
                found[field.target.id] = inspect.cleandoc(str(ast.literal_eval(text.value)))
    return found


def is_number(hint: object) -> bool:
    """Whether an option takes numbers, one or several."""
    return hint in (int, float) or any(is_number(each) for each in typing.get_args(hint))


def options(kinds: Iterable[type]) -> list:
    """Test parameters (dataclass, name of the field), one per option."""
    return [
        pytest.param(kind, field.name, id=f"{kind.__name__}.{field.name}")
        for kind in dict.fromkeys(each for command in kinds for each in option_types(command))
        for field in fields(kind)
        if not is_dataclass(typing.get_type_hints(kind)[field.name])
    ]


def check_option(kind: type, name: str) -> None:
    """Assert that an option has a sentence, and a unit or a counted thing where it takes a number."""
    text = docstrings(kind).get(name, "")
    assert len(text.split()) >= 3, f"--{name} of {kind.__name__}: '{text}'"
    assert text[0].isupper(), f"--{name} of {kind.__name__} does not begin like a sentence: '{text}'"
    assert not text.startswith("Of "), f"--{name} of {kind.__name__} does not say of what: '{text}'"
    assert text.endswith("."), f"--{name} of {kind.__name__} does not end in a full stop: '{text}'"
    if is_number(typing.get_type_hints(kind)[name]):
        assert UNIT.search(text) or COUNT.search(text), f"--{name} of {kind.__name__} has no unit: '{text}'"


def check_shown(words: tuple[str, ...], command: type, main: Callable, capsys: pytest.CaptureFixture) -> None:
    """Assert that `--help` of a command prints the text of all its options, units included."""
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    shown = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert stop.value.code == 0
    for kind in option_types(command):
        for option, text in docstrings(kind).items():
            first = " ".join(text.split()[:3])
            assert first in shown, f"--{option} of {' '.join(words)}"
            for unit in UNIT.finditer(text):
                assert unit.group() in shown, f"{unit.group()} of --{option}"


def check_parses(words: list[str], union: object, main: Callable, capsys: pytest.CaptureFixture) -> None:
    """Assert that the command line accepts the words of a command; it is not run."""
    try:
        if words and words[0].startswith("--"):  # answered by the program itself, e.g. --version
            main(words)
        elif words:
            tyro.cli(typing.cast(typing.Any, union), args=words)
    except SystemExit as stop:
        assert not stop.code, capsys.readouterr()
