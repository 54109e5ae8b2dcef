"""The command line of training, `wbc-train COMMAND --help`."""

import dataclasses
import math
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from shlex import quote
from typing import Annotated

import tyro
from msgspec.structs import replace
from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_bench.cli.common import run_command
from wbc_bench.errors import missing_extra

RUNS = Path("runs")
DEFAULTS = TrainConfig("transformer_gru")  # for commands that take their methods from --methods


@dataclass(frozen=True)
class Run:
    """Train one method with one seed. The same command resumes an interrupted run."""

    config: OmitArgPrefixes[TrainConfig]
    out: Path = RUNS
    """Folder of all runs; this run is written to OUT/METHOD@SEED."""
    change: bool = False
    """Whether to continue a run with settings other than those it was started with, for example another
    --num-envs, --backend or schedule. New episodes are begun, and the changes are recorded in the run's
    changes.jsonl."""
    keep_every: float = 0.0
    """Number of control steps between two checkpoints that no later one replaces, see `wbc-train average`;
    0 for none."""

    def run(self) -> None:
        from wbc_baselines.learned.training.run_folder import RunFolder, run
        from wbc_bench.progress import Progress

        if not 0 <= self.keep_every < math.inf:
            raise TrainingError(f"--keep-every {self.keep_every:g}: valid: 0 or more control steps")
        folder = RunFolder(self.out / self.config.name)
        with Progress("steps") as progress:
            run(self.config, folder, progress.update, change=self.change, keep_every=self.keep_every)
        print(folder.path)


@dataclass(frozen=True)
class Campaign:
    """Train several methods with several seeds each by one recipe, from random weights on.

    Runs that are finished, or in progress elsewhere, are skipped, so the command can be repeated, and started
    on several machines that share the folder OUT.
    """

    recipe: str = "paper"
    """Recipe: one of this package by name, or FILE.toml."""
    methods: tuple[str, ...] = ()
    """Methods to train; all methods of the study if not given."""
    seeds: int = 3
    """Number of seeds per method, 0 to SEEDS - 1."""
    from_scratch: bool = False
    """Whether every method is trained from random weights by PPO alone, as the recipe trains the oracle,
    instead of being distilled from the oracle."""
    threads: int = 2
    """Number of CPU threads for the physics and for torch."""
    out: Path = RUNS
    """Folder of all runs."""

    def run(self) -> None:
        from wbc_baselines.learned.policy.methods import METHODS
        from wbc_baselines.learned.training.campaign import campaign, runs_of
        from wbc_baselines.learned.training.recipe import find_recipe
        from wbc_bench.progress import Progress

        if self.seeds < 1:
            raise TrainingError(f"--seeds {self.seeds}: valid: 1 or more")
        recipe = find_recipe(self.recipe)
        if self.from_scratch:
            recipe = replace(recipe, distilled=None)
        chosen = runs_of(recipe, self.methods or tuple(METHODS), self.seeds, self.out)
        chosen = [dataclasses.replace(one, threads=self.threads) for one in chosen]
        with Progress("steps") as progress:
            for done in campaign(chosen, self.out, progress.update):
                print(self.out / done.name, flush=True)


@dataclass(frozen=True)
class Status:
    """List all runs with their progress."""

    out: Path = RUNS
    """Folder of all runs."""

    def run(self) -> None:
        from wbc_baselines.learned.training.campaign import standing
        from wbc_bench.results.table import Table

        def share(value: float | None) -> str:
            return "" if value is None else f"{100 * value:.1f}"

        cells = [
            (
                s.name,
                s.state,
                f"{s.samples / 1e6:.1f}",
                f"{s.seconds / 3600:.2f}",
                share(s.success),
                share(s.falls),
            )
            for s in standing(self.out)
        ]
        columns = ("Run", "State", "Samples (M)", "Hours", "Success (%)", "Falls (%)")
        table = Table("status", f"Runs in {self.out}", columns, tuple(cells))
        if sys.stdout.isatty():
            from rich.console import Console

            Console().print(table.rich())
        else:
            print(table.markdown())


@dataclass(frozen=True)
class Curves:
    """Plot the learning curves of all runs as PNG and SVG."""

    out: Path = RUNS
    """Folder of all runs."""
    figures: Path = Path("results/figures")
    """Folder to which the figures are written."""

    def run(self) -> None:
        from wbc_baselines.learned.training.curves import write_curves

        paths = write_curves(self.out, self.figures)
        if not paths:
            command = f"wbc-train run --method {DEFAULTS.method} --out {quote(str(self.out))}"
            raise TrainingError(f"--out {self.out}: no run has metrics there, make one with `{command}`")
        for path in paths:
            print(path)


@dataclass(frozen=True)
class Gates:
    """Print the mean gates of trained runs, from which the constants of the additive reward are taken."""

    out: Path = RUNS
    """Folder of all runs."""

    def run(self) -> None:
        from wbc_baselines.learned.training.curves import measured_scores
        from wbc_baselines.learned.training.run_folder import run_folders

        for folder in run_folders(self.out, "metrics.jsonl"):
            if rows := folder.read_metrics():
                phase, score_m, score_l = measured_scores(rows)
                print(f"{folder.path.name}: PHASE {phase:.4f}, SCORE_M {score_m:.3f}, SCORE_L {score_l:.3f}")


@dataclass(frozen=True)
class Bench:
    """Measure training and evaluation speed relative to the physics alone, on an otherwise idle machine."""

    config: OmitArgPrefixes[TrainConfig] = DEFAULTS
    methods: tuple[str, ...] = ("no_latent", "transformer_gru")
    """Methods to measure, which replace --method."""

    def run(self) -> None:
        from wbc_baselines.learned.training.throughput import measure
        from wbc_bench.results.table import Table

        if self.config.backend != "cpu":
            raise TrainingError(f"--backend {self.config.backend}: valid: cpu, whose engine is timed")
        for method in self.methods:
            dataclasses.replace(self.config, method=method).check()
        found = measure(self.config, self.methods)
        cells = [
            (
                s.method,
                f"{s.steps:.0f}",
                f"{s.physics:.0f}",
                f"{s.training:.2f}",
                f"{s.steps / found[0].steps:.2f}",
                "–" if s.evaluation is None else f"{s.evaluation:.2f}",
            )
            for s in found
        ]
        columns = ("Method", "Training (control steps/s)", "Physics alone (control steps/s)")
        columns += ("Training / physics", f"Training / {found[0].method}'s", "Physics in an evaluation")
        print(Table("speed", "Speed beside physics alone", columns, tuple(cells)).markdown())


@dataclass(frozen=True)
class Dagger:
    """Imitate another controller by a policy without a context, for `run --init-checkpoint`."""

    path: Path
    """File to write, PATH.safetensors; `wbc-bench eval --controller learned:PATH` evaluates it."""
    teacher: str = "ik:standing"
    """SPEC of the controller that is imitated."""
    protocol: str = "ablation_v1"
    """Protocol whose targets, randomization, noise and pushes are used."""
    episodes: int = 150
    """Number of episodes per round."""
    rounds: int = 17
    """Number of rounds. The student acts in none of the first round's episodes and in a growing fraction of
    the later ones."""
    undisturbed_rounds: int = 13
    """Number of first rounds without noise, pushes and randomization; afterwards these grow linearly to the
    protocol's in the last round; 0 for a ramp from the first round on."""
    updates: int = 3000
    """Number of updates of the student after each round."""
    seed: int = 0
    """Seed of all random samples and of the initial weights."""
    workers: int = 2
    """Number of processes; the result does not depend on it."""

    def run(self) -> None:
        import time

        from wbc_baselines.learned.policy import checkpoint
        from wbc_baselines.learned.policy.card import new_card
        from wbc_baselines.learned.policy.estimators import make_estimator
        from wbc_baselines.learned.training.dagger import METHOD, dagger
        from wbc_baselines.learned.training.target_set import read_target_set
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.progress import Progress

        for name in ("episodes", "rounds", "updates", "workers"):
            if getattr(self, name) < 1:
                raise TrainingError(f"--{name} {getattr(self, name)}: valid: 1 or more")
        if not 0 <= self.undisturbed_rounds < self.rounds:
            raise TrainingError(
                f"--undisturbed-rounds {self.undisturbed_rounds}: valid: 0 to {self.rounds - 1}, "
                "less than --rounds"
            )
        _ensure_checkpoint_writable("--path", self.path)
        protocol, _ = find_protocol(self.protocol)
        begun = time.monotonic()
        with Progress("episodes") as progress:
            actor, error = dagger(
                self.teacher,
                protocol,
                read_target_set(protocol, requested=self.protocol),
                self.episodes,
                self.rounds,
                self.seed,
                self.undisturbed_rounds,
                self.updates,
                self.workers,
                progress.update,
            )
        card = new_card(METHOD, self.seed, 0, time.monotonic() - begun, protocol)
        checkpoint.save(self.path, actor, make_estimator("none"), card)
        print(f"{self.path}: root mean square error of a joint's command {error:.3f} rad")


@dataclass(frozen=True)
class Average:
    """Average the weights of checkpoints of one training, which is better than each of them late in a run."""

    paths: Annotated[tuple[Path, ...], Positional]
    """Checkpoints, each a PATH.safetensors with its card beside it; one given twice counts twice."""
    out: Annotated[Path, arg(aliases=("-o",))]
    """File to write, PATH.safetensors."""

    def run(self) -> None:
        from wbc_baselines.learned.policy.average import average

        _ensure_checkpoint_writable("--out", self.out)
        average(self.paths, self.out)
        print(self.out)


@dataclass(frozen=True)
class Targets:
    """Generate the feasible targets that training picks from (12,000 take five minutes on two cores)."""

    protocol: str = "ablation_v1"
    """Protocol whose targets are generated."""
    count: int = 12_000
    """Number of targets; the strata alternate."""
    workers: int = 2
    """Number of processes; the targets do not depend on it."""
    path: Path | None = None
    """File to write; a file in the package's own folder if not given."""

    def run(self) -> None:
        from wbc_baselines.learned.training.target_set import TARGET_SETS, draw_target_set, write_target_set
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.files import ensure_file_writable
        from wbc_bench.progress import Progress

        if self.count < 3:
            raise TrainingError(f"--count {self.count}: valid: 3 or more, one per stratum")
        protocol, _ = find_protocol(self.protocol)
        path = self.path or TARGET_SETS / f"{protocol.name}.parquet"
        ensure_file_writable(path)
        with Progress("targets") as progress:
            target_set = draw_target_set(protocol, self.count, self.workers, progress.update)
        write_target_set(target_set, protocol, path)
        print(path)


Command = (
    Annotated[Run, subcommand("run")]
    | Annotated[Campaign, subcommand("campaign")]
    | Annotated[Status, subcommand("status")]
    | Annotated[Curves, subcommand("curves")]
    | Annotated[Gates, subcommand("gates")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Dagger, subcommand("dagger")]
    | Annotated[Targets, subcommand("targets")]
    | Annotated[Average, subcommand("average")]
)


DESCRIPTION = """Train the learned controllers.

`wbc-train --version` prints the version."""


def _ensure_checkpoint_writable(option: str, path: Path) -> None:
    """Raises: TrainingError, StoreError: the name or the folder is none for a checkpoint."""
    from wbc_bench.files import ensure_file_writable

    if path.suffix != ".safetensors":
        raise TrainingError(f"{option} '{path}': valid: a name that ends in .safetensors")
    ensure_file_writable(path)


def main(arguments: list[str] | None = None) -> None:
    """Entry point; ends as `run_command` says."""
    words = sys.argv[1:] if arguments is None else arguments
    run_command(lambda: _run(words), "the same command resumes at the last checkpoint")


def _run(words: list[str]) -> None:
    if words == ["--version"]:
        print(f"wbc-train {version('wbc-bench')}")
        return
    command = tyro.cli(Command, prog="wbc-train", description=DESCRIPTION, args=words)
    try:
        command.run()
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(("wbc_bench", "wbc_baselines")):
            raise
        raise TrainingError(missing_extra("wbc-train", "learned", error)) from error
