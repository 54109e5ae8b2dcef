"""`wbc-bench ablation`, `reach`, `stress` and `eval`: controllers on the episodes of protocols."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import FlagCreatePairsOff

from wbc_bench.cli.common import RESULTS, UsageError, at_least_one, cores, print_table

if TYPE_CHECKING:
    from wbc_bench.results.store import ResultStore

Replicates = Annotated[int | None, tyro.conf.arg(aliases=["--seeds"])]


@dataclass(frozen=True)
class _Evaluation:
    """Options of every command that evaluates."""

    workers: int = field(default_factory=cores)
    """Number of worker processes; the results do not depend on it."""
    engine: str = "loky"
    """Engine that computes the episodes: loky (processes of this machine), dask (a cluster started here) or
    dask=ADDRESS (a running scheduler)."""
    out: Path = RESULTS
    """Folder to write records, tables and figures to; an interrupted evaluation resumes there."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Evaluate again what the folder holds already, and replace each run once the new one is complete."""

    def _evaluate(
        self,
        protocol: str,
        specs: tuple[str, ...],
        replicates: int | None,
        episodes: int | None,
        optional: bool = False,
    ) -> "ResultStore":
        """Check everything, then run; with `optional`, what cannot be loaded is named in one line."""
        from wbc_bench.evaluation.evaluate import Asked, evaluate_all
        from wbc_bench.evaluation.workers import Engine
        from wbc_bench.results.store import ResultStore

        at_least_one("--workers", self.workers)
        engine, store = Engine.parse(self.engine, self.workers), ResultStore(self.out)
        asked = Asked.of(protocol, replicates, episodes)
        skipped = evaluate_all(specs, asked, store, engine, self.overwrite, optional)
        if skipped:
            print(f"not evaluated: {', '.join(skipped)} ({next(iter(skipped.values()))})", file=sys.stderr)
        return store


@dataclass(frozen=True)
class Ablation(_Evaluation):
    """Evaluate every controller of a study on the same episodes, and write its tables and figures."""

    study: str = "ablation_v2"
    """Name of a released study, or path of a .toml file: the controllers that share a table, and the pairs of
    them that are tested against each other."""
    replicates: Replicates = None
    """Number of replicates of the protocol to evaluate; all of them when not given."""
    episodes: int | None = None
    """Number of episodes of each replicate, from the first on; all of them when not given."""
    controllers: tuple[str, ...] = ()
    """Controllers to evaluate instead of those that the study lists, each a name, name:variant,
    module:attribute or file.py:attribute."""

    def run(self) -> None:
        from wbc_bench.publish import publish
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.study import find_study
        from wbc_bench.results.tables.pairs import pair_table
        from wbc_bench.results.tables.paper import paper_table

        study = find_study(self.study)
        specs = self.controllers or tuple(row.spec for row in study.rows)
        store = self._evaluate(
            study.protocol, specs, self.replicates, self.episodes, optional=not self.controllers
        )
        publish(store, self.out, studies=[study])
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
    """Controllers to evaluate, each a name, name:variant, module:attribute or file.py:attribute."""
    protocol: str = "reach_v2"
    """Name of a released reach protocol, or path of a .toml file with its manifest beside it."""

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
class Stress(_Evaluation):
    """Evaluate controllers while one disturbance at a time grows, and write breaking points and margins."""

    controller: tuple[str, ...] = tyro.MISSING
    """Controllers to evaluate, each a name, name:variant, module:attribute or file.py:attribute."""
    ladder: str = "stress_v2"
    """Name of a released ladder, or path of a .toml file: disturbances and their levels over a protocol."""
    factors: tuple[str, ...] = ()
    """Names of the ladder's disturbances to evaluate; all of them when not given."""
    episodes: int | None = None
    """Number of episodes of each level, from the first on; the ladder's when not given."""

    def run(self) -> None:
        from wbc_bench.episodes.ladder import find_ladder
        from wbc_bench.evaluation.stress import evaluate_stress
        from wbc_bench.evaluation.workers import Engine
        from wbc_bench.publish import publish
        from wbc_bench.results.margins import analyse
        from wbc_bench.results.store import ResultStore
        from wbc_bench.results.stress import read_stress
        from wbc_bench.results.study import labels_of, released_rows
        from wbc_bench.results.tables.stress import breaking_table, margin_table

        at_least_one("--workers", self.workers)
        engine, ladder = Engine.parse(self.engine, self.workers), find_ladder(self.ladder)
        evaluate_stress(
            self.controller, ladder, self.out, engine, self.factors, self.episodes, self.overwrite
        )
        publish(ResultStore(self.out), self.out)
        for stress in read_stress(self.out, labels_of(released_rows())):
            if stress.ladder.name == ladder.name:
                found = analyse(stress)
                print_table(breaking_table(stress, found))
                print_table(margin_table(stress, found))
        print(f"tables, figures and report.html are under {self.out}")


@dataclass(frozen=True)
class Eval(_Evaluation):
    """Evaluate controllers under any protocol and print how the episodes ended."""

    controller: tuple[str, ...] = tyro.MISSING
    """Controllers to evaluate, each a name, name:variant, module:attribute or file.py:attribute."""
    protocol: str = tyro.MISSING
    """Name of a released protocol, or path of a .toml file with its manifest beside it."""
    replicates: Replicates = None
    """Number of replicates of the protocol to evaluate; all of them when not given."""
    episodes: int | None = None
    """Number of episodes of each replicate, from the first on; all of them when not given."""

    def run(self) -> None:
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.study import Study
        from wbc_bench.results.tables.paper import paper_table
        from wbc_bench.results.tables.strata import outcome_table

        store = self._evaluate(self.protocol, self.controller, self.replicates, self.episodes)
        name = find_protocol(self.protocol)[0].name
        study = Study(name, name)
        evaluated = collect(store.runs(study.protocol))
        print_table(paper_table(study, evaluated))
        print_table(outcome_table(study, evaluated))
        command = f"wbc-bench report --results {quote(str(self.out))}"
        print(f"records are under {self.out}; `{command}` makes tables and figures of them")
