"""The command line: `wbc-bench COMMAND --help`.

Each command is a frozen dataclass, its fields the options. Everything heavy is imported when a command runs.
"""

import os
import sys
from dataclasses import is_dataclass
from importlib.metadata import version
from typing import Annotated, get_args

import tyro
from tyro.conf import subcommand

from wbc_bench.cli.benchmarks import Bench
from wbc_bench.cli.board import Board, Submit
from wbc_bench.cli.common import THREADS, run_command
from wbc_bench.cli.doors import DemoEval, DemoRecord, DemoTrain
from wbc_bench.cli.evaluate import Ablation, Eval, Reach, Stress
from wbc_bench.cli.lists import ExportController, List
from wbc_bench.cli.policy import PolicyCheck, PolicyImport, PolicyTerms
from wbc_bench.cli.protocol import Freeze, Reveal, Show, Verify
from wbc_bench.cli.replay import ExportDataset, Film, Replay
from wbc_bench.cli.results import Compare, Latent, Report
from wbc_bench.cli.robot import Export, Picture
from wbc_bench.cli.tracking import Live, Track
from wbc_bench.errors import UnknownNameError

Command = (
    Annotated[Ablation, subcommand("ablation")]
    | Annotated[Reach, subcommand("reach")]
    | Annotated[Stress, subcommand("stress")]
    | Annotated[Eval, subcommand("eval")]
    | Annotated[Track, subcommand("track")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Film, subcommand("film")]
    | Annotated[ExportDataset, subcommand("export-dataset")]
    | Annotated[
        Annotated[DemoRecord, subcommand("record")]
        | Annotated[DemoTrain, subcommand("train")]
        | Annotated[DemoEval, subcommand("eval")],
        subcommand("demo", description="Record, learn and score the pushing of doors."),
    ]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Latent, subcommand("latent")]
    | Annotated[Submit, subcommand("submit")]
    | Annotated[Board, subcommand("board")]
    | Annotated[List, subcommand("list")]
    | Annotated[
        Annotated[Freeze, subcommand("freeze")]
        | Annotated[Reveal, subcommand("reveal")]
        | Annotated[Verify, subcommand("verify")]
        | Annotated[Show, subcommand("show")],
        subcommand("protocol", description="Freeze, reveal, verify or show a protocol."),
    ]
    | Annotated[
        Annotated[Export, subcommand("export")] | Annotated[Picture, subcommand("show")],
        subcommand("robot", description="Export or draw the robot."),
    ]
    | Annotated[
        Annotated[PolicyImport, subcommand("import")]
        | Annotated[PolicyCheck, subcommand("check")]
        | Annotated[PolicyTerms, subcommand("terms")],
        subcommand("policy", description="Describe a policy of another stack by a card, and check the card."),
    ]
    | Annotated[ExportController, subcommand("export")]
    | Annotated[Bench, subcommand("bench")]
)


DESCRIPTION = """Whole-body controllers on identical episodes.

`wbc-bench --version` prints the version; `wbc-bench --tyro-print-completion bash` (or zsh, or tcsh) prints a
script that completes commands and options in a shell."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point; ends as `run_command` says."""
    os.environ.update(THREADS)
    words = sys.argv[1:] if arguments is None else arguments
    run_command(lambda: _run(words), "finished shards are kept, the same command resumes")


def _run(words: list[str]) -> None:
    if words == ["--version"]:
        print(f"wbc-bench {version('wbc-bench')}")
        return
    _check_command(words)
    tyro.cli(Command, prog="wbc-bench", description=DESCRIPTION, args=words).run()


def _check_command(words: list[str]) -> None:
    """Refuse an unknown command even where `--help` follows it, which the parser answers first.

    Raises:
        UnknownNameError: The words begin with no command; names the nearest ones.
    """
    known, above = Command, "wbc-bench"
    for word in words:
        if word.startswith("-"):
            return
        names = {}
        for choice in get_args(known):
            kind, alias = get_args(choice)[:2]
            names[alias.name] = kind
        if word not in names:
            raise UnknownNameError("command", word, names, f"{above} COMMAND")
        known, above = names[word], f"{above} {word}"
        if is_dataclass(known):
            return
