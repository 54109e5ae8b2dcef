"""Range, success, errors and sway over the height of targets straight ahead."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator

from wbc_bench.files import folder_name
from wbc_bench.results import stats
from wbc_bench.results.analysis import (
    Evaluated,
    by_height,
    column,
    not_terminated,
    reach_range,
    strata_of,
    variants,
)
from wbc_bench.results.figures.style import CONDITION_COLOURS, GREEN, GREY, SHADE, save, styled
from wbc_bench.results.formatting import CM
from wbc_bench.results.study import Study


def reach_success(ax: Axes, episodes: pd.DataFrame, label: str, colour: str) -> Axes:
    """Success [%] at each height [cm], with Wilson intervals."""
    heights, rates = [], []
    for height, group in by_height(episodes):
        heights.append(height * CM)
        rates.append(stats.wilson(int(column(group, "success").sum()), len(group)))
    point, low, high = (
        100.0 * np.array([getattr(r, part) for r in rates]) for part in ("point", "low", "high")
    )
    ax.fill_between(heights, low, high, color=colour, alpha=0.18, lw=0)
    ax.plot(heights, point, "o-", color=colour, label=label)
    ax.set_ylim(-3, 103)
    return ax


def reach_metric(
    ax: Axes, episodes: pd.DataFrame, metric: str, label: str, colour: str, worst: float, scale: float
) -> Axes:
    """Median of a metric times `scale` at each height [cm], of episodes that did not terminate, and a band.

    The band covers what nine in ten of the episodes on the bad side of the median stay within.
    """
    rows = []
    for height, group in by_height(episodes):
        values = column(group, metric)[not_terminated(group)] * scale
        values = values[~np.isnan(values)]
        middle, tail = np.quantile(values, [0.5, worst]) if len(values) else np.full(2, np.nan)
        rows.append((height * CM, middle, tail))
    height, middle, tail = np.array(rows).T
    ax.fill_between(height, middle, tail, color=colour, alpha=0.18, lw=0)
    ax.plot(height, middle, "o-", color=colour, label=label)
    return ax


def reach_bars(ax: Axes, ranges: Sequence[tuple[str, float, float, str]]) -> Axes:
    """Ranges of height [cm] as bars: (label, low, high, colour), the first on top; NaN draws no bar."""
    for row, (_, low, high, colour) in enumerate(ranges):
        if np.isnan(low):
            ax.text(2, row, "none", va="center", fontsize=7, color=colour)
            continue
        ax.barh(row, high - low, 0.62, left=low, color=colour)
        inside = high - low > 30  # room for both numbers within the bar
        ax.text(low + 1.5 if inside else low - 1.5, row, f"{low:.0f}", va="center", fontsize=7,
                ha="left" if inside else "right", color="white" if inside else "black")  # fmt: skip
        ax.text(high - 1.5 if inside else high + 1.5, row, f"{high:.0f}", va="center", fontsize=7,
                ha="right" if inside else "left", color="white" if inside else "black")  # fmt: skip
    ax.set_yticks(range(len(ranges)), [label for label, *_ in ranges])
    ax.set_ylim(len(ranges) - 0.4, -0.6)
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    return ax


def _paper_ranges(study: Study) -> list[tuple[str, float, float, str]]:
    ranges = study.paper.ranges_cm if study.paper else {}
    return [(f"{label} (paper)", low, high, GREY) for label, (low, high) in ranges.items()]


def _shade_beyond(ax: Axes, episodes: pd.DataFrame) -> None:
    """Marks heights at which no feasible pose exists; adjacent ones as one band."""
    groups = by_height(episodes)
    if len(groups) < 2:
        return
    step = min(np.diff([height for height, _ in groups])) * CM
    for height, group in groups:
        if strata_of(group) == ["beyond"]:
            ax.axvspan(height * CM - step / 2, height * CM + step / 2, color=SHADE, lw=0, zorder=0)


def reach_figure(study: Study, method: Evaluated) -> Figure:
    """Range, success, error and sway by height; a column per gripper orientation, a colour per condition."""
    parts = variants(method.episodes)
    orientations = sorted({orientation for _, orientation, _ in parts})
    figure = Figure(figsize=(1.6 + 3.6 * len(orientations), 9.2))
    axes = figure.subplots(
        5, len(orientations), sharex=True, sharey="row", squeeze=False, height_ratios=(0.75, 1, 1, 1, 1)
    )
    for ax_column, orientation in zip(axes.T, orientations, strict=True):
        ranges, success, error, speed, smoothness = ax_column
        bars = _paper_ranges(study)
        for condition, episodes in ((c, e) for c, o, e in parts if o == orientation):
            colour = CONDITION_COLOURS.get(condition, GREEN)
            span = reach_range(episodes, method.rule)
            bars.append((condition, span.low * CM, span.high * CM, colour))
            reach_success(success, episodes, condition, colour)
            reach_metric(error, episodes, "position_error", condition, colour, 0.95, CM)
            reach_metric(speed, episodes, "ee_speed_rms", condition, colour, 0.95, CM)
            reach_metric(smoothness, episodes, "ee_sparc", condition, colour, 0.05, 1.0)
            for ax in ax_column[1:]:
                _shade_beyond(ax, episodes)
        reach_bars(ranges, bars).set_title(f"Gripper {orientation}: range reached (cm)")
        error.axhline(method.rule.position * CM, color=GREY, lw=0.9, ls="--")
        smoothness.set_xlabel("Target height (cm)")
        smoothness.xaxis.set_major_locator(MultipleLocator(25))
        smoothness.set_xlim(-3, 203)
    for row in axes[2:4]:
        # Errors beyond the arm's reach are a metre: linear where it matters, logarithmic above.
        row[0].set_yscale("symlog", linthresh=10.0, linscale=1.5)
        ticks = (0, 2, 5, 10, 20, 50, 100, 200, 500)
        top = max(row[0].dataLim.y1, row[-1].dataLim.y1)
        row[0].set_ylim(0, next((tick for tick in ticks[3:] if tick >= top), ticks[-1]))
        row[0].yaxis.set_major_locator(FixedLocator(ticks))
        row[0].yaxis.set_minor_locator(FixedLocator([]))
        row[0].yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes[1, 0].set_ylabel("Success (%)\n95 % Wilson")
    axes[2, 0].set_ylabel("Position error (cm)\nmedian to P95")
    axes[3, 0].set_ylabel("EE speed RMS (cm/s)\nmedian to P95")
    axes[4, 0].set_ylabel("Smoothness (SPARC)\nmedian to P5")
    figure.align_ylabels(axes[1:, 0])
    handles, labels = axes[1, 0].get_legend_handles_labels()
    if any("beyond" in set(episodes["stratum"]) for _, _, episodes in parts):
        handles, labels = [*handles, Patch(color=SHADE)], [*labels, "no feasible pose at this height"]
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    figure.suptitle(
        f"{method.name}: vertical reach ({method.counts} episodes)", x=0.01, ha="left", weight="bold"
    )
    return figure


def write_reach_figures(study: Study, evaluated: Mapping[str, Evaluated], out_dir: Path | str) -> list[Path]:
    """One figure a controller, straight into `out_dir`."""
    paths = []
    with styled():
        for spec, method in evaluated.items():
            paths += save(reach_figure(study, method), f"{study.name}_{folder_name(spec)}", out_dir)
    return paths
