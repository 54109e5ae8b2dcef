"""`wbc-bench compare`, `report` and `latent`: what the records say."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from wbc_bench.cli.common import RESULTS, UsageError, open_records, print_table
from wbc_bench.errors import UnknownNameError


@dataclass(frozen=True)
class Compare:
    """Compare two evaluated controllers on the episodes that both met."""

    a: Positional[str]
    """First controller, by the name that its runs were evaluated under."""
    b: Positional[str]
    """Second controller, which the first one is compared with."""
    protocol: str = "ablation_v2"
    """Name of the protocol of the runs, or path of its .toml file."""
    results: Path = RESULTS
    """Folder to read the records from."""
    out: Path | None = None
    """Folder to write the table to; it is only printed when not given."""

    def run(self) -> None:
        from wbc_bench.episodes.protocol import load_protocol
        from wbc_bench.files import made_whole
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.tables.pairs import compare_table
        from wbc_bench.results.tables.write import write_compare_table

        name = load_protocol(self.protocol).name if self.protocol.endswith(".toml") else self.protocol
        store = open_records(self.results)
        runs = store.runs(name)
        if not runs:
            known = {run.record.protocol for run in store.runs()}
            where = f"--protocol, runs under {self.results}"
            raise UnknownNameError("evaluated protocol", name, known, where)
        evaluated = collect(runs)
        print_table(compare_table(name, evaluated, self.a, self.b))
        if self.out:
            with made_whole(self.out) as (made, _):
                write_compare_table(name, evaluated, self.a, self.b, made)


@dataclass(frozen=True)
class Report:
    """Make tables, figures and report.html from the records, as far as they changed; nothing is evaluated."""

    results: Path = RESULTS
    """Folder to read the records from."""
    out: Path | None = None
    """Folder to write tables, figures and report.html to; the folder of the records when not given."""
    workspace: tuple[str, ...] = ()
    """Controllers whose success over the workspace is drawn side by side; the two with the highest success
    when not given."""

    def run(self) -> None:
        from wbc_bench.publish import publish

        for path in publish(open_records(self.results), self.out or self.results, self.workspace):
            print(path)


@dataclass(frozen=True)
class Latent:
    """Draw the latent of a controller's estimator by phase of the task: t-SNE and LDA side by side."""

    controller: str = tyro.MISSING
    """Controller that has a latent, e.g. learned:METHOD@SEED."""
    protocol: str = "ablation_v1"
    """Name of a released protocol, or path of a .toml file with its manifest beside it."""
    episodes: int = 40
    """Number of episodes, the first ones of replicate 0; half of them are held out to test LDA."""
    seed: int = 0
    """Seed of the split into halves, of the choice of the points drawn and of t-SNE."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = RESULTS / "figures"
    """Folder to write the figure and its numbers to; the report of the folder above shows them."""

    def run(self) -> None:
        from wbc_bench.episodes.manifest import manifest_path, read_manifest
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.evaluation.latents import sample_latents
        from wbc_bench.files import ensure_writable, made_whole
        from wbc_bench.registry import load_controller, spec_of_replicate
        from wbc_bench.results.figures.latents import summary, write_latents
        from wbc_bench.results.latents import LEAST_EPISODES
        from wbc_bench.results.study import labels_of, released_rows
        from wbc_bench.robot import load_robot

        protocol, path = find_protocol(self.protocol)
        most = protocol.episodes.per_replicate
        if not LEAST_EPISODES <= self.episodes <= most:
            raise UsageError(f"--episodes {self.episodes}: valid: {LEAST_EPISODES} to {most}")
        if self.seed < 0:
            raise UsageError(f"--seed {self.seed}: valid: 0 or more")
        manifest, _ = read_manifest(protocol, manifest_path(path))
        spec = spec_of_replicate(self.controller, 0)
        controller = load_controller(spec, load_robot(protocol.robot))
        rows = manifest.of_replicate(0, self.episodes)
        ensure_writable(self.out)
        samples = sample_latents(controller, protocol, rows)
        labels = labels_of(released_rows())
        label = labels.get(spec) or labels.get(self.controller)
        name = controller.info.name
        with made_whole(self.out) as (made, paths):
            found, _ = write_latents(name, protocol.name, samples, self.seed, made, label)
        print(*summary(samples, found), *paths, sep="\n")
