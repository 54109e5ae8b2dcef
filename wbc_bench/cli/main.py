"""The command line: `wbc-bench COMMAND --help`.

Each command is a frozen dataclass, its fields the options. Everything heavy is imported when a command runs.
"""

import os
from typing import Annotated

import tyro
from tyro.conf import subcommand

from wbc_bench.cli.common import THREADS, run_command
from wbc_bench.cli.doors import DemoEval, DemoRecord, DemoTrain
from wbc_bench.cli.evaluate import Ablation, Eval, Reach
from wbc_bench.cli.lists import Bench, ExportController, List
from wbc_bench.cli.protocol import Freeze, Show, Verify
from wbc_bench.cli.replay import Film, Replay
from wbc_bench.cli.results import Compare, Latent, Report
from wbc_bench.cli.robot import Export, Picture
from wbc_bench.cli.tracking import Live, Track

Command = (
    Annotated[Ablation, subcommand("ablation")]
    | Annotated[Reach, subcommand("reach")]
    | Annotated[Eval, subcommand("eval")]
    | Annotated[Track, subcommand("track")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Film, subcommand("film")]
    | Annotated[
        Annotated[DemoRecord, subcommand("record")]
        | Annotated[DemoTrain, subcommand("train")]
        | Annotated[DemoEval, subcommand("eval")],
        subcommand("demo", description="Record, learn and score the pushing of doors."),
    ]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Latent, subcommand("latent")]
    | Annotated[List, subcommand("list")]
    | Annotated[
        Annotated[Freeze, subcommand("freeze")]
        | Annotated[Verify, subcommand("verify")]
        | Annotated[Show, subcommand("show")],
        subcommand("protocol", description="Freeze, verify or show a protocol."),
    ]
    | Annotated[
        Annotated[Export, subcommand("export")] | Annotated[Picture, subcommand("show")],
        subcommand("robot", description="Export or draw the robot."),
    ]
    | Annotated[ExportController, subcommand("export")]
    | Annotated[Bench, subcommand("bench")]
)


def main(arguments: list[str] | None = None) -> None:
    """Entry point; ends as `run_command` says."""
    os.environ.update(THREADS)
    command = tyro.cli(
        Command, prog="wbc-bench", description="Whole-body controllers on identical episodes.", args=arguments
    )
    run_command(command.run, "finished shards are kept, the same command resumes")
