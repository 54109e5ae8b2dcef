"""The tables of a study, of a reach protocol, of sealed episodes and of two controllers, as files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from wbc_bench.files import SEALED
from wbc_bench.results.analysis import Evaluated
from wbc_bench.results.study import Study
from wbc_bench.results.table import Table
from wbc_bench.results.tables.motion import motion_table
from wbc_bench.results.tables.pairs import compare_table, pair_table
from wbc_bench.results.tables.paper import paper_table
from wbc_bench.results.tables.reach import height_table, reach_table
from wbc_bench.results.tables.sealed import sealed_table
from wbc_bench.results.tables.strata import outcome_table, stratum_table


def _write(tables: Sequence[Table], out_dir: Path | str) -> list[Path]:
    return [path for table in tables if table.rows for path in table.write(Path(out_dir))]


def write_study_tables(study: Study, evaluated: Mapping[str, Evaluated], out_dir: Path | str) -> list[Path]:
    """The tables of a study, those that have rows, into `out_dir`: `<results>/tables`."""
    tables = [paper_table(study, evaluated), paper_table(study, evaluated, terminated=True)]
    tables += [outcome_table(study, evaluated), stratum_table(study, evaluated), pair_table(study, evaluated)]
    tables += [motion_table(study, evaluated)]
    return _write(tables, out_dir)


def write_reach_tables(study: Study, evaluated: Mapping[str, Evaluated], out_dir: Path | str) -> list[Path]:
    """The summary over controllers and one table of heights a controller."""
    heights = (height_table(study, method) for method in evaluated.values())
    return _write([reach_table(study, evaluated), *heights], out_dir)


def write_sealed_tables(evaluated: Mapping[str, Mapping[str, Evaluated]], out_dir: Path | str) -> list[Path]:
    """Public against sealed success, one table per protocol of which controllers have runs of both."""
    pairs = ((name, methods, evaluated.get(name + SEALED, {})) for name, methods in evaluated.items())
    return _write([sealed_table(*pair) for pair in pairs], out_dir)


def write_compare_table(
    protocol: str, evaluated: Mapping[str, Evaluated], a: str, b: str, out_dir: Path | str
) -> list[Path]:
    """Two controllers on the same episodes; `compare_table(...).rich()` is the same for a terminal."""
    return _write([compare_table(protocol, evaluated, a, b)], out_dir)
