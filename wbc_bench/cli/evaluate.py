"""`wbc-bench ablation`, `reach` and `eval`: controllers on the episodes of a protocol."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from tyro.conf import FlagCreatePairsOff

from wbc_bench.errors import BenchError

if TYPE_CHECKING:
    from wbc_bench.evaluation.workers import Engine
    from wbc_bench.results.store import ResultStore
    from wbc_bench.robot import Robot
from wbc_bench.cli.common import UsageError, at_least_one, cores, print_table, within


@dataclass(frozen=True)
class _Evaluation:
    """Options of every command that evaluates."""

    workers: int = field(default_factory=cores)
    """Processes; the results do not depend on it."""
    engine: str = "loky"
    """loky (this machine), dask (a cluster started here) or dask=ADDRESS (a running scheduler)."""
    out: Path = Path("results")
    """Folder of records, tables and figures; an interrupted evaluation resumes there."""
    redo: FlagCreatePairsOff[bool] = False
    """Evaluate again what is already there."""

    def _engine(self) -> "Engine":
        from wbc_bench.evaluation.workers import Engine

        at_least_one("--workers", self.workers)
        return Engine.parse(self.engine, self.workers)

    def _evaluate(
        self,
        protocol_name: str,
        specs: tuple[str, ...],
        seeds: int | None,
        episodes: int | None,
        optional: bool = False,
    ) -> "ResultStore":
        """Check everything, then run; with `optional`, what cannot be loaded is skipped with a line."""
        from wbc_bench.episodes.manifest import manifest_path, read_manifest
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.evaluation.execution import Job, run_jobs
        from wbc_bench.files import ensure_writable
        from wbc_bench.results.store import ResultStore
        from wbc_bench.robot import load_robot

        if not specs:
            raise UsageError("--controller: give at least one")
        engine = self._engine()
        protocol, path = find_protocol(protocol_name)
        asked = protocol.episodes
        seeds = within("--seeds", seeds, asked.replicates, f"replicates of {protocol.name}")
        episodes = within(
            "--episodes", episodes, asked.per_replicate, f"episodes a replicate of {protocol.name}"
        )
        manifest, sha256 = read_manifest(protocol, manifest_path(path))
        found = {
            spec: _loadable(spec, range(seeds), load_robot(protocol.robot), optional)
            for spec in dict.fromkeys(specs)
        }
        store = ResultStore(self.out)
        ensure_writable(self.out)
        jobs = [
            Job(protocol, manifest, sha256, spec, replicates, episodes)
            for spec, replicates in found.items()
            if replicates
        ]
        run_jobs(jobs, store, engine, self.redo)
        return store


@dataclass(frozen=True)
class Ablation(_Evaluation):
    """Evaluate every method of the paper's study on the same episodes, and write its tables and figures."""

    seeds: int | None = None
    """Replicates of the protocol to run; all of them when not given."""
    episodes: int | None = None
    """First episodes of each replicate; all of them when not given."""
    controllers: tuple[str, ...] = ()
    """Controllers instead of the study's own list."""

    def run(self) -> None:
        from wbc_bench.publish import publish
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.study import find_study
        from wbc_bench.results.tables.pairs import pair_table
        from wbc_bench.results.tables.paper import paper_table

        study = find_study("ablation_v1")
        specs = self.controllers or tuple(row.spec for row in study.rows)
        store = self._evaluate(
            study.protocol, specs, self.seeds, self.episodes, optional=not self.controllers
        )
        publish(store, self.out)
        evaluated = collect(store.runs(study.protocol))
        print_table(paper_table(study, evaluated))
        pairs = pair_table(study, evaluated)
        if pairs.rows:
            print_table(pairs)
        print(f"tables, figures and report.html are under {self.out}")


@dataclass(frozen=True)
class Reach(_Evaluation):
    """Find the heights that controllers reach straight ahead, and write the figure."""

    controller: tuple[str, ...] = ("ik",)
    """Controllers: name, name:variant, module:attribute or file.py:attribute."""
    protocol: str = "reach_v1"
    """Name or .toml file of a reach protocol."""

    def run(self) -> None:
        from wbc_bench.episodes.protocol import ReachTargets, find_protocol
        from wbc_bench.publish import publish
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.study import studies_of
        from wbc_bench.results.tables.reach import reach_table

        protocol, _ = find_protocol(self.protocol)
        if not isinstance(protocol.targets, ReachTargets):
            raise UsageError(f"--protocol {self.protocol}: its targets are not of type 'reach'")
        store = self._evaluate(self.protocol, self.controller, None, None)
        publish(store, self.out)
        study = studies_of(protocol.name)[0]
        print_table(reach_table(study, collect(store.runs(protocol.name))))
        print(f"tables, figures and report.html are under {self.out}")


@dataclass(frozen=True)
class Eval(_Evaluation):
    """Evaluate controllers under any protocol and print how the episodes ended."""

    controller: tuple[str, ...] = tyro.MISSING
    """Controllers: name, name:variant, module:attribute or file.py:attribute."""
    protocol: str = tyro.MISSING
    """Name of a released protocol, or a .toml file with its manifest beside it."""
    seeds: int | None = None
    """Replicates to run; all of them when not given."""
    episodes: int | None = None
    """First episodes of each replicate; all of them when not given."""

    def run(self) -> None:
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.study import Study
        from wbc_bench.results.tables.paper import paper_table
        from wbc_bench.results.tables.strata import outcome_table

        store = self._evaluate(self.protocol, self.controller, self.seeds, self.episodes)
        name = find_protocol(self.protocol)[0].name
        study = Study(name, name)
        evaluated = collect(store.runs(study.protocol))
        print_table(paper_table(study, evaluated))
        print_table(outcome_table(study, evaluated))
        print(f"records are under {self.out}; `wbc-bench report` makes tables and figures of them")


def _loadable(spec: str, replicates: range, robot: "Robot", optional: bool) -> list[int]:
    """Replicates whose controller can be loaded; with `optional` the others are skipped with a line."""
    from wbc_bench.registry import load_controller, spec_of_replicate

    found: list[int] = []
    problems: dict[str, str] = {}  # spec of a replicate -> why not
    loaded: set[str] = set()
    for replicate in replicates:
        one = spec_of_replicate(spec, replicate)
        if one in problems:
            continue
        try:
            if one not in loaded:
                load_controller(one, robot)
            loaded.add(one)
            found.append(replicate)
        except BenchError as error:
            if not optional:
                raise
            problems[one] = str(error)
    lines = problems.values() if found else list(problems.values())[:1]
    for line in lines:
        print(f"not evaluated: {spec}: {line}", file=sys.stderr)
    return found
