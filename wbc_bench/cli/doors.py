"""`wbc-bench demo`: record, learn and score the pushing of doors."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, Positional

from wbc_bench.cli.common import RESULTS, UsageError, at_least_one, cores, not_negative, print_table
from wbc_bench.errors import UnknownNameError


@dataclass(frozen=True)
class DemoRecord:
    """Record an expert that pushes doors shut, in UMI's zarr layout; equal options give equal bytes."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = tyro.MISSING
    """Path of the file to write, FILE.zarr.zip."""
    episodes: int = 100
    """Number of episodes, each in front of a door of its own."""
    seed: int = 0
    """Seed of the random generator that draws the doors."""
    controller: str = "ik"
    """Controller that the expert drives: name, name:variant, module:attribute or file.py:attribute."""
    workers: int = field(default_factory=cores)
    """Number of worker processes; the file does not depend on it."""

    def run(self) -> None:
        from wbc_bench.evaluation.doors import record
        from wbc_bench.files import ensure_file_writable
        from wbc_bench.progress import Progress

        at_least_one("--episodes", self.episodes)
        at_least_one("--workers", self.workers)
        not_negative("--seed", self.seed)
        ensure_file_writable(self.out)
        with Progress("episodes") as progress:
            kept = record(self.out, self.controller, self.seed, self.episodes, self.workers, progress.update)
        print(f"{self.out}: {kept} of {self.episodes} episodes closed their door and are kept")


@dataclass(frozen=True)
class DemoTrain:
    """Train a diffusion policy on demonstrations; a few minutes on one core."""

    demonstrations: Positional[Path]
    """Path of a file that `demo record` wrote."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = tyro.MISSING
    """Path of the file to write, POLICY.safetensors."""
    seed: int = 0
    """Seed of the random generator that draws weights, windows and noise."""
    updates: int = 6000
    """Number of optimiser steps."""

    def run(self) -> None:
        import time

        from wbc_bench.errors import SourceError, missing_extra
        from wbc_bench.files import ensure_file_writable
        from wbc_bench.progress import Progress

        try:
            from wbc_bench.sources.diffusion.policy import save_policy
            from wbc_bench.sources.diffusion.training import train
        except ImportError as error:
            raise SourceError(missing_extra("training", "diffusion", error)) from error

        at_least_one("--updates", self.updates)
        not_negative("--seed", self.seed)
        ensure_file_writable(self.out)
        start = time.monotonic()
        with Progress("updates") as progress:
            policy, card = train(
                self.demonstrations,
                self.seed,
                self.updates,
                lambda update, loss: progress.update(update + 1, self.updates, f"loss {loss:.4f}"),
            )
        save_policy(self.out, policy, card)
        took = time.monotonic() - start
        print(
            f"{self.out}: {card.demonstrations} demonstrations, {card.samples} windows, "
            f"{card.steps} updates in {took:.0f} s"
        )


@dataclass(frozen=True)
class DemoEval:
    """Let a policy, or the expert, drive a controller in front of doors, and count the closed ones."""

    policy: Positional[Path | None] = None
    """Path of a file that `demo train` wrote; the packaged policy when not given."""
    controller: str = "ik"
    """Controller to drive: name, name:variant, module:attribute or file.py:attribute."""
    expert: FlagCreatePairsOff[bool] = False
    """Let the scripted expert drive the controller instead of a policy."""
    episodes: int = 50
    """Number of episodes, each in front of a door of its own."""
    seed: int = 1
    """Seed of the doors and of the policy's noise; give another one than for the demonstrations."""
    condition: str = "nominal"
    """Condition of the episodes: nominal, or randomised (friction, mass, gains, reset state, pushes and noise
    of ablation_v1)."""
    workers: int = field(default_factory=cores)
    """Number of worker processes; the results do not depend on it."""
    out: Path = RESULTS
    """Folder to write the record and the table to."""

    def run(self) -> None:
        from wbc_bench.episodes.single import CONDITIONS
        from wbc_bench.evaluation.doors import evaluate
        from wbc_bench.progress import Progress
        from wbc_bench.publish import publish_doors
        from wbc_bench.results.doors import door_table, read_doors

        at_least_one("--episodes", self.episodes)
        at_least_one("--workers", self.workers)
        not_negative("--seed", self.seed)
        if self.condition not in CONDITIONS:
            raise UnknownNameError("condition", self.condition, CONDITIONS, "--condition")
        if self.expert and self.policy:
            raise UsageError(f"--expert and '{self.policy}': give one of them")
        with Progress("episodes") as progress:
            evaluate(
                self.out,
                None if self.expert else str(self.policy or ""),
                self.controller,
                self.condition,
                self.seed,
                self.episodes,
                self.workers,
                progress.update,
            )
        publish_doors(self.out, self.out)
        print_table(door_table(read_doors(self.out)))
        print(f"record and table are under {self.out}")
