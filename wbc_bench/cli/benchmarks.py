"""`wbc-bench bench`: the benchmarks that installed packages offer, and one build beside an earlier one."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from wbc_bench.cli.common import UsageError, print_table
from wbc_bench.errors import UnknownNameError

BENCHMARKS = "wbc_bench.benchmarks"  # entry points: name -> a callable that returns a DataFrame


@dataclass(frozen=True)
class Bench:
    """Time what the installed packages offer to be timed, e.g. the solvers of the IK controller."""

    names: Positional[tuple[str, ...]] = ()
    """Names of the benchmarks to run, see `wbc-bench list`; all of them when not given."""
    out: Path | None = None
    """Folder to write <name>.json, .csv, .md and .tex to; nothing is written when not given."""
    against: Path | None = None
    """Record of an earlier build, a <name>.json, by whose numbers those of this one are divided."""

    def run(self) -> None:
        from importlib.metadata import entry_points

        from wbc_bench.files import ensure_writable, made_whole
        from wbc_bench.isolation import blamed
        from wbc_bench.results.benchmark import (
            BenchmarkRecord,
            against_table,
            benchmark_table,
            read_benchmark,
        )

        found = {point.name: point for point in entry_points(group=BENCHMARKS)}
        before = read_benchmark(self.against) if self.against else None
        names = self.names or ((before.benchmark,) if before else tuple(sorted(found)))
        for name in names:
            if name not in found:
                raise UnknownNameError("benchmark", name, found, f"entry points of '{BENCHMARKS}'")
        if before and names != (before.benchmark,):
            raise UsageError(
                f"--against {self.against}: a record of '{before.benchmark}', valid: with that one alone"
            )
        if self.out:
            ensure_writable(self.out)
        for name in names:
            with blamed(f"benchmark '{name}' failed"):
                record = BenchmarkRecord.of(name, found[name].load()())
                table = benchmark_table(record)
            print_table(table)
            if before:
                print_table(against_table(record, before))
            if self.out:
                with made_whole(self.out) as (made, _):
                    table.write(made)
                    (made / f"{name}.json").write_bytes(record.json())
