"""Training of several methods and seeds by one recipe, on any number of machines that share a folder."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from wbc_baselines.learned.training.config import TrainConfig, TrainingError
from wbc_baselines.learned.training.recipe import Recipe
from wbc_baselines.learned.training.run_folder import RunFolder, run, run_folders

ORACLE = "oracle"
Progress = Callable[[int, int, str], None]


class Standing(NamedTuple):
    """The progress of one run."""

    name: str
    state: str  # done, running, interrupted, not started
    samples: int  # control steps
    seconds: float  # of training
    success: float | None  # of the episodes that ended in the last iteration
    falls: float | None


def runs_of(recipe: Recipe, methods: Sequence[str], seeds: int, out: Path) -> list[TrainConfig]:
    """List the configurations of all methods and seeds, ordered by seed, each seed's oracle first.

    A campaign that is cut short has then trained all methods with the same seeds. Every seed has an oracle of
    its own, from which its other methods are distilled, so that seeds are independent as far as the oracles
    are: those of a recipe with an ancestor begin with the same weights.

    Args:
        recipe: Settings of the runs.
        methods: Methods to train; the oracle is added where others are distilled from it.
        seeds: Number of seeds per method.
        out: Folder of all runs, where methods find their oracle.

    Returns:
        One configuration per run.

    Raises:
        UnknownNameError: There is no such method.
        TrainingError: A setting is out of its range.
    """
    wanted = dict.fromkeys(methods)
    if recipe.distilled is not None:
        wanted = {ORACLE: None} | wanted
    runs = []
    for seed in range(seeds):
        oracle = str(RunFolder(out / f"{ORACLE}@{seed}").checkpoint)
        for method in wanted:
            if method == ORACLE or recipe.distilled is None:
                settings = recipe.from_scratch | {
                    "init_checkpoint": recipe.ancestor if method == ORACLE else "",
                    "teacher": "",
                }
            else:
                settings = recipe.distilled | {"init_checkpoint": oracle, "teacher": oracle}
            runs.append(_config(recipe, settings | {"method": method, "seed": seed}))
    for config in runs:
        config.check()
    return runs


def _config(recipe: Recipe, settings: dict[str, Any]) -> TrainConfig:
    try:
        return msgspec.convert(recipe.common | settings, TrainConfig)
    except msgspec.ValidationError as error:
        raise TrainingError(f"recipe '{recipe.name}': {error}") from error


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
        if is_done(folder, one) or _waits(one) or not folder.take():
            continue
        folder.release()  # `run` takes it again
        run(one, folder, progress)
        yield one


def _waits(config: TrainConfig) -> bool:
    """Whether the oracle of a run is not finished yet, because another process is training it."""
    checkpoint = Path(config.teacher)
    return bool(config.teacher) and not RunFolder(checkpoint.parent).finished.exists()


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
