"""Learning curves of training runs, as figures in the style of the benchmark."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wbc_baselines.learned.policy.methods import METHODS, Reward
from wbc_baselines.learned.training.config import TrainingError
from wbc_baselines.learned.training.run_folder import run_folders
from wbc_bench.files import made_whole
from wbc_bench.results.figures.style import DASHES, controller_colours, save, styled

Rows = list[dict]
Run = tuple[str, Rows]  # METHOD@SEED and its metrics
SMOOTHING = 0.03  # width of the moving mean, as a fraction of the control steps
PANELS = (  # metric, axis label, factor
    ("episode/success", "Success in training (%)", 100.0),
    ("episode/falls", "Falls in training (%)", 100.0),
    ("episode/pos_error", "Position error at 10 s (cm)", 100.0),
)


def smooth(rows: Rows, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute the moving mean of a metric, weighted by the number of ended episodes.

    Args:
        rows: Metrics of all iterations.
        metric: Name of the metric.

    Returns:
        Control steps (K,) and means (K,) of the iterations that have the metric.
    """
    chosen = [row for row in rows if None not in (row.get(metric), row.get("episode/count"))]
    x = np.array([row["samples"] for row in chosen], dtype=float)
    y = np.array([row[metric] for row in chosen], dtype=float)
    weight = np.array([max(row["episode/count"], 1e-9) for row in chosen], dtype=float)
    if len(x) == 0:
        return x, y
    half = SMOOTHING * x[-1] / 2
    low, high = np.searchsorted(x, x - half), np.searchsorted(x, x + half, side="right")
    sums = np.concatenate([[0.0], np.cumsum(weight * y)])
    weights = np.concatenate([[0.0], np.cumsum(weight)])
    return x, (sums[high] - sums[low]) / (weights[high] - weights[low])


def curve(ax: Axes, runs: Sequence[Run], metric: str, label: str, factor: float) -> Axes:
    """Plot one metric over millions of control steps: a method in its colour of all figures, a dash per seed.

    Args:
        ax: Axes to draw on.
        runs: Name and metrics of each run.
        metric: Name of the metric.
        label: Label of the vertical axis.
        factor: Factor from the metric to the unit of the label.

    Returns:
        The axes.
    """
    colours = controller_colours({name: METHODS[_method(name)].label for name, _ in runs})
    labelled = set()
    for name, rows in runs:
        method, _, seed = name.partition("@")
        x, y = smooth(rows, metric)
        ax.plot(
            x / 1e6,
            factor * y,
            color=colours[name],
            linestyle=DASHES[int(seed or 0) % len(DASHES)],
            label=None if method in labelled else METHODS[method].label,
        )
        labelled.add(method)
    ax.set(xlabel="Control steps (million)", ylabel=label)
    ax.set_ylim(bottom=0, top=102 if label.endswith("(%)") else None)
    return ax


def curves_figure(runs: Sequence[Run]) -> Figure:
    """Plot return, success, falls and error of runs; returns of different rewards have axes of their own.

    The rewards have different scales: the returns of a gated and of an additive one cannot be compared.
    """
    by_reward: dict[Reward, list[Run]] = {}
    for run in runs:
        by_reward.setdefault(METHODS[_method(run[0])].reward, []).append(run)
    figure = Figure(figsize=(3.8 * (1 + len(by_reward)), 5.6))
    axes = list(figure.subplots(2, 1 + len(by_reward)).flat)
    for reward, own in sorted(by_reward.items(), reverse=True):  # gated first
        curve(axes.pop(0), own, "episode/return", f"Return per episode ({reward})", 1.0)
    drawn = [curve(axes.pop(0), runs, *panel) for panel in PANELS]
    for ax in axes:
        ax.set_axis_off()
    figure.legend(*drawn[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _method(run: str) -> str:
    return run.partition("@")[0]


def measured_scores(rows: Rows, part: float = 0.1) -> tuple[float, float, float]:
    """Measure the constants PHASE, SCORE_M and SCORE_L of `rewards` in a run.

    Args:
        rows: Metrics of all iterations.
        part: Last fraction of the iterations that is used.

    Returns:
        PHASE, SCORE_M and SCORE_L.

    Raises:
        TrainingError: There is no row with all gates.
    """
    gates = ("phase", "manipulation", "reference")
    rows = [row for row in rows if None not in [row.get(f"gate/{gate}") for gate in gates]]
    if not rows:
        raise TrainingError("no iteration has the metrics " + ", ".join(f"gate/{gate}" for gate in gates))
    last = rows[-max(1, round(part * len(rows))) :]

    def mean(gate: str) -> float:
        return float(np.mean([row[f"gate/{gate}"] for row in last]))

    phase = mean("phase")
    return phase, mean("manipulation") / (1 - phase), mean("reference") / phase


def write_curves(out: Path, figures: Path, name: str = "learning_curves") -> list[Path]:
    """Plot all runs below a folder.

    Args:
        out: Folder of all runs.
        figures: Folder to write to.
        name: Name of the files.

    Returns:
        The PNG and the SVG file; nothing if there is no run.

    Raises:
        StoreError: They cannot be written.
    """
    runs = [(folder.path.name, folder.read_metrics()) for folder in run_folders(out, "metrics.jsonl")]
    if not runs:
        return []
    with styled(), made_whole(figures) as (made, paths):
        save(curves_figure(runs), name, made)
    return paths
