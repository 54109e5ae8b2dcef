"""The folder of a training run: configuration, metrics, resume file, checkpoint. Every write is atomic."""

import io
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_bench.errors import StoreError
from wbc_bench.files import ensure_writable, write_atomic, writing
from wbc_bench.readers import read_bytes, read_json, read_text, reading

if TYPE_CHECKING:
    from wbc_baselines.learned.training.trainer import Trainer

CHECKPOINT_PERIOD = 90.0  # [s] between resume files, the most that is lost when a run is killed
STALE = 900.0  # [s] without an update after which a claim may be taken over


class _Finished(msgspec.Struct):
    """What is read of the note that a run leaves when it is finished."""

    samples: int


@dataclass(frozen=True)
class RunFolder:
    """The files of one run below `path`."""

    path: Path

    @property
    def config(self) -> Path:
        """Settings of the run, as JSON."""
        return self.path / "config.json"

    @property
    def metrics(self) -> Path:
        """One JSON object per iteration; a line written after a resume replaces all from its iteration on."""
        return self.path / "metrics.jsonl"

    @property
    def changes(self) -> Path:
        """One JSON object per change: control steps so far, and the old and new value of each setting."""
        return self.path / "changes.jsonl"

    @property
    def resume(self) -> Path:
        """State from which an interrupted run continues."""
        return self.path / "resume.pt"

    @property
    def checkpoint(self) -> Path:
        """Checkpoint for an evaluation, `learned:PATH`, written together with the resume file."""
        return self.path / f"{self.path.name}.safetensors"

    def kept(self, samples: int) -> Path:
        """Checkpoint after so many control steps that no later one replaces, for `average`."""
        return self.path / "kept" / f"{self.path.name}.{samples}.safetensors"

    @property
    def claim(self) -> Path:
        """Host and process that trains the run."""
        return self.path / "claim"

    @property
    def finished(self) -> Path:
        """Written last, when the budget is used up and the final checkpoint exists."""
        return self.path / "finished.json"

    def open(self, config: TrainConfig, change: bool = False) -> None:
        """Create the folder, or check that its run has the same settings.

        Args:
            config: Configuration of the run.
            change: Whether other settings are accepted and recorded in `changes`.

        Raises:
            TrainingError: The folder holds a run with other settings, which are listed.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        if self.config.exists():
            changed = config.changes(self.settings())
            fixed = ("method", "seed", "protocol")  # what the run is called and judged by
            wrong = {n: c for n, c in changed.items() if not change or n in fixed}
            if wrong:
                told = ", ".join(f"{name} {old} -> {new}" for name, (old, new) in wrong.items())
                raise TrainingError(
                    f"run '{self.path}' was started with other settings: {told}; "
                    "valid: the same, another --out, or --change"
                    + (f", but for {', '.join(fixed)}" if change else "")
                )
            if changed:
                rows = self.read_metrics()
                row = {"samples": rows[-1]["samples"] if rows else 0, "changed": changed}
                _append(self.changes, row)
        write_atomic(self.config, json.dumps(asdict(config), indent=2).encode())

    def settings(self) -> dict[str, Any]:
        """Read the settings that the run was started with. Raises: TrainingError, the file is damaged."""
        return read_json(self.config, dict[str, Any], "configuration", TrainingError)

    def read_metrics(self) -> list[dict]:
        """Read the metrics of all iterations.

        A line that was cut short by a kill, or is otherwise not a row, is left out.

        Raises:
            TrainingError: The file cannot be read.
        """
        if not self.metrics.exists():
            return []
        rows: list[dict] = []
        for line in read_bytes(self.metrics, "metrics", TrainingError).splitlines():
            try:
                row = msgspec.json.decode(line, type=dict[str, float | None])
                iteration, samples = row["iteration"], row["samples"]
            except (ValueError, KeyError, RecursionError):
                continue
            if iteration is None or samples is None:
                continue
            while rows and rows[-1]["iteration"] >= iteration:
                rows.pop()  # lost in a kill, and trained again
            rows.append(row | {"iteration": int(iteration), "samples": int(samples)})
        return rows

    def samples_when_finished(self) -> int | None:
        """Return the control steps of a finished run; None if it is not finished.

        Raises:
            TrainingError: The file cannot be read.
        """
        if not self.finished.exists():
            return None
        return read_json(self.finished, _Finished, "note of a finished run", TrainingError).samples

    def append(self, row: dict) -> None:
        """Append the metrics of one iteration."""
        _append(self.metrics, row)

    def take(self) -> bool:
        """Claim the run for this process; return False if another running process has claimed it.

        Raises:
            StoreError: The folder cannot be written.
        """
        ensure_writable(self.path)
        try:
            file = self.claim.open("x")
        except FileExistsError:
            return self._take_over()
        try:
            with writing(self.claim), file:
                file.write(_me())
        except StoreError:
            self.claim.unlink()
            raise
        return True

    def _take_over(self) -> bool:
        """Claim the run if the process that had claimed it has ended."""
        try:
            idle = time.time() - self.claim.stat().st_mtime
        except FileNotFoundError:
            return self.take()
        if idle < STALE and not self._is_dead():
            return False
        # of several that want it, the one whose rename succeeds gets it
        old = self.claim.with_name(f"claim.old.{socket.gethostname()}.{os.getpid()}")
        try:
            self.claim.rename(old)
        except FileNotFoundError:
            return False
        old.unlink()
        return self.take()

    def _is_dead(self) -> bool:
        """Whether the claim belongs to a process of this machine that has ended."""
        host, pid, started, *_ = [*read_text(self.claim, "claim", TrainingError).split(), "", "", ""]
        if host != socket.gethostname() or not pid.isdigit():
            return False
        running = _start_of(pid)
        return not running or (bool(started) and running != started)

    def owner(self) -> str:
        """Return host and process of the claim."""
        return " ".join(read_text(self.claim, "claim", TrainingError).split())

    def touch(self) -> None:
        """Update the time of the claim, so that it is not taken over."""
        self.claim.touch()

    def release(self) -> None:
        """Release the claim."""
        self.claim.unlink(missing_ok=True)


def run_folders(out: Path, file: str) -> list[RunFolder]:
    """List the runs below a folder that have a file, ordered by method; a run's name is METHOD@SEED."""
    order = list(METHODS)
    found = []
    for path in out.glob(f"*@*/{file}"):
        method, _, seed = path.parent.name.partition("@")
        if method in METHODS and seed.isascii() and seed.isdigit():
            found.append((order.index(method), path.parent.name, RunFolder(path.parent)))
    return [folder for _, _, folder in sorted(found, key=lambda one: one[:2])]


def save_resume(trainer: "Trainer", folder: RunFolder, seconds: float) -> None:
    """Write the checkpoint and the resume file.

    Args:
        trainer: Trainer to save.
        folder: Folder of its run.
        seconds: Training time so far [s].
    """
    import torch

    trainer.write_checkpoint(folder.checkpoint, seconds)
    buffer = io.BytesIO()
    torch.save(trainer.save() | {"seconds": seconds}, buffer)
    write_atomic(folder.resume, buffer.getvalue())


def load_resume(trainer: "Trainer", folder: RunFolder) -> float:
    """Load the resume file, if there is one.

    Args:
        trainer: New trainer of the same run.
        folder: Folder of the run.

    Returns:
        The training time so far [s].

    Raises:
        TrainingError: The file cannot be read, or was written by another version of the code.
    """
    import torch

    if not folder.resume.exists():
        return 0.0
    data = io.BytesIO(read_bytes(folder.resume, "resume file", TrainingError))
    with reading("resume file", folder.resume, "a resume file of this version", TrainingError):
        saved = torch.load(data, map_location="cpu", weights_only=True)
        seconds = float(saved["seconds"])
    try:
        trainer.load(saved)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
        text = " ".join(str(error).split())  # a field too few or too many, or of another shape
        raise TrainingError(
            f"resume file '{folder.resume}' is of another version of the code ({text}); valid: the version "
            "that wrote it, or another --out with --init-checkpoint at the run's checkpoint"
        ) from error
    return seconds


def run(
    config: TrainConfig,
    folder: RunFolder,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
    tensorboard: bool = True,
    change: bool = False,
    keep_every: float = 0.0,
) -> None:
    """Train up to the budget, from the folder's resume file if there is one, and write the final checkpoint.

    Args:
        config: Configuration of the run.
        folder: Folder of the run.
        progress: Is called with completed and total control steps and a line of text.
        tensorboard: Whether to write the metrics for TensorBoard as well.
        change: Whether a run that was started with other settings is continued with these, in new episodes.
        keep_every: Control steps between two checkpoints that are kept; 0 for none.

    Raises:
        TrainingError: See `RunFolder.open`, `load_resume` and `Trainer.iterate`; or another process is
            training the run.
    """
    from wbc_baselines.learned.training.make import make_environment
    from wbc_baselines.learned.training.trainer import Trainer, duration

    config.check()
    if not folder.take():
        raise TrainingError(f"run '{folder.path}' is being trained by {folder.owner()}")
    try:
        folder.open(config, change)
        trainer = Trainer(config, make_environment(config))
        before = load_resume(trainer, folder)
        if not trainer.done:
            folder.finished.unlink(missing_ok=True)  # at a smaller budget
        started, first = time.monotonic() - before, trainer.samples
        saved = time.monotonic()
        writer = _writer(folder, trainer.iteration) if tensorboard else None
        per_iteration = config.num_envs * config.num_steps_per_env
        with _stop_requests() as stop:
            while not trainer.done:
                metrics = trainer.iterate()
                seconds = time.monotonic() - started
                rate = per_iteration / duration(metrics)
                row = {"iteration": trainer.iteration, "samples": trainer.samples, "seconds": seconds}
                folder.append(row | {k: None if v != v else float(v) for k, v in metrics.items()})
                if writer:
                    for name, value in metrics.items():
                        writer.add_scalar(name, value, trainer.samples)
                if keep_every and trainer.samples % keep_every < per_iteration:
                    trainer.write_checkpoint(folder.kept(trainer.samples), seconds)
                progress(trainer.samples - first, int(config.budget) - first, line(trainer, metrics, rate))
                if stop or trainer.done or time.monotonic() - saved > CHECKPOINT_PERIOD:
                    save_resume(trainer, folder, seconds)
                    saved = time.monotonic()
                    folder.touch()
                if stop:
                    raise KeyboardInterrupt
        note = {"samples": trainer.samples, "seconds": time.monotonic() - started}
        write_atomic(folder.finished, json.dumps(note).encode())
        if writer:
            writer.close()
    finally:
        folder.release()


@contextmanager
def _stop_requests() -> Iterator[list[int]]:
    """A list that fills when a signal asks the process to stop; a second signal interrupts it at once."""
    asked: list[int] = []

    def note(number: int, _: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def line(trainer: "Trainer", metrics: dict[str, float], rate: float) -> str:
    """Describe the state of training in one line of text."""
    share = {name: metrics[f"episode/{name}"] for name in ("success", "falls")}
    return (
        f"{trainer.config.name}, iteration {trainer.iteration}, {rate:.0f} control steps/s, "
        f"return {metrics['episode/return']:.1f}, success {share['success']:.1%}, falls {share['falls']:.1%}"
    )


def _writer(folder: RunFolder, iteration: int):
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder.path / "tensorboard"), purge_step=iteration or None)


def _append(path: Path, row: dict) -> None:
    with writing(path), path.open("a+b") as file:
        if file.tell() and not _ends_with_newline(file):
            file.write(b"\n")  # the line before was cut short
        file.write(json.dumps(row).encode() + b"\n")


def _ends_with_newline(file) -> bool:
    file.seek(-1, os.SEEK_END)
    return file.read(1) == b"\n"


def _me() -> str:
    return f"{socket.gethostname()} {os.getpid()} {_start_of(os.getpid())}"


def _start_of(pid: int | str) -> str:
    """When a process of this machine began, in ticks since boot; "" if there is none.

    A container that is started again gives its processes the same numbers. Source: proc(5), field 22 of stat.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""
