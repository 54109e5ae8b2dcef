"""`evaluate`: the one function behind the command line and the Python interface."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from wbc_bench.controller import Controller
from wbc_bench.episodes.manifest import EpisodeManifest, manifest_path, read_manifest
from wbc_bench.episodes.protocol import EvalProtocol, find_protocol
from wbc_bench.errors import BenchError, UnknownNameError
from wbc_bench.evaluation.execution import Job, run_jobs
from wbc_bench.evaluation.workers import Engine
from wbc_bench.files import PROTOCOLS, ensure_writable, real_path
from wbc_bench.registry import ControllerFactory, build_controller, pack_controller, spec_of_replicate
from wbc_bench.results import stats
from wbc_bench.results.analysis import Evaluated, collect, column
from wbc_bench.results.store import ResultStore, RunRecord
from wbc_bench.results.study import Study
from wbc_bench.results.table import Table
from wbc_bench.results.tables.pairs import compare_table
from wbc_bench.results.tables.paper import paper_table
from wbc_bench.robot import load_robot


class EvaluationError(BenchError):
    """More replicates or episodes than a protocol has, or nothing to evaluate."""


@dataclass(frozen=True)
class Asked:
    """A part of a protocol: which episodes, of how many replicates."""

    protocol: EvalProtocol
    path: Path  # of the protocol's file
    manifest: EpisodeManifest
    manifest_sha256: str
    replicates: int
    episodes: int  # of each replicate

    @classmethod
    def of(cls, protocol: str, replicates: int | None = None, episodes: int | None = None) -> "Asked":
        """The first `episodes` of the first `replicates` of a protocol; all where None is given.

        Args:
            protocol: name of a released protocol, or a .toml file with its manifest beside it.

        Raises: UnknownNameError, ProtocolError, ManifestError, EvaluationError.
        """
        found, path = find_protocol(protocol)
        most = found.episodes
        return cls(
            found,
            path,
            *read_manifest(found, manifest_path(path)),
            within("replicates", replicates, most.replicates, f"replicates of {found.name}"),
            within("episodes", episodes, most.per_replicate, f"episodes per replicate of {found.name}"),
        )


@dataclass(frozen=True)
class Results:
    """What a controller did on the episodes of a protocol."""

    protocol: EvalProtocol
    evaluated: Evaluated

    @property
    def episodes(self) -> pd.DataFrame:
        """One row per episode: what was asked, how it ended, and every metric in SI units."""
        return self.evaluated.episodes

    @property
    def records(self) -> tuple[RunRecord, ...]:
        """Where the rows come from, one record per replicate."""
        return self.evaluated.records

    @property
    def success(self) -> stats.Estimate:
        """Success rate with its Wilson interval of 95 % over episodes, replicates pooled."""
        successes = column(self.episodes, "success")
        return stats.wilson(int(successes.sum()), len(successes), len(self.records))

    def table(self) -> Table:
        """Success, errors and action variation as in the tables of a report."""
        return paper_table(
            Study(self.protocol.name, self.protocol.name), {self.evaluated.spec: self.evaluated}
        )

    def __str__(self) -> str:
        return self.table().markdown()


def evaluate(
    controller: str | Controller | ControllerFactory,
    protocol: str = "ablation_v2",
    *,
    episodes: int | None = None,
    replicates: int | None = None,
    workers: int = 1,
    engine: str = "loky",
    out: Path | str | None = None,
    overwrite: bool = False,
) -> Results:
    """Evaluate a controller on the frozen episodes of a protocol.

    The rows depend neither on `workers` nor on `engine`, nor on what was evaluated before: every shard of 50
    episodes gets a controller built for it, or a fresh copy of the object handed over.

    Args:
        controller: a spec (`"ik"`, `"learned:METHOD@SEED"`, `"file.py:Class"`), a controller object, or a
            class or function that makes one of a `Robot`.
        protocol: name of a released protocol, or path of a .toml file with its manifest beside it.
        episodes: first episodes of each replicate; all when None.
        replicates: first replicates; all when None.
        workers: processes.
        engine: `"loky"` (this machine), `"dask"` (a cluster started here) or `"dask=ADDRESS"`.
        out: folder of records, where an interrupted evaluation resumes and a finished one is reused; nothing
            is kept when None.
        overwrite: evaluate again what `out` holds already.

    Raises:
        BenchError: bad input, in one line; see its subclasses in `wbc_bench.errors`.
    """
    asked = Asked.of(str(protocol), replicates, episodes)
    if out is None:
        with tempfile.TemporaryDirectory() as folder:
            return _evaluate(controller, asked, ResultStore(folder), engine, workers, overwrite)
    return _evaluate(controller, asked, ResultStore(out), engine, workers, overwrite)


def _evaluate(
    controller: str | Controller | ControllerFactory,
    asked: Asked,
    store: ResultStore,
    engine: str,
    workers: int,
    overwrite: bool,
) -> Results:
    evaluate_all([controller], asked, store, Engine.parse(engine, workers), overwrite)
    name = controller if isinstance(controller, str) else _named(controller, asked)[0]
    runs = [run for run in store.runs(asked.protocol.name) if run.record.controller == name]
    return Results(asked.protocol, collect(runs[: asked.replicates])[name].first(asked.episodes))


def evaluate_all(
    controllers: Sequence[str | Controller | ControllerFactory],
    asked: Asked,
    store: ResultStore,
    engine: Engine,
    overwrite: bool = False,
    optional: bool = False,
) -> dict[str, str]:
    """Check everything, then evaluate what the store does not hold yet.

    Args:
        optional: skip what cannot be loaded instead of raising.

    Returns:
        Spec, with its replicates where not all are meant -> why it was skipped.

    Raises: BenchError, see `evaluate`.
    """
    if not controllers:
        raise EvaluationError("no controller is given, valid: at least one")
    jobs, skipped = [], {}
    for controller in dict.fromkeys(controllers):
        if isinstance(controller, str):
            replicates, problem = _loadable(controller, asked, optional)
            name, packed = controller, None
            if problem:
                missing = sorted(set(range(asked.replicates)) - set(replicates))
                part = f" replicate {', '.join(map(str, missing))}" if replicates else ""
                skipped[controller + part] = problem
        else:
            replicates = list(range(asked.replicates))
            name, packed = _named(controller, asked)
        if replicates:
            frozen = asked.protocol, asked.manifest, asked.manifest_sha256
            jobs.append(Job(*frozen, name, replicates, asked.episodes, packed))
    ensure_writable(store.root)
    run_jobs(jobs, store, engine, overwrite)
    if real_path(asked.path).parent != real_path(PROTOCOLS):
        store.keep_protocol(asked.protocol.name, asked.path, manifest_path(asked.path))
    return skipped


def compare(a: Results, b: Results) -> Table:
    """Paired tests of two results on the episodes that both met, by stratum and together.

    Raises: UnknownNameError, they are of different protocols.
    """
    if a.protocol.digest != b.protocol.digest:
        where = "the second of two results that are compared"
        raise UnknownNameError("protocol", b.protocol.name, [a.protocol.name], where)
    one, two = a.evaluated, b.evaluated
    return compare_table(a.protocol.name, {one.spec: one, two.spec: two}, one.spec, two.spec)


def _named(controller: Controller | ControllerFactory, asked: Asked) -> tuple[str, bytes]:
    """The name under which an object is recorded, and the object as it travels."""
    packed = pack_controller(controller)
    return build_controller(packed, load_robot(asked.protocol.robot)).info.name, packed


def _loadable(spec: str, asked: Asked, optional: bool) -> tuple[list[int], str]:
    """Replicates whose controller can be loaded, and why the others' cannot."""
    robot, found = load_robot(asked.protocol.robot), []
    problems: dict[str, str] = {}  # spec of a replicate -> why not
    for replicate in range(asked.replicates):
        one = spec_of_replicate(spec, replicate)
        if one in problems:
            continue
        try:
            build_controller(one, robot)
            found.append(replicate)
        except BenchError as error:
            if not optional:
                raise
            problems[one] = str(error)
    return found, next(iter(problems.values()), "")


def within(name: str, value: int | None, most: int, what: str) -> int:
    """The value of an option, `most` when it is not given. Raises: EvaluationError, it is not 1 to `most`."""
    if value is None:
        return most
    if not 1 <= value <= most:
        raise EvaluationError(f"--{name} {value}: valid: 1 to {most} ({what})")
    return value
