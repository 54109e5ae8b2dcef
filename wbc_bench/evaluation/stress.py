"""Controllers on a severity ladder: all levels of all controllers are jobs of one evaluation."""

import resource
from collections.abc import Sequence
from pathlib import Path

from wbc_bench.episodes.ladder import Ladder, freeze_levels, ladder_rows
from wbc_bench.evaluation.evaluate import EvaluationError, within
from wbc_bench.evaluation.execution import Job, run_jobs
from wbc_bench.evaluation.workers import Engine
from wbc_bench.files import ensure_writable, scratch_folder
from wbc_bench.registry import build_controller, spec_of_replicate
from wbc_bench.results.store import ResultStore
from wbc_bench.results.stress import (
    FactorRecord,
    LadderRecord,
    LevelRecord,
    keep_ladder,
    stress_folder,
)
from wbc_bench.robot import load_robot

SPARE_FILES = 256  # open besides the locks of runs: libraries, pipes to workers


def evaluate_stress(
    controllers: Sequence[str],
    ladder: Ladder,
    out: Path,
    engine: Engine,
    factors: Sequence[str] = (),
    episodes: int | None = None,
    overwrite: bool = False,
) -> ResultStore:
    """Check everything, then evaluate what `out` does not hold yet of the base and of every level.

    Args:
        controllers: Specs.
        ladder: The ladder.
        out: Folder of results; the records of the ladder stand in a folder of their own below it.
        engine: Where episodes are computed.
        factors: Names of those of the ladder's factors that are evaluated; all when empty.
        episodes: Number of episodes of each level, from the first on; the ladder's when None.
        overwrite: Evaluate again what is there already.

    Returns:
        The store of the ladder's records.

    Raises:
        BenchError: Bad input, in one line; see `evaluate` and `load_ladder`.
    """
    if not controllers:
        raise EvaluationError("no controller is given, valid: at least one")
    count = within("episodes", episodes, ladder.episodes, f"episodes per level of {ladder.name}")
    chosen = ladder.only(factors)
    robot = load_robot(ladder.base.robot)
    specs = list(dict.fromkeys(controllers))
    for spec in specs:
        build_controller(spec_of_replicate(spec, 0), robot)
    rows = ladder_rows(ladder)
    store = ResultStore(stress_folder(out, ladder.name))
    ensure_writable(store.root)
    with scratch_folder(store.root) as folder:
        levels = freeze_levels(chosen, rows, folder)
        keep_ladder(store.root, ladder_record(ladder))
        jobs = [
            Job(level.protocol, level.manifest, level.manifest_sha256, spec, [0], count)
            for spec in specs
            for level in levels
        ]
        allow_open_files(len(jobs) + SPARE_FILES)  # a lock for each run
        run_jobs(jobs, store, engine, overwrite)
        for level in levels:
            store.keep_protocol(level.protocol.name, level.path, level.path.with_suffix(".parquet"))
    return store


def allow_open_files(count: int) -> None:
    """Raise the number of files that this process may hold open to `count`, as far as the system lets it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = count if hard == resource.RLIM_INFINITY else min(count, hard)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def ladder_record(ladder: Ladder) -> LadderRecord:
    """What the records of a ladder keep of it, whichever of its factors are evaluated."""

    def record(severity: float, protocol) -> LevelRecord:
        return LevelRecord(severity, protocol.name, protocol.digest)

    factors = (
        FactorRecord(factor.name, factor.label, factor.unit, tuple(record(*level) for level in factor.levels))
        for factor in ladder.factors
    )
    base = record(0.0, ladder.base)
    return LadderRecord(ladder.name, ladder.source.name, base, ladder.episodes, tuple(factors))
