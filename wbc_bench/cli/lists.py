"""`wbc-bench list` and `export`: what is installed, and a controller as a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import FlagCreatePairsOff

from wbc_bench.cli.benchmarks import BENCHMARKS
from wbc_bench.cli.common import NO_RECORDS, RESULTS, print_table
from wbc_bench.errors import UnknownNameError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from importlib.metadata import EntryPoint

    from wbc_bench.results.store import Run, RunRecord
    from wbc_bench.results.table import Table

SHOWN = ("ablation_v2", "ablation_v1")  # protocols whose successes stand beside the controllers
INPUTS = "wbc_bench.inputs"  # entry points: name -> a callable: rows (vector, columns, size, term, unit)


@dataclass(frozen=True)
class List:
    """List controllers with variants, studies, protocols, ladders, sources, metrics, benchmarks and runs."""

    results: Path = RESULTS
    """Folder to read the records from."""
    inputs: FlagCreatePairsOff[bool] = False
    """List, instead of all that, which term stands in which column of the inputs of learned controllers."""

    def run(self) -> None:
        from wbc_bench.results.store import ResultStore

        if self.inputs:
            for table in _inputs():
                print_table(table)
            return
        runs = ResultStore(self.results).runs()
        for table in (_controllers(runs), _studies(), _protocols(), _ladders(), _sources()):
            print_table(table)
        for table in (_metrics(), _benchmarks()):
            print_table(table)
        table = _runs(runs, self.results)
        if table.rows:
            print_table(table)
        else:
            print(NO_RECORDS.format(self.results))


def _inputs() -> "Iterator[Table]":
    from importlib.metadata import entry_points

    from wbc_bench.errors import BenchError, ControllerError
    from wbc_bench.isolation import blamed
    from wbc_bench.results.table import Table

    for point in sorted(entry_points(group=INPUTS), key=lambda point: point.name):
        header = ("Vector", "Columns", "Size", "Term", "Unit")
        try:
            with blamed("cannot be listed"):
                rows = tuple(tuple(map(str, row)) for row in point.load()())
                if {len(row) for row in rows} - {len(header)}:
                    raise ControllerError(f"cannot be listed: a row has other columns than {header}")
        except BenchError as error:  # somebody else's code: the others are still listed
            rows = ((str(error), "", "", "", ""),)
        yield Table(point.name, f"Inputs of {point.name}", header, rows)


def _controllers(runs: "list[Run]") -> "Table":
    """Every name that `--controller` takes, with the episodes of the main protocols that the runs solved."""
    from wbc_bench.installed import controllers
    from wbc_bench.results.table import Table

    rows = [
        (f"{name}:{variant}" if variant else name, description, point.value)
        for name, point in sorted(controllers().items())
        for variant, description in _variants(point)
    ]
    cells = tuple(
        (name, *(_success(runs, name, protocol) for protocol in SHOWN), *rest) for name, *rest in rows
    )
    header = ("Name", *(f"Success on {protocol}" for protocol in SHOWN), "Description", "Comes from")
    return Table("controllers", "Controllers", header, cells)


def _variants(point: "EntryPoint") -> list[tuple[str, str]]:
    """(variant, description) of an installed controller; of one that fails, what is wrong with it."""
    from wbc_bench.errors import BenchError
    from wbc_bench.registry import variants_of

    try:
        return variants_of(point)
    except BenchError as error:  # somebody else's code: the others are still listed
        return [("", f"cannot be loaded: {error}")]


def _success(runs: "list[Run]", spec: str, protocol: str) -> str:
    """Episodes under a protocol that a controller solved, `successes/episodes`; empty without a run.

    A run counts for the name that was asked for and for the variant that met its replicate.
    """
    shown = [run.record for run in runs if run.record.protocol == protocol]
    records = [record for record in shown if spec in (record.controller, _met_by(record))]
    succeeded = sum(record.outcomes.get("success", 0) for record in records)
    return f"{succeeded}/{sum(record.completed for record in records)}" if records else ""


def _met_by(record: "RunRecord") -> str:
    """Spec of the controller that met the replicate of a run."""
    from wbc_bench.errors import BenchError
    from wbc_bench.registry import spec_of_replicate

    if record.resolved_controller is not None:
        return record.resolved_controller
    try:
        return spec_of_replicate(record.controller, record.replicate)
    except BenchError:  # its package cannot be imported here, or fails
        return record.controller


def _studies() -> "Table":
    from wbc_bench.results.study import released_studies
    from wbc_bench.results.table import Table

    rows = [
        (study.name, study.protocol, ", ".join(dict.fromkeys(row.spec for row in study.rows)))
        for study in released_studies()
    ]
    return Table("studies", "Studies", ("Name", "Protocol", "Controllers"), tuple(rows))


def _protocols() -> "Table":
    from wbc_bench.episodes.manifest import manifest_path
    from wbc_bench.episodes.protocol import find_protocol, protocol_names
    from wbc_bench.results.table import Table

    rows = []
    for name in protocol_names():
        protocol, path = find_protocol(name)
        episodes = protocol.episodes
        size = f"{episodes.replicates} x {episodes.per_replicate} x {episodes.horizon:g} s"
        frozen = "yes" if manifest_path(path).exists() else "no"
        rows.append((name, size, frozen, protocol.digest[:12], protocol.description))
    header = ("Name", "Replicates x episodes", "Frozen", "Digest", "Description")
    return Table("protocols", "Protocols", header, tuple(rows))


def _ladders() -> "Table":
    from wbc_bench.episodes.ladder import find_ladder, ladder_names
    from wbc_bench.results.table import Table

    rows = []
    for ladder in map(find_ladder, ladder_names()):
        factors = ", ".join(factor.name for factor in ladder.factors)
        rows.append((ladder.name, ladder.source.name, str(ladder.episodes), factors, ladder.description))
    header = ("Name", "Base", "Episodes per level", "Factors", "Description")
    return Table("ladders", "Ladders", header, tuple(rows))


def _sources() -> "Table":
    from wbc_bench.results.table import Table
    from wbc_bench.sources.registry import find_script, script_names

    scripts = [find_script(name) for name in script_names()]
    rows = [
        *((script.name, script.path.__struct_config__.tag, script.description) for script in scripts),
        ("stream", "ZeroMQ", "Targets from another program, see wbc_bench/sources/STREAM.md."),
        ("diffusion", "policy", "Pushes a door shut, see wbc_bench/sources/diffusion/README.md."),
    ]
    return Table("sources", "Sources", ("Name", "Kind", "Description"), tuple(rows))


def _metrics() -> "Table":
    from wbc_bench.results.metrics import METRICS
    from wbc_bench.results.table import Table

    rows = [(metric.name, metric.unit, metric.better, metric.source) for metric in METRICS]
    return Table("metrics", "Metrics", ("Name", "Unit", "Better", "Source"), tuple(rows))


def _benchmarks() -> "Table":
    from importlib.metadata import entry_points

    from wbc_bench.results.table import Table

    rows = [(point.name, point.value) for point in entry_points(group=BENCHMARKS)]
    return Table("benchmarks", "Benchmarks", ("Name", "Comes from"), tuple(rows))


def _runs(runs: "list[Run]", results: Path) -> "Table":
    """Finished runs, then those that were interrupted."""
    from wbc_bench.results.store import ResultStore
    from wbc_bench.results.table import Table

    rows = [
        (
            *(run.record.protocol, run.record.controller, str(run.record.replicate)),
            *(f"{run.record.completed}/{run.record.requested}", run.record.created),
            (run.record.git_commit or "no commit")[:12] + ("+" if run.record.git_dirty else ""),
        )
        for run in runs
    ]
    rows += [
        (
            *(path.parents[1].name, path.parent.name, path.name.removeprefix("replicate_")),
            *(f"{shards} shards", "", ""),
        )
        for path, shards in ResultStore(results).unfinished()
    ]
    header = ("Protocol", "Controller", "Replicate", "Episodes", "Created (UTC)", "Commit")
    return Table("runs", f"Runs under {results}", header, tuple(rows))


@dataclass(frozen=True)
class ExportController:
    """Write a controller to a file for other runtimes, normalisers, window and recurrent state included."""

    controller: str = tyro.MISSING
    """Controller to export: name:variant of one that supports it, e.g. learned:METHOD@SEED."""
    format: str = "onnx"
    """Format of the file to write, one that the controller supports."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Path of the file to write; named after the controller when not given."""
    protocol: str = "ablation_v1"
    """Name of the protocol, or path of its .toml file, whose robot the controller drives."""

    def run(self) -> None:
        from wbc_bench.controller import Exportable
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.errors import ControllerError
        from wbc_bench.files import ensure_file_writable, folder_name, scratch_folder, writing
        from wbc_bench.isolation import blamed
        from wbc_bench.registry import load_controller
        from wbc_bench.robot import load_robot

        robot = load_robot(find_protocol(self.protocol)[0].robot)
        controller = load_controller(self.controller, robot)
        failed = f"controller '{self.controller}' failed in `export`"
        with blamed(failed):
            formats = tuple(controller.formats) if isinstance(controller, Exportable) else ()
        if not isinstance(controller, Exportable) or self.format not in formats:
            raise UnknownNameError("format", self.format, formats, f"--format, for '{self.controller}'")
        path = self.out or Path(f"{folder_name(self.controller)}.{self.format}")
        ensure_file_writable(path)
        with (
            writing(path),
            scratch_folder(path.parent) as folder,
        ):  # one that fails half-way leaves what was there
            with blamed(failed):
                controller.export(folder / path.name, self.format)
            made = [file.name for file in folder.iterdir()]
            if path.name not in made:
                raise ControllerError(f"{failed}: it wrote no file '{path.name}'")
            for name in made:
                (folder / name).replace(path.with_name(name))
        print(path)
