"""All methods and seeds at one equal budget, in any order, on any number of machines that share a folder."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.training.config import TrainConfig
from wbc_baselines.learned.training.run_folder import RunFolder, run

Progress = Callable[[int, int, str], None]


class Standing(NamedTuple):
    """Where one run stands."""

    name: str
    state: str  # done, running, interrupted, not started
    samples: int
    seconds: float
    success: float | None  # of the episodes that ended in the last iteration
    falls: float | None


def runs_of(base: TrainConfig, methods: Sequence[str], seeds: int) -> list[TrainConfig]:
    """Every method with every seed; seeds outermost, so that a campaign cut short compares all methods."""
    for method in methods:
        replace(base, method=method).check()
    return [replace(base, method=method, seed=seed) for seed in range(seeds) for method in methods]


def campaign(config: Sequence[TrainConfig], out: Path, progress: Progress) -> Iterator[TrainConfig]:
    """Train whatever of `config` is not done and nobody else trains; yields each run finished here."""
    for one in config:
        folder = RunFolder(out / one.name)
        if is_done(folder, one) or not folder.take():
            continue
        folder.release()  # `run` takes it again
        run(one, folder, progress)
        yield one


def is_done(folder: RunFolder, config: TrainConfig) -> bool:
    """Whether the run has been finished at this budget or more."""
    import json

    return folder.finished.exists() and json.loads(folder.finished.read_text())["samples"] >= config.budget


def standing(out: Path) -> list[Standing]:
    """Where every run below a folder stands."""
    found = []
    for path in sorted(out.glob("*@*/config.json")):
        folder = RunFolder(path.parent)
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
                last.get("seconds", 0.0),
                last.get("episode/success"),
                last.get("episode/falls"),
            )
        )
    order = list(METHODS)
    return sorted(found, key=lambda s: (order.index(s.name.split("@")[0]), s.name))
