"""The command line: `wbc-bench COMMAND --help`.

Each command is a frozen dataclass, its fields the options. Everything heavy is imported when a command runs.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, subcommand

from wbc_bench.errors import BenchError, UnknownNameError

if TYPE_CHECKING:
    from wbc_bench.evaluation.workers import Engine
    from wbc_bench.results.store import ResultStore
    from wbc_bench.results.tracking import Tracked
    from wbc_bench.robot import Robot, RobotConfig

# One thread a worker, whatever a library would like: set before numpy is loaded, inherited by workers.
THREADS = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "VECLIB_MAXIMUM")
}
BENCHMARKS = "wbc_bench.benchmarks"  # entry points: name -> a callable that returns a DataFrame
INPUTS = (
    "wbc_bench.inputs"  # entry points: name -> a callable that returns rows (vector, columns, term, unit)
)


class UsageError(BenchError):
    """An option out of its range."""


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class _Evaluation:
    """Options of every command that evaluates."""

    workers: int = field(default_factory=_cores)
    """Processes; the results do not depend on it."""
    engine: str = "loky"
    """loky (this machine), dask (a cluster started here) or dask=ADDRESS (a running scheduler)."""
    out: Path = Path("results")
    """Folder of records, tables and figures; an interrupted evaluation resumes there."""
    redo: FlagCreatePairsOff[bool] = False
    """Evaluate again what is already there."""

    def _engine(self) -> "Engine":
        from wbc_bench.evaluation.workers import Engine

        _at_least_one("--workers", self.workers)
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
        seeds = _within("--seeds", seeds, asked.replicates, f"replicates of {protocol.name}")
        episodes = _within(
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
        from wbc_bench.results.study import ABLATION, Row
        from wbc_bench.results.tables.pairs import pair_table
        from wbc_bench.results.tables.paper import paper_table

        study = ABLATION
        specs = self.controllers or tuple(Row(*row).spec for row in study.rows)
        store = self._evaluate(
            study.protocol, specs, self.seeds, self.episodes, optional=not self.controllers
        )
        publish(store, self.out)
        evaluated = collect(store.runs(study.protocol))
        _print_table(paper_table(study, evaluated))
        pairs = pair_table(study, evaluated)
        if pairs.rows:
            _print_table(pairs)
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
        from wbc_bench.results.tables.reach import reach_table

        protocol, _ = find_protocol(self.protocol)
        if not isinstance(protocol.targets, ReachTargets):
            raise UsageError(f"--protocol {self.protocol}: its targets are not of type 'reach'")
        store = self._evaluate(self.protocol, self.controller, None, None)
        publish(store, self.out)
        _print_table(reach_table(protocol.name, collect(store.runs(protocol.name))))
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
        study = Study(find_protocol(self.protocol)[0].name, ())
        evaluated = collect(store.runs(study.protocol))
        _print_table(paper_table(study, evaluated))
        _print_table(outcome_table(study, evaluated))
        print(f"records are under {self.out}; `wbc-bench report` makes tables and figures of them")


@dataclass(frozen=True)
class Track:
    """Let controllers follow moving targets, one simulated episode each, and score how."""

    controller: tuple[str, ...] = tyro.MISSING
    """Controllers: name, name:variant, module:attribute or file.py:attribute."""
    source: tuple[str, ...] = tyro.MISSING
    """Sources: a script of the library, a .toml file, `stream`, `stream:SCRIPT` to send one through it,
    `diffusion[:FILE]`, a policy in front of a door, or `live`, a person who drags the target in a page."""
    duration: float | None = None
    """Seconds; until the script ends when not given, 20 for other sources."""
    seed: int = 0
    """Of the draws of a randomised episode, and of the door."""
    condition: str = "nominal"
    """nominal, or randomised: friction, mass, gains, reset state, pushes and noise of ablation_v1."""
    address: str = "tcp://127.0.0.1:5601"
    """Where a stream listens."""
    port: int = 8080
    """Of the page of `live`."""
    allow_remote: FlagCreatePairsOff[bool] = False
    """Let other machines reach the stream or the page, and move the robot."""
    out: Path = Path("results")
    """Folder of records, table and figure."""

    def run(self) -> None:
        from wbc_bench.episodes.single import CONDITIONS
        from wbc_bench.files import ensure_writable
        from wbc_bench.publish import publish_tracks
        from wbc_bench.registry import load_controller
        from wbc_bench.results.tracking import read_tracks, tracking_table, write_track
        from wbc_bench.robot import load_robot
        from wbc_bench.sources.library import check_source
        from wbc_bench.sources.live import LIVE

        for option, given in (("--controller", self.controller), ("--source", self.source)):
            if not given:
                raise UsageError(f"{option}: give at least one")
        _not_negative("--seed", self.seed)
        _check_port(self.port)
        if self.condition not in CONDITIONS:
            raise UnknownNameError("condition", self.condition, CONDITIONS, "--condition")
        for name in self.source:
            check_source(name)
        for spec in self.controller:
            load_controller(spec, load_robot())
        ensure_writable(self.out)
        for name in dict.fromkeys(self.source):
            for spec in dict.fromkeys(self.controller):
                tracked, facts = self._drag(spec) if name == LIVE else self._play(name, spec)
                write_track(self.out, tracked, **facts)
        publish_tracks(self.out, self.out)
        _print_table(tracking_table(read_tracks(self.out)))
        print(f"record, table and figure are under {self.out}")

    def _play(self, name: str, spec: str) -> "tuple[Tracked, dict]":
        """Let a controller follow a source of a name; the series, and what the record says beside it."""
        from wbc_bench.episodes.single import door_protocol
        from wbc_bench.errors import SourceError
        from wbc_bench.evaluation.tracking import facts, track
        from wbc_bench.registry import load_controller
        from wbc_bench.robot import load_robot
        from wbc_bench.sources.library import load_source

        controller = load_controller(spec, load_robot())
        source = load_source(name, self.address, self.allow_remote, door_protocol(self.seed))
        if self.allow_remote and source.live:
            print(f"listening on {self.address}: whoever can send there moves the robot", file=sys.stderr)
        try:
            tracked, asked = track(controller, source, self.condition, self.seed, self.duration)
        except SourceError as error:
            raise UsageError(f"--source {name}: {error}") from error
        finally:
            source.close()
        return tracked, facts(controller, spec, source, self.condition, self.seed) | {"requested_s": asked}

    def _drag(self, spec: str) -> "tuple[Tracked, dict]":
        """Let a controller follow what a person drags in a page; as `_play`."""
        from wbc_bench.episodes.single import UNSCRIPTED, episode_of
        from wbc_bench.evaluation.tracking import facts
        from wbc_bench.sources.live import LIVE
        from wbc_bench.viewer.live import serve
        from wbc_bench.viewer.session import Session

        asked = UNSCRIPTED if self.duration is None else self.duration
        session = Session(spec, LIVE, *episode_of(asked, self.seed, self.condition))

        def ready(url: str) -> None:
            print(f"{url}: drag the target there; {asked:g} s from the first drag on are scored", flush=True)

        serve(_host(self.allow_remote), self.port, session, ready, once=True)
        what = facts(session.controller, spec, session.source, self.condition, self.seed)
        return session.tracked, what | {"requested_s": asked}


@dataclass(frozen=True)
class Live:
    """Watch a controller in the browser, in real time, and drag its target."""

    controller: str = tyro.MISSING
    """Controller: name, name:variant, module:attribute or file.py:attribute."""
    source: str = "live"
    """live: the target is dragged in the page. Otherwise a source as `track` takes it."""
    protocol: str = "ablation_v1"
    """Protocol whose physics, randomisation, noise and limits hold."""
    condition: str = "nominal"
    """nominal, or randomised: friction, mass, gains, reset state and noise of the protocol."""
    seed: int = 0
    """Of the draws of a randomised episode."""
    port: int = 8080
    """Of the page."""
    allow_remote: FlagCreatePairsOff[bool] = False
    """Let other machines open the page, and move the robot."""

    def run(self) -> None:
        from wbc_bench.episodes.single import free_episode
        from wbc_bench.viewer.live import serve
        from wbc_bench.viewer.session import LONGEST, Session

        _check_port(self.port)
        _not_negative("--seed", self.seed)
        episode = free_episode(self.protocol, self.condition, self.seed, LONGEST)
        session = Session(self.controller, self.source, *episode)

        def ready(url: str) -> None:
            print(f"{url}  (Ctrl-C ends it)", flush=True)

        try:
            serve(_host(self.allow_remote), self.port, session, ready)
        except KeyboardInterrupt:
            print()


@dataclass(frozen=True)
class _Again:
    name: Annotated[Positional[str], tyro.conf.arg(name="run")]
    """Folder of a run, or <protocol>/<controller>/replicate_<k> of the records."""
    episode: int = tyro.MISSING
    """Number of the episode inside its replicate."""
    results: Path = Path("results")
    """Folder of the records."""
    protocol: str | None = None
    """File of the run's protocol, where that is not a released one."""

    def _check_folder(self, path: Path) -> None:
        """Before minutes are spent on what cannot be written."""
        from wbc_bench.files import ensure_writable

        ensure_writable(path.parent)


@dataclass(frozen=True)
class Replay(_Again):
    """Run one episode of a stored run again, compare it with its record, and write it as a page to watch."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("replay.html")
    """Page to write; it needs no network."""

    def run(self) -> None:
        from wbc_bench.progress import Progress
        from wbc_bench.results.store import ResultStore
        from wbc_bench.viewer.replay import write_html

        self._check_folder(self.out)
        run = ResultStore(self.results).find(self.name)
        with Progress("steps") as progress:
            again = write_html(run, self.episode, self.out, self.protocol, progress.update)
        print(f"{again.title}: {again.stored['outcome']}\n{again.verdict}\n{self.out}")


@dataclass(frozen=True)
class Film(_Again):
    """Run one episode of a stored run again and film it, or draw successive pictures of it side by side."""

    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Film to write (.mp4)."""
    strip: Path | None = None
    """Strip of pictures to write (.png), and its caption beside it (.txt)."""
    times: tuple[float, ...] | None = None
    """Seconds of the pictures of a strip; six, evenly over the episode, when not given."""

    def run(self) -> None:
        from matplotlib import image

        try:
            import mujoco  # noqa: F401
        except (ImportError, AttributeError) as error:  # it loads the library of MUJOCO_GL at once
            chosen = os.environ.get("MUJOCO_GL", "")
            raise UsageError(
                f"MuJoCo cannot draw with MUJOCO_GL={chosen} ({error}): install it or unset that"
            ) from error

        from wbc_bench.files import write_atomic
        from wbc_bench.progress import Progress
        from wbc_bench.results.store import ResultStore
        from wbc_bench.viewer.film import strip_caption, strip_of, write_film_of
        from wbc_bench.viewer.rerun import rerun

        if self.out is None and self.strip is None:
            raise UsageError("nothing to write: give -o FILE.mp4, --strip FILE.png or both")
        for path, suffix in ((self.out, ".mp4"), (self.strip, ".png")):
            if path and path.suffix != suffix:
                raise UsageError(f"'{path}': valid: a file that ends in {suffix}")
            if path:
                self._check_folder(path)
        run = ResultStore(self.results).find(self.name)
        with Progress("steps") as progress:
            again = rerun(run, self.episode, self.protocol, progress.update)
        print(f"{again.title}: {again.stored['outcome']}\n{again.verdict}")
        if self.out:
            with Progress("pictures") as progress:
                write_film_of(again, self.out, progress.update)
            print(self.out)
        if self.strip:
            pixels = strip_of(again, self.times)
            image.imsave(self.strip, pixels, format="png", pil_kwargs={"pnginfo": None})
            write_atomic(self.strip.with_suffix(".txt"), strip_caption(again, self.times).encode())
            print(self.strip)


@dataclass(frozen=True)
class Compare:
    """Compare two evaluated controllers on the episodes that both met."""

    a: Positional[str]
    """Controller."""
    b: Positional[str]
    """Controller it is compared with."""
    protocol: str = "ablation_v1"
    """Protocol of the runs."""
    results: Path = Path("results")
    """Folder of the records."""
    out: Path | None = None
    """Also write the table into this folder."""

    def run(self) -> None:
        from wbc_bench.files import ensure_writable
        from wbc_bench.results.analysis import collect
        from wbc_bench.results.store import ResultStore
        from wbc_bench.results.tables.pairs import compare_table
        from wbc_bench.results.tables.write import write_compare_table

        evaluated = collect(ResultStore(self.results).runs(self.protocol))
        _print_table(compare_table(self.protocol, evaluated, self.a, self.b))
        if self.out:
            ensure_writable(self.out)
            write_compare_table(self.protocol, evaluated, self.a, self.b, self.out)


@dataclass(frozen=True)
class Report:
    """Make every table, every figure and report.html anew from the records; nothing is evaluated."""

    results: Path = Path("results")
    """Folder of the records."""
    out: Path | None = None
    """Where to write; the folder of the records when not given."""
    workspace: tuple[str, ...] = ()
    """Controllers whose success over the workspace is drawn side by side; the best two when not given."""

    def run(self) -> None:
        from wbc_bench.publish import publish
        from wbc_bench.results.store import ResultStore

        for path in publish(ResultStore(self.results), self.out or self.results, self.workspace):
            print(path)


@dataclass(frozen=True)
class Latent:
    """Draw the latent of a controller's estimator by phase of the task: t-SNE and LDA side by side."""

    controller: str = tyro.MISSING
    """Controller that shows its latent, e.g. learned:METHOD@SEED."""
    protocol: str = "ablation_v1"
    """Name of a released protocol, or a .toml file with its manifest beside it."""
    episodes: int = 40
    """First episodes of replicate 0; half of them are held out to test the discriminant."""
    seed: int = 0
    """Of the halves, of the points drawn and of t-SNE."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("results/figures")
    """Folder of the figure and its numbers; a report beside it shows them."""

    def run(self) -> None:
        from wbc_bench.episodes.manifest import manifest_path, read_manifest
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.evaluation.latents import sample_latents
        from wbc_bench.files import ensure_writable
        from wbc_bench.registry import load_controller, spec_of_replicate
        from wbc_bench.results.figures.latents import summary, write_latents
        from wbc_bench.results.latents import LEAST_EPISODES
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
        samples = sample_latents(controller, protocol, rows)
        ensure_writable(self.out)
        found, paths = write_latents(controller.info.name, protocol.name, samples, self.seed, self.out)
        print(*summary(samples, found), *paths, sep="\n")


@dataclass(frozen=True)
class List:
    """List controllers, protocols, sources, metrics, benchmarks and runs."""

    results: Path = Path("results")
    """Folder of the records."""
    inputs: FlagCreatePairsOff[bool] = False
    """Instead, what stands in which column of the inputs of learned controllers."""

    def run(self) -> None:
        from importlib.metadata import entry_points

        from wbc_bench.results.table import Table

        if self.inputs:
            for point in sorted(entry_points(group=INPUTS), key=lambda point: point.name):
                header = ("Vector", "Columns", "Size", "Term", "Unit")
                _print_table(Table(point.name, f"Inputs of {point.name}", header, tuple(point.load()())))
            return

        from wbc_bench.episodes.manifest import manifest_path
        from wbc_bench.episodes.protocol import find_protocol, protocol_names
        from wbc_bench.registry import controllers
        from wbc_bench.results.metrics import METRICS
        from wbc_bench.results.store import ResultStore
        from wbc_bench.sources.library import find_script, script_names

        rows = [(name, point.value) for name, point in sorted(controllers().items())]
        _print_table(Table("controllers", "Controllers", ("Name", "Comes from"), tuple(rows)))
        rows = []
        for name in protocol_names():
            protocol, path = find_protocol(name)
            episodes = protocol.episodes
            size = f"{episodes.replicates} x {episodes.per_replicate} x {episodes.horizon:g} s"
            frozen = "yes" if manifest_path(path).exists() else "no"
            rows.append((name, size, frozen, protocol.digest[:12], protocol.description))
        header = ("Name", "Replicates x episodes", "Frozen", "Digest", "Description")
        _print_table(Table("protocols", "Protocols", header, tuple(rows)))
        scripts = [find_script(name) for name in script_names()]
        rows = [
            *((script.name, script.path.__struct_config__.tag, script.description) for script in scripts),
            ("stream", "ZeroMQ", "Targets from another program, see wbc_bench/sources/STREAM.md."),
            ("diffusion", "policy", "Pushes a door shut, see wbc_bench/sources/diffusion/README.md."),
        ]
        _print_table(Table("sources", "Sources", ("Name", "Kind", "Description"), tuple(rows)))
        rows = [(metric.name, metric.unit, metric.better, metric.source) for metric in METRICS]
        _print_table(Table("metrics", "Metrics", ("Name", "Unit", "Better", "Source"), tuple(rows)))
        rows = [(point.name, point.value) for point in entry_points(group=BENCHMARKS)]
        _print_table(Table("benchmarks", "Benchmarks", ("Name", "Comes from"), tuple(rows)))
        store = ResultStore(self.results)
        rows = [
            (
                *(run.record.protocol, run.record.controller, str(run.record.replicate)),
                *(f"{run.record.completed}/{run.record.requested}", run.record.created),
                (run.record.git_commit or "no commit")[:12] + ("+" if run.record.git_dirty else ""),
            )
            for run in store.runs()
        ]
        rows += [
            (
                path.parents[1].name,
                path.parent.name,
                path.name.removeprefix("replicate_"),
                f"{shards} shards",
                "",
                "",
            )
            for path, shards in store.unfinished()
        ]
        header = ("Protocol", "Controller", "Replicate", "Episodes", "Created (UTC)", "Commit")
        _print_table(Table("runs", f"Runs under {self.results}", header, tuple(rows)))


@dataclass(frozen=True)
class ExportController:
    """Write a controller to a file for other runtimes, normalisers, window and recurrent state included."""

    controller: str = tyro.MISSING
    """Controller that can be exported: name:variant."""
    format: str = "onnx"
    """Format of the file."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File to write; named after the controller when not given."""
    protocol: str = "ablation_v1"
    """Protocol whose robot it drives."""

    def run(self) -> None:
        from wbc_bench.controller import Exportable
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.files import ensure_writable, folder_name
        from wbc_bench.registry import load_controller
        from wbc_bench.robot import load_robot

        robot = load_robot(find_protocol(self.protocol)[0].robot)
        controller = load_controller(self.controller, robot)
        formats = controller.formats if isinstance(controller, Exportable) else ()
        if not isinstance(controller, Exportable) or self.format not in formats:
            raise UnknownNameError("format", self.format, formats, f"--format, for '{self.controller}'")
        path = self.out or Path(f"{folder_name(self.controller)}.{self.format}")
        ensure_writable(path.parent)
        controller.export(path, self.format)
        print(path)


@dataclass(frozen=True)
class Freeze:
    """Draw the manifest of a protocol and write it beside the protocol file."""

    name: Positional[str]
    """Name of a released protocol, or a .toml file."""
    workers: int = field(default_factory=_cores)
    """Processes; the manifest does not depend on it."""

    def run(self) -> None:
        from wbc_bench.episodes.freeze import freeze
        from wbc_bench.episodes.manifest import manifest_path
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.progress import Progress

        _at_least_one("--workers", self.workers)
        protocol, path = find_protocol(self.name)
        with Progress("draws") as progress:
            sha256 = freeze(protocol, manifest_path(path), progress.update, self.workers)
        print(f"{sha256}  {manifest_path(path)}")


@dataclass(frozen=True)
class Verify:
    """Check the manifest of a protocol: hash, counts, ranges, feasibility of a sample."""

    name: Positional[str]
    """Name of a released protocol, or a .toml file."""

    def run(self) -> None:
        from wbc_bench.episodes.manifest import manifest_path
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.episodes.verify import verify
        from wbc_bench.errors import ManifestError

        protocol, path = find_protocol(self.name)
        checks = verify(protocol, manifest_path(path))
        for check in checks:
            print(f"{'ok    ' if check.ok else 'FAILED'} {check.name}: {check.detail}")
        failed = [check for check in checks if not check.ok]
        if failed:
            names = "; ".join(f"{check.name}: {check.detail}" for check in failed)
            raise ManifestError(f"manifest of {protocol.name} does not hold what it promises: {names}")


@dataclass(frozen=True)
class Show:
    """Print what a protocol asks for and draw its targets."""

    name: Positional[str]
    """Name of a released protocol, or a .toml file."""
    out: Path = Path()
    """Folder of the picture."""

    def run(self) -> None:
        import msgspec

        from wbc_bench.episodes.manifest import manifest_path, read_manifest
        from wbc_bench.episodes.protocol import find_protocol
        from wbc_bench.files import ensure_writable
        from wbc_bench.publish import target_frame
        from wbc_bench.results.figures.targets import write_targets

        protocol, path = find_protocol(self.name)
        print(f"# digest {protocol.digest}")
        print(msgspec.json.format(msgspec.json.encode(protocol), indent=2).decode())
        manifest, sha256 = read_manifest(protocol, manifest_path(path))
        print(f"# manifest sha256 {sha256}")
        print(target_frame(manifest).groupby("stratum").describe().T.to_string())
        ensure_writable(self.out)
        for picture in write_targets(target_frame(manifest), protocol.name, self.out):
            print(picture)


@dataclass(frozen=True)
class _Robot:
    mount: str = ""
    """Where the arm stands; the default of the facts file when not given."""
    tcp: str = ""
    """End-effector frame."""
    ankle_effort: float | None = None
    """Torque limit of the ankles [N m]."""

    def _config(self) -> "RobotConfig":
        from wbc_bench.robot import RobotConfig

        return RobotConfig(mount=self.mount, tcp=self.tcp, ankle_effort=self.ankle_effort)


@dataclass(frozen=True)
class Export(_Robot):
    """Write the robot as MuJoCo XML and as URDF."""

    out: Path = tyro.MISSING
    """Folder to write to."""

    def run(self) -> None:
        from wbc_bench.files import ensure_writable, write_atomic
        from wbc_bench.robot import build_spec, load_robot

        robot = load_robot(self._config())
        ensure_writable(self.out)
        spec = build_spec(robot.facts, robot.config)
        spec.compile()  # to_xml writes what was compiled
        for suffix, text in (("xml", spec.to_xml()), ("urdf", robot.urdf())):
            path = self.out / f"{robot.facts.name}.{suffix}"
            write_atomic(path, text.encode())
            print(path)


@dataclass(frozen=True)
class Picture(_Robot):
    """Draw the robot in its default posture."""

    out: Path = Path("robot.png")
    """Picture to write."""

    def run(self) -> None:
        from wbc_bench.files import ensure_writable
        from wbc_bench.robot import load_robot
        from wbc_bench.viewer.picture import render

        robot = load_robot(self._config())
        ensure_writable(self.out.parent)
        render(robot, self.out)
        print(self.out)


@dataclass(frozen=True)
class Bench:
    """Time what the installed packages offer to be timed, e.g. the solvers of the IK controller."""

    names: Positional[tuple[str, ...]] = ()
    """Benchmarks; all of them when not given."""
    out: Path | None = None
    """Also write <name>.csv and <name>.md into this folder."""

    def run(self) -> None:
        from importlib.metadata import entry_points

        from wbc_bench.files import ensure_writable
        from wbc_bench.results.table import Table

        found = {point.name: point for point in entry_points(group=BENCHMARKS)}
        for name in self.names:
            if name not in found:
                raise UnknownNameError("benchmark", name, found, f"entry points of '{BENCHMARKS}'")
        if self.out:
            ensure_writable(self.out)
        for name in self.names or sorted(found):
            frame = found[name].load()()
            cells = [
                tuple(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row) for row in frame.values
            ]
            table = Table(name, f"Benchmark {name}", tuple(map(str, frame.columns)), tuple(cells), data=frame)
            _print_table(table)
            if self.out:
                table.write(self.out)


@dataclass(frozen=True)
class DemoRecord:
    """Record an expert that pushes doors shut, in UMI's zarr layout; equal options give equal bytes."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = tyro.MISSING
    """File to write: FILE.zarr.zip."""
    episodes: int = 100
    """Doors."""
    seed: int = 0
    """Of the doors."""
    controller: str = "ik"
    """Controller that the expert drives."""
    workers: int = field(default_factory=_cores)
    """Processes; the file does not depend on it."""

    def run(self) -> None:
        from wbc_bench.evaluation.doors import record
        from wbc_bench.files import ensure_writable
        from wbc_bench.progress import Progress

        _at_least_one("--episodes", self.episodes)
        _at_least_one("--workers", self.workers)
        _not_negative("--seed", self.seed)
        ensure_writable(self.out.parent)
        with Progress("episodes") as progress:
            kept = record(self.out, self.controller, self.seed, self.episodes, self.workers, progress.update)
        print(f"{self.out}: {kept} of {self.episodes} episodes closed their door and are kept")


@dataclass(frozen=True)
class DemoTrain:
    """Train a diffusion policy on demonstrations; a few minutes on one core."""

    demonstrations: Positional[Path]
    """File that `demo record` wrote."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = tyro.MISSING
    """File to write: POLICY.safetensors."""
    seed: int = 0
    """Of the weights, the windows and the noise."""
    updates: int = 6000
    """Steps of the optimiser."""

    def run(self) -> None:
        import time

        from wbc_bench.errors import SourceError
        from wbc_bench.files import ensure_writable
        from wbc_bench.progress import Progress

        try:
            from wbc_bench.sources.diffusion.policy import save_policy
            from wbc_bench.sources.diffusion.training import train
        except ImportError as error:
            raise SourceError(
                "training needs torch and safetensors: pip install 'wbc-bench[diffusion]'"
            ) from error

        _at_least_one("--updates", self.updates)
        _not_negative("--seed", self.seed)
        ensure_writable(self.out.parent)
        start = time.monotonic()
        with Progress("updates") as progress:
            policy, card = train(
                self.demonstrations,
                self.seed,
                self.updates,
                lambda update, loss: progress.update(update + 1, self.updates, f"loss {loss:.4f}"),
            )
        save_policy(self.out, policy, card)
        took = time.monotonic() - start
        print(
            f"{self.out}: {card.demonstrations} demonstrations, {card.samples} windows, "
            f"{card.steps} updates in {took:.0f} s"
        )


@dataclass(frozen=True)
class DemoEval:
    """Let a policy, or the expert, drive a controller in front of doors, and count the closed ones."""

    policy: Positional[Path | None] = None
    """File that `demo train` wrote; the packaged policy when not given."""
    controller: str = "ik"
    """Controller: name, name:variant, module:attribute or file.py:attribute."""
    expert: FlagCreatePairsOff[bool] = False
    """The scripted expert instead of a policy."""
    episodes: int = 50
    """Doors."""
    seed: int = 1
    """Of the doors and the policy's noise; not that of the demonstrations."""
    condition: str = "nominal"
    """nominal, or randomised: friction, mass, gains, reset state, pushes and noise of ablation_v1."""
    workers: int = field(default_factory=_cores)
    """Processes; the results do not depend on it."""
    out: Path = Path("results")
    """Folder of the record and the table."""

    def run(self) -> None:
        from wbc_bench.episodes.single import CONDITIONS
        from wbc_bench.evaluation.doors import evaluate
        from wbc_bench.progress import Progress
        from wbc_bench.publish import publish_doors
        from wbc_bench.results.doors import door_table, read_doors

        _at_least_one("--episodes", self.episodes)
        _at_least_one("--workers", self.workers)
        _not_negative("--seed", self.seed)
        if self.condition not in CONDITIONS:
            raise UnknownNameError("condition", self.condition, CONDITIONS, "--condition")
        if self.expert and self.policy:
            raise UsageError(f"--expert and '{self.policy}': give one of them")
        with Progress("episodes") as progress:
            evaluate(
                self.out,
                None if self.expert else str(self.policy or ""),
                self.controller,
                self.condition,
                self.seed,
                self.episodes,
                self.workers,
                progress.update,
            )
        publish_doors(self.out, self.out)
        _print_table(door_table(read_doors(self.out)))
        print(f"record and table are under {self.out}")


Command = (
    Annotated[Ablation, subcommand("ablation")]
    | Annotated[Reach, subcommand("reach")]
    | Annotated[Eval, subcommand("eval")]
    | Annotated[Track, subcommand("track")]
    | Annotated[Live, subcommand("live")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Film, subcommand("film")]
    | Annotated[
        Annotated[DemoRecord, subcommand("record")]
        | Annotated[DemoTrain, subcommand("train")]
        | Annotated[DemoEval, subcommand("eval")],
        subcommand("demo", description="Record, learn and score the pushing of doors."),
    ]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Report, subcommand("report")]
    | Annotated[Latent, subcommand("latent")]
    | Annotated[List, subcommand("list")]
    | Annotated[
        Annotated[Freeze, subcommand("freeze")]
        | Annotated[Verify, subcommand("verify")]
        | Annotated[Show, subcommand("show")],
        subcommand("protocol", description="Freeze, verify or show a protocol."),
    ]
    | Annotated[
        Annotated[Export, subcommand("export")] | Annotated[Picture, subcommand("show")],
        subcommand("robot", description="Export or draw the robot."),
    ]
    | Annotated[ExportController, subcommand("export")]
    | Annotated[Bench, subcommand("bench")]
)


def _at_least_one(option: str, value: int) -> None:
    if value < 1:
        raise UsageError(f"{option} {value}: valid: 1 or more")


def _not_negative(option: str, value: int) -> None:
    if value < 0:
        raise UsageError(f"{option} {value}: valid: 0 or more")


def _check_port(port: int) -> None:
    if not 0 < port < 1 << 16:
        raise UsageError(f"--port {port}: valid: 1 to 65535")


def _host(allow_remote: bool) -> str:
    return "0.0.0.0" if allow_remote else "127.0.0.1"


def _within(option: str, value: int | None, most: int, what: str) -> int:
    if value is None:
        return most
    if not 1 <= value <= most:
        raise UsageError(f"{option} {value}: valid: 1 to {most} ({what})")
    return value


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


def _print_table(table) -> None:
    if sys.stdout.isatty():
        from rich.console import Console

        Console().print(table.rich())
    else:
        print(table.markdown())


def main(arguments: list[str] | None = None) -> None:
    """Entry point; ends as `run_command` says."""
    os.environ.update(THREADS)
    command = tyro.cli(
        Command, prog="wbc-bench", description="Whole-body controllers on identical episodes.", args=arguments
    )
    run_command(command.run, "finished shards are kept, the same command resumes")


def run_command(run: Callable[[], None], interrupted: str) -> None:
    """Run a command; exits with 2 on a mistake of the user and with 130, and a remark, when interrupted."""
    try:
        run()
    except BenchError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # the reader went away, e.g. `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except KeyboardInterrupt:
        print(f"interrupted: {interrupted}", file=sys.stderr)
        sys.exit(130)
