"""Let every command that writes meet every kind of folder: one clear line or success, nothing half or lost.

    nice python .ci/folders.py                  # the whole table; --commands and --kinds choose a part

Commands run on tiny inputs in forks of this process. A folder that a command may refuse must be refused with
exit code 2 and one line; what it held before must be as it was, and whatever is new must be whole. Kinds that
this machine cannot make, e.g. mounts without root, are named and left out. Exit code 1 when a case failed.
"""

import argparse
import contextlib
import ctypes
import errno
import json
import os
import re
import resource
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import types
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module, metadata
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
HOLD = "--controller hold --workers 1"
COMMANDS = {  # name -> words; below {given} are inputs, {out} is the folder in question
    "eval": f"eval {HOLD} --protocol {{given}}/tiny.toml --out {{out}}",
    "ablation": "ablation --study {given}/study.toml --workers 1 --out {out}",
    "reach": f"reach {HOLD} --protocol {{given}}/heights.toml --out {{out}}",
    "stress": f"stress {HOLD} --ladder {{given}}/climb.toml --factors noise --episodes 1 --out {{out}}",
    "track": "track --controller hold --source {given}/still.toml --duration 0.3 --out {out}",
    "replay": "replay tiny/hold/replicate_0 --episode 0 --results {given}/store -o {out}/a.html",
    "strip": "film tiny/hold/replicate_0 --episode 0 --results {given}/store --strip {out}/a.png",
    "film": "film tiny/hold/replicate_0 --episode 0 --results {given}/store -o {out}/a.mp4",
    "grid": "film tiny/hold/replicate_0 --episode 0 --grid 2x1 --results {given}/store -o {out}/a.mp4",
    "recording": "replay tiny/hold/replicate_0 --episode 0 --results {given}/store -o {out}/a.rrd",
    "dataset": "export-dataset tiny/hold/replicate_0 --results {given}/store -o {out}/set",
    "submit": "submit hold --results {given}/store -o {out}/a.zip",
    "demo train": "demo train {given}/d.zarr.zip --updates 1 -o {out}/a.safetensors",
    "demo eval": "demo eval --expert --controller hold --episodes 1 --workers 1 --out {out}",
    "compare": "compare hold {given}/own.py:Own --protocol tiny --results {given}/store --out {out}",
    "report": "report --results {given}/store --out {out}",
    "seal": "protocol freeze smoke_v1 --sealed --secret-file {given}/secret --workers 1 --out {out}",
    "reveal": "protocol reveal --commitment {given}/set/smoke_v1_sealed.commitment.json --secret-file "
    "{given}/secret --workers 1 --out {out}",
    "freeze": "protocol freeze {out}/smoke_v1.toml --workers 1",
    "protocol show": "protocol show smoke_v1 --out {out}",
    "robot export": "robot export --out {out}",
    "robot show": "robot show --out {out}/a.png",
    "export": "export --controller learned:{given}/no_latent@0.safetensors -o {out}/a.onnx",
    "bench": "bench tiny --out {out}",
    "train run": "TRAIN run {tiny} --out {out}",
    "train campaign": "TRAIN campaign --recipe {given}/recipe.toml --from-scratch --methods no_latent "
    "--seeds 1 --threads 1 --out {out}",
    "train curves": "TRAIN curves --out {given}/runs --figures {out}",
    "train targets": "TRAIN targets --count 3 --workers 1 --path {out}/a.parquet",
    "dagger": "TRAIN dagger --teacher hold --episodes 1 --rounds 1 --undisturbed-rounds 0 --updates 1 "
    "--workers 1 --path {out}/a.safetensors",
}
TINY = """--method no_latent --budget 192 --num-envs 8 --num-steps-per-env 6 --num-mini-batches 2 --threads 1
--estimator-share 0.5 --estimator-mini-batches 2 --critic-warmup-iterations 0 --disturbance-ramp 0 0
--posture-loss 0 0 --init-checkpoint '' --teacher ''"""
GIVEN = Path(tempfile.mkdtemp())  # inputs
LONGEST = 300  # [s] of a command
AGAIN = {"eval", "ablation", "reach", "stress"}  # take --overwrite
Faults = list[str]


# --- kinds of folder: each yields the argument, the exit codes that are right, and what a child does first


class Case(NamedTuple):
    """What a command is given."""

    out: Path | str
    right: set[int]  # exit codes
    begin: Callable[[], object] = lambda: None  # what a child does first
    name: str = "a"  # of a file in the folder


Kind = Callable[[Path, str], contextlib.AbstractContextManager[Case]]


def named(name: str) -> Kind:
    @contextmanager
    def kind(case: Path, command: str) -> Iterator[Case]:
        yield Case(case / name, {0})

    return kind


@contextmanager
def relative(case: Path, command: str) -> Iterator[Case]:
    (case / "here").mkdir()
    yield Case("../out/below", {0}, lambda: os.chdir(case / "here"))


@contextmanager
def tilde(case: Path, command: str) -> Iterator[Case]:
    yield Case("~/out", {0}, lambda: os.chdir(case))  # no shell: a folder of that name


@contextmanager
def link(case: Path, command: str) -> Iterator[Case]:
    (case / "real").mkdir()
    (case / "out").symlink_to("real")
    yield Case(case / "out", {0})


@contextmanager
def dangling(case: Path, command: str) -> Iterator[Case]:
    (case / "out").symlink_to("nowhere")
    yield Case(case / "out", {2})


@contextmanager
def loop(case: Path, command: str) -> Iterator[Case]:
    (case / "out").symlink_to("out")
    yield Case(case / "out", {2})


@contextmanager
def file_in_place(case: Path, command: str) -> Iterator[Case]:
    (case / "out").write_text("somebody's")
    yield Case(case / "out", {2})


@contextmanager
def file_above(case: Path, command: str) -> Iterator[Case]:
    (case / "file").write_text("somebody's")
    yield Case(case / "file" / "out", {2})


@contextmanager
def long_file_name(case: Path, command: str) -> Iterator[Case]:
    if "{out}/a" not in COMMANDS[command]:
        raise NotImplementedError
    longest = 255 - max(len(end) for end in (".safetensors", ".onnx.json"))
    yield Case(case / "out", {0}, name="n" * longest)


@contextmanager
def too_long(case: Path, command: str) -> Iterator[Case]:
    yield Case(case / ("n" * 300), {2})


def mode(bits: int) -> Kind:
    @contextmanager
    def kind(case: Path, command: str) -> Iterator[Case]:
        out = case / "out"
        out.mkdir()
        (out / "mine.txt").write_text("mine")
        yield Case(out, {2}, lambda: (out.chmod(bits), _obey_modes()))
        out.chmod(0o755)

    return kind


@contextmanager
def read_only_mount(case: Path, command: str) -> Iterator[Case]:
    with _mounted(case / "out", "16m") as out:
        subprocess.run(["mount", "-o", "remount,ro", out], check=True, capture_output=True)
        yield Case(out, {2})


def full(left: int) -> Kind:
    @contextmanager
    def kind(case: Path, command: str) -> Iterator[Case]:
        with _mounted(case / "out", "256k") as out:
            _fill(out, left)
            yield Case(out, {2} if not left else {0, 2})

    return kind


@contextmanager
def full_again(case: Path, command: str) -> Iterator[Case]:
    with _mounted(case / "out", "16m") as out:
        if command == "freeze":  # it writes beside the protocol
            shutil.copy(ROOT / "protocols" / "smoke_v1.toml", out)
        code, said = run(command, Case(out, {0}))
        assert code == 0, said
        _fill(out, 0)
        yield Case(out, {0, 2})


@contextmanager
def size_limit(case: Path, command: str) -> Iterator[Case]:
    """As a quota that is met in the midst of a file."""
    yield Case(case / "out", {0, 2}, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048)))


def refused(code: int, wanted: set[int], folders: bool) -> Kind:
    """Nothing is synced, or no folder is."""

    @contextmanager
    def kind(case: Path, command: str) -> Iterator[Case]:
        def begin() -> None:
            sync = os.fsync

            def fsync(descriptor: int) -> None:
                if folders and not stat.S_ISDIR(os.fstat(descriptor).st_mode):
                    return sync(descriptor)
                raise OSError(code, os.strerror(code))

            os.fsync = fsync

        yield Case(case / "out", wanted, begin)

    return kind


def in_place_of_the_file(make: Callable[[Path], None]) -> Kind:
    @contextmanager
    def kind(case: Path, command: str) -> Iterator[Case]:
        name = next((Path(word).name for word in COMMANDS[command].split() if "{out}/" in word), "")
        if not name or command == "freeze":
            raise NotImplementedError
        (case / "out").mkdir()
        make(case / "out" / name)
        yield Case(case / "out", {2})

    return kind


def _a_device(path: Path) -> None:
    os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 7))  # as /dev/full is


def _a_folder(path: Path) -> None:
    path.mkdir()
    (path / "mine.txt").write_text("mine")


KINDS: dict[str, Kind] = {
    "new": named("out"),
    "colon": named("a:b"),
    "space": named("two words "),
    "percent": named("100%s{x}$HOME"),
    "not ASCII": named("ü日"),
    "250 bytes": named("n" * 250),
    "dash": named("./-o"),
    "tilde": tilde,
    "relative": relative,
    "link": link,
    "dangling link": dangling,
    "loop": loop,
    "file in its place": file_in_place,
    "file above": file_above,
    "300 bytes": too_long,
    "mode 555": mode(0o555),
    "mode 000": mode(0),
    "read-only mount": read_only_mount,
    "full": full(0),
    "nearly full": full(40_000),
    "full, again": full_again,
    "size limit": size_limit,
    "no sync of folders": refused(errno.EINVAL, {0}, True),
    "failing sync": refused(errno.EIO, {0, 2}, False),
    "long file name": long_file_name,
    "folder for the file": in_place_of_the_file(_a_folder),
    "device for the file": in_place_of_the_file(_a_device),
}


@contextmanager
def _mounted(out: Path, size: str) -> Iterator[Path]:
    out.mkdir()
    try:
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", out], check=True, capture_output=True
        )
    except (OSError, subprocess.CalledProcessError) as error:
        raise NotImplementedError from error
    try:
        (out / "mine.txt").write_text("mine")
        yield out
    finally:
        subprocess.run(["umount", "-l", out], check=True)


def _fill(out: Path, left: int) -> None:
    with contextlib.suppress(OSError), (out / "filler").open("wb", buffering=0) as file:
        while True:
            file.write(b"x" * 4096)
    with contextlib.suppress(OSError):
        os.truncate(out / "filler", max(0, (out / "filler").stat().st_size - left))


def _obey_modes() -> None:
    """Without the right of root to go around the modes of files."""
    if os.geteuid():
        return
    numbers = ctypes.c_uint32 * 6
    version, libc = (ctypes.c_uint32 * 2)(0x20080522, 0), ctypes.CDLL(None, use_errno=True)
    data = numbers()
    if libc.capget(version, data):
        raise OSError(ctypes.get_errno(), "capget")
    kept = ~0b1110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER. Source: linux/capability.h
    for k in range(3):
        data[k] &= kept
    if libc.capset(version, data):
        raise OSError(ctypes.get_errno(), "capset")


# --- a case ---------------------------------------------------------------------------------------------


def run(command: str, case: Case, more: Sequence[str] = ()) -> tuple[int, str]:
    """Exit code of a command, and what it said; negative when it took too long."""
    words: list[str] = []
    for word in COMMANDS[command].split():
        word = word.replace("{out}/a", f"{{out}}/{case.name}").replace("{out}", str(case.out))
        words += shlex.split(TINY) if word == "{tiny}" else [word.replace("{given}", str(GIVEN))]
    words += more
    read, write = os.pipe()
    sys.stdout.flush()
    pid = os.fork()
    if not pid:
        code = 1
        try:
            os.dup2(write, 1), os.dup2(write, 2), os.close(read)
            signal.alarm(LONGEST)
            os.chdir(GIVEN)
            case.begin()
            from wbc_baselines.learned.training import cli as train
            from wbc_bench.cli import main as bench

            train.main(words[1:]) if words[0] == "TRAIN" else bench.main(words)
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            with contextlib.suppress(OSError):
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(code)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        said = pipe.read().decode(errors="replace")
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), said


def contents(folder: Path) -> dict[str, bytes | None]:
    """Whatever is below a folder; None for what is no file."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() and not path.is_symlink() else None
        for path in sorted(folder.rglob("*"))
    }


def is_whole(name: str, data: bytes) -> bool:
    """Whether a file can be read to its end, as far as its kind tells."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    ends = {".html": b"</html>", ".svg": b"</svg>", ".png": b"IEND\xaeB`\x82", ".xml": b"</mujoco>"}
    ends |= {".urdf": b"</robot>"}
    suffix = Path(name).suffix
    try:
        if suffix == ".json":
            json.loads(data)
        elif suffix == ".parquet":
            pq.read_table(pa.BufferReader(data))
        elif suffix in ends:
            return data.rstrip().endswith(ends[suffix])
    except (ValueError, pa.ArrowException, OSError):
        return False
    return bool(data)


def judge(command: str, kind: str, case: Path) -> tuple[int, Faults, str]:
    """Exit code, what is wrong, and what was said."""
    with KINDS[kind](case, command) as given:
        if command == "freeze":  # it writes beside the protocol
            with contextlib.suppress(OSError):
                place = case / "here" / given.out if kind == "relative" else case / given.out
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / "protocols" / "smoke_v1.toml", place)
        before, inputs = contents(case), contents(GIVEN)
        again = kind == "full, again" and command in AGAIN
        code, said = run(command, given, ["--overwrite"] if again else [])
        after = contents(case)
        faults: Faults = []
        if code not in given.right:
            faults.append(f"exit code {code}, right: {given.right}")
        errors = [line for line in said.splitlines() if line.startswith("error: ")]
        if code == 2 and (len(errors) != 1 or not said.rstrip().endswith(errors[0])):
            faults.append("not one line")
        if "Traceback" in said or "Exception ignored" in said:
            faults.append("traceback")
        for name, data in before.items():
            if name not in after or (code and data != after[name] and not _may_go_on(name)):
                faults.append(f"lost or changed: {name}")
        for name, data in after.items():
            if name not in before and data is not None and not is_whole(name, data):
                faults.append(f"half: {name}")
            if ".tmp" in name or ".probe" in name or ".publish" in name:
                faults.append(f"left: {name}")
        if contents(GIVEN) != inputs:
            faults.append("an input changed")
        return code, faults, said


def _may_go_on(name: str) -> bool:
    """A log of a training that goes on where it was."""
    return name.endswith(("metrics.jsonl", "smoke_v1.toml"))


# --- inputs ---------------------------------------------------------------------------------------------


def write_inputs() -> None:
    """What the commands read; and imports, which the forks then have."""
    for name in ("publish", "viewer.film", "viewer.replay", "results.figures.latents", "evaluation.stress"):
        import_module(f"wbc_bench.{name}")
    import pandas as pd

    import damaged_inputs
    import damaged_training
    from policies import write
    from tiny_ladder import write_ladder
    from wbc_bench.episodes.freeze import freeze
    from wbc_bench.episodes.protocol import read_protocol
    from wbc_bench.evaluation.evaluate import evaluate

    write_ladder(GIVEN)
    (GIVEN / "own.py").write_text(
        (ROOT / "examples" / "own_controller.py").read_text() + "\nOwn = GentleArm\n"
    )
    for spec in ("hold", f"{GIVEN}/own.py:Own"):
        evaluate(spec, str(GIVEN / "tiny.toml"), replicates=1, out=GIVEN / "store")
    damaged_inputs.write_sealed_set(GIVEN)
    text = (ROOT / "protocols" / "reach_v1.toml").read_text().replace('"reach_v1"', '"heights"')
    for old, new in REACH:
        text = re.sub(f"(?m)^{old}.*", new, text)
    (GIVEN / "heights.toml").write_text(text)
    freeze(read_protocol(GIVEN / "heights.toml"), GIVEN / "heights.parquet")
    (GIVEN / "study.toml").write_text(STUDY)
    (GIVEN / "recipe.toml").write_text(RECIPE)
    shutil.copy(ROOT / "protocols" / "scripts" / "figure_eight.toml", GIVEN / "still.toml")
    (GIVEN / "runs").mkdir()
    damaged_training.write_training(GIVEN / "runs")
    damaged_training.write_demonstration_files(GIVEN)
    (GIVEN / "plain.zarr.zip").rename(GIVEN / "d.zarr.zip")
    write(GIVEN, "no_latent")
    module = types.ModuleType("tiny_benchmark")
    module.frame = lambda: pd.DataFrame({"a": [1.0]})  # pyright: ignore[reportAttributeAccessIssue]
    sys.modules[module.__name__] = module
    point = metadata.EntryPoint("tiny", "tiny_benchmark:frame", "wbc_bench.benchmarks")
    installed = metadata.entry_points
    metadata.entry_points = lambda **of: [*installed(**of), *([point] if point.group in of.values() else [])]  # pyright: ignore


REACH = (("per_replicate", "per_replicate = 8"), ("heights", "heights = [1.0, 1.1, 0.1]"))
REACH += (("per_height", "per_height = 1"), ("horizon", "horizon = 0.2"), ("window", "window = 0.1"))
RECIPE = """
name = "tiny"

[common]
budget = 192
num_envs = 8
num_steps_per_env = 6
num_mini_batches = 2
estimator_share = 0.5
estimator_mini_batches = 2
critic_warmup_iterations = 0
disturbance_ramp = [0, 0]
posture_loss = [0, 0]

[from_scratch]

[distilled]
"""
STUDY = """
name = "few"
protocol = "smoke_v1"

[[rows]]
heading = "None"
label = "Hold"
spec = "hold"
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--commands", nargs="*", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    options = parser.parse_args()
    sys.path[:0] = [str(ROOT / "tests" / "helpers"), str(ROOT), str(ROOT / "baselines")]
    counts, skipped = Counter(), Counter()
    try:
        write_inputs()
        for command in options.commands:
            for kind in options.kinds:
                with tempfile.TemporaryDirectory() as folder:
                    try:
                        code, faults, said = judge(command, kind, Path(folder))
                    except NotImplementedError:
                        skipped[kind] += 1
                        continue
                counts["failed" if faults else "written" if code == 0 else "refused in one line"] += 1
                if faults:
                    print(f"{command}, {kind}: {'; '.join(faults)}\n    {said.strip()[-600:]}", flush=True)
    finally:
        shutil.rmtree(GIVEN)
    print(f"{sum(counts.values())} cases: " + ", ".join(f"{n} {what}" for what, n in sorted(counts.items())))
    print("not made: " + (", ".join(f"{kind} ({n})" for kind, n in sorted(skipped.items())) or "none"))
    return bool(counts["failed"])


if __name__ == "__main__":
    sys.exit(main())
