"""The command line of training: `wbc-train COMMAND --help`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import OmitArgPrefixes, subcommand

from wbc_baselines.learned.training.config import Settings, TrainingError
from wbc_bench.cli.common import run_command

RUNS = Path("runs")
DEFAULTS = Settings("transformer_gru")  # of what trains methods given otherwise


@dataclass(frozen=True)
class Run:
    """Train one method with one seed; the same command resumes."""

    settings: OmitArgPrefixes[Settings]
    out: Path = RUNS
    """Folder of runs; this one goes into OUT/METHOD@SEED."""
    change: bool = False
    """Go on with these settings where the run was started with others (another --envs, --backend, schedule),
    in new episodes; what changes is noted in the run's changes.jsonl."""

    def run(self) -> None:
        from wbc_baselines.learned.training.run_folder import RunFolder, run
        from wbc_bench.progress import Progress

        folder = RunFolder(self.out / self.settings.name)
        with Progress("steps") as progress:
            run(self.settings, folder, progress.update, change=self.change)
        print(folder.path)


@dataclass(frozen=True)
class Campaign:
    """Train all methods x seeds at an equal budget; run it on several machines that share OUT, or again."""

    settings: OmitArgPrefixes[Settings] = DEFAULTS
    methods: tuple[str, ...] = ()
    """Methods instead of --method; all when not given."""
    seeds: int = 3
    """Seeds 0 .. SEEDS - 1 instead of --seed."""
    out: Path = RUNS
    """Folder of runs."""

    def run(self) -> None:
        from wbc_baselines.learned.policy.methods import METHODS
        from wbc_baselines.learned.training.campaign import campaign, runs_of
        from wbc_bench.progress import Progress

        if self.seeds < 1:
            raise TrainingError(f"--seeds {self.seeds}: valid: 1 or more")
        chosen = runs_of(self.settings, self.methods or tuple(METHODS), self.seeds)
        with Progress("steps") as progress:
            for done in campaign(chosen, self.out, progress.update):
                print(self.out / done.name, flush=True)


@dataclass(frozen=True)
class Status:
    """Say what is done."""

    out: Path = RUNS
    """Folder of runs."""

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
    """Draw the learning curves of all runs, PNG and SVG."""

    out: Path = RUNS
    """Folder of runs."""
    figures: Path = Path("results/figures")
    """Where the figures go."""

    def run(self) -> None:
        from wbc_baselines.learned.training.curves import write_curves

        paths = write_curves(self.out, self.figures)
        if not paths:
            raise TrainingError(f"--out {self.out}: no run has metrics there, make one with `wbc-train run`")
        for path in paths:
            print(path)


@dataclass(frozen=True)
class Gates:
    """Print the mean gates of trained runs: the constants that the additive reward puts in their place."""

    out: Path = RUNS
    """Folder of runs."""

    def run(self) -> None:
        from wbc_baselines.learned.training.curves import measured_scores
        from wbc_baselines.learned.training.run_folder import RunFolder

        for path in sorted(self.out.glob("*@*/metrics.jsonl")):
            if rows := RunFolder(path.parent).read_metrics():
                phase, score_m, score_l = measured_scores(rows)
                print(f"{path.parent.name}: PHASE {phase:.4f}, SCORE_M {score_m:.3f}, SCORE_L {score_l:.3f}")


@dataclass(frozen=True)
class Bench:
    """Measure how fast methods train and run, over the physics alone; on an idle machine, please."""

    settings: OmitArgPrefixes[Settings] = DEFAULTS
    methods: tuple[str, ...] = ("no_latent", "transformer_gru")
    """Methods instead of --method."""

    def run(self) -> None:
        from wbc_baselines.learned.training.campaign import runs_of
        from wbc_baselines.learned.training.throughput import measure
        from wbc_bench.results.table import Table

        if self.settings.backend != "cpu":
            raise TrainingError(f"--backend {self.settings.backend}: valid: cpu, whose engine is timed")
        runs_of(self.settings, self.methods, 1)  # refuses what cannot be run
        found = measure(self.settings, self.methods)
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
class Imitate:
    """Make a start for `run --start`: a policy without context that imitates another controller."""

    path: Path
    """Where to: PATH.safetensors, a checkpoint that `wbc-bench eval --controller learned:PATH` can judge."""
    teacher: str = "ik:standing"
    """SPEC of the controller to imitate."""
    protocol: str = "ablation_v1"
    """Whose targets, randomisation, noise and pushes."""
    episodes: int = 150
    """Episodes a round."""
    rounds: int = 17
    """Rounds; the student drives in none of the first's episodes, and in ever more of the later ones'."""
    calm: int = 13
    """First rounds, without disturbances; then they rise to the protocol's in the last."""
    updates: int = 3000
    """Updates of the student after each round."""
    seed: int = 0
    """Seed of draws and weights."""
    workers: int = 2
    """Processes; the result does not depend on it."""

    def run(self) -> None:
        import time

        from wbc_baselines.learned.policy import checkpoint
        from wbc_baselines.learned.policy.card import new_card
        from wbc_baselines.learned.policy.estimators import make_estimator
        from wbc_baselines.learned.training.dagger import METHOD, imitate
        from wbc_baselines.learned.training.target_set import read_pool
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.progress import Progress

        for name in ("episodes", "rounds", "updates", "workers"):
            if getattr(self, name) < 1:
                raise TrainingError(f"--{name} {getattr(self, name)}: valid: 1 or more")
        if not 0 <= self.calm < self.rounds:
            raise TrainingError(f"--calm {self.calm}: valid: 0 to {self.rounds - 1}, less than --rounds")
        if self.path.suffix != ".safetensors":
            raise TrainingError(f"--path '{self.path}': valid: a name that ends in .safetensors")
        protocol, _ = find_protocol(self.protocol)
        begun = time.monotonic()
        with Progress("episodes") as progress:
            actor, error = imitate(
                self.teacher,
                protocol,
                read_pool(protocol),
                self.episodes,
                self.rounds,
                self.seed,
                self.calm,
                self.updates,
                self.workers,
                progress.update,
            )
        card = new_card(METHOD, self.seed, 0, time.monotonic() - begun, protocol)
        checkpoint.save(self.path, actor, make_estimator("none"), card)
        print(f"{self.path}: root mean square error of a joint's command {error:.3f} rad")


@dataclass(frozen=True)
class Targets:
    """Draw the pool of feasible targets that training picks from (12,000: five minutes on two cores)."""

    protocol: str = "ablation_v1"
    """Whose targets."""
    count: int = 12_000
    """How many; the strata in turn."""
    workers: int = 2
    """Processes; the pool does not depend on it."""
    path: Path | None = None
    """Where to; the package's own folder when not given."""

    def run(self) -> None:
        from wbc_baselines.learned.training.target_set import POOLS, draw_pool, write_pool
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.progress import Progress

        if self.count < 3:
            raise TrainingError(f"--count {self.count}: valid: 3 or more, one a stratum")
        protocol, _ = find_protocol(self.protocol)
        path = self.path or POOLS / f"{protocol.name}.parquet"
        with Progress("targets") as progress:
            pool = draw_pool(protocol, self.count, self.workers, progress.update)
        write_pool(pool, protocol, path)
        print(path)


Command = (
    Annotated[Run, subcommand("run")]
    | Annotated[Campaign, subcommand("campaign")]
    | Annotated[Status, subcommand("status")]
    | Annotated[Curves, subcommand("curves")]
    | Annotated[Gates, subcommand("gates")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Imitate, subcommand("imitate")]
    | Annotated[Targets, subcommand("targets")]
)


def main(arguments: list[str] | None = None) -> None:
    """Entry point; ends as `run_command` says."""
    command = tyro.cli(
        Command, prog="wbc-train", description="Train the learned controllers.", args=arguments
    )
    run_command(command.run, "the same command resumes at the last checkpoint")
