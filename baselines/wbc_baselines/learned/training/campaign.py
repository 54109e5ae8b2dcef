"""Training of several methods and seeds at an equal budget, on any number of machines that share a folder."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from wbc_baselines.learned.training.config import TrainConfig
from wbc_baselines.learned.training.run_folder import RunFolder, run, run_folders

Progress = Callable[[int, int, str], None]


class Standing(NamedTuple):
    """The progress of one run."""

    name: str
    state: str  # done, running, interrupted, not started
    samples: int  # control steps
    seconds: float  # of training
    success: float | None  # of the episodes that ended in the last iteration
    falls: float | None


def runs_of(base: TrainConfig, methods: Sequence[str], seeds: int) -> list[TrainConfig]:
    """List the configurations of all methods and seeds, ordered by seed.

    A campaign that is cut short has then trained all methods with the same seeds.

    Args:
        base: Settings that all runs share.
        methods: Methods to train.
        seeds: Number of seeds per method.

    Returns:
        One configuration per run.

    Raises:
        UnknownNameError: There is no such method.
        TrainingError: A setting is out of its range.
    """
    for method in methods:
        replace(base, method=method).check()
    return [replace(base, method=method, seed=seed) for seed in range(seeds) for method in methods]


def campaign(configs: Sequence[TrainConfig], out: Path, progress: Progress) -> Iterator[TrainConfig]:
    """Train all runs that are neither finished nor claimed by another process.

    Args:
        configs: Configurations of the runs.
        out: Folder of all runs.
        progress: Is called with completed and total control steps and a line of text.

    Yields:
        The configuration of each run that was finished here.
    """
    for one in configs:
        folder = RunFolder(out / one.name)
        if is_done(folder, one) or not folder.take():
            continue
        folder.release()  # `run` takes it again
        run(one, folder, progress)
        yield one


def is_done(folder: RunFolder, config: TrainConfig) -> bool:
    """Return whether the run has been finished with this budget or a larger one."""
    samples = folder.samples_when_finished()
    return samples is not None and samples >= config.budget


def standing(out: Path) -> list[Standing]:
    """List the progress of all runs below a folder, ordered by method."""
    found = []
    for folder in run_folders(out, "config.json"):
        rows = folder.read_metrics()
        last = rows[-1] if rows else {}
        if folder.finished.exists():
            state = "done"
        elif folder.claim.exists():
            state = "running"
        else:
            state = "interrupted" if rows else "not started"
        found.append(
            Standing(
                folder.path.name,
                state,
                last.get("samples", 0),
                last.get("seconds") or 0.0,
                last.get("episode/success"),
                last.get("episode/falls"),
            )
        )
    return found
