"""Success of controllers as one disturbance at a time grows, a panel per factor."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from wbc_bench.results import stats
from wbc_bench.results.figures.style import BLACK, DASHES, GREY, SHADE, controller_colours, save, styled
from wbc_bench.results.margins import Curve, Robustness
from wbc_bench.results.stress import FactorRecord, Stress

COLUMNS = 4
BASE_AT = -0.16  # where the base stands beside the first level, in parts of the ladder
# between controllers at one level, so that intervals do not hide each other, and between the outermost two;
# in parts of the ladder
BETWEEN, WIDEST = 0.012, 0.06


def stress_panel(
    ax: Axes,
    factor: FactorRecord,
    curves: Mapping[str, tuple[stats.Estimate, Curve]],
    colours: Mapping[str, str],
    lines: Mapping[str, Any],
) -> Axes:
    """Success [%] of controllers over the severities of one factor, with Wilson intervals.

    Args:
        ax: Axes to draw on.
        factor: The factor.
        curves: Spec -> success at the base and curve, of the controllers that have one.
        colours: Spec -> colour.
        lines: Spec -> style of line.
    """
    severities = factor.severities
    span = severities[-1] - severities[0]  # negative where severities fall
    ax.axvspan(severities[0] + 1.5 * BASE_AT * span, severities[0] + 0.5 * BASE_AT * span, color=SHADE, lw=0)
    between = min(BETWEEN, WIDEST / max(1, len(curves) - 1)) * span
    for k, (spec, (base, curve)) in enumerate(curves.items()):
        colour, shift = colours[spec], (k - (len(curves) - 1) / 2) * between
        rates = [stats.wilson(int(count), base.num_episodes) for count in curve.successes]
        ax.plot(severities, 100.0 * curve.fit, color=colour, ls=lines[spec], lw=1.4, zorder=2)
        _points(ax, severities + shift, rates, colour, "o")
        _points(ax, np.array([severities[0] + BASE_AT * span + 2 * shift]), [base], colour, "D")
        if np.isfinite(curve.breaking.point):
            height = 100.0 * _at(curve.fit, severities, curve.breaking.point)
            ax.plot(curve.breaking.point, height, "X", ms=7, color=colour, mec="white", mew=0.8, zorder=4)
    ax.set_xlim(severities[0] + 1.5 * BASE_AT * span, severities[-1] + 0.06 * span)
    ax.set_ylim(-3, 103)
    ax.set_yticks(range(0, 101, 25))
    shown = severities[len(severities) % 2 == 0 :: 2] if len(severities) > 4 else severities
    ax.set_xticks(
        [severities[0] + BASE_AT * span, *shown], ["base", *(f"{severity:g}" for severity in shown)]
    )
    ax.set_title(factor.label)
    ax.set_xlabel(factor.unit)
    return ax


def _points(ax: Axes, x: np.ndarray, rates: list[stats.Estimate], colour: str, marker: str) -> None:
    point, low, high = 100.0 * np.array([rate[:3] for rate in rates]).T
    ax.errorbar(
        x, point, yerr=np.maximum([point - low, high - point], 0.0), fmt=marker, ms=3.2, color=colour, lw=0,
        elinewidth=0.8, capsize=0, zorder=3,
    )  # fmt: skip


def _at(fit: np.ndarray, severities: np.ndarray, severity: float) -> float:
    """The fit at a severity between levels that rise or fall."""
    order = np.argsort(severities)
    return float(np.interp(severity, severities[order], fit[order]))


def stress_figure(stress: Stress, found: Mapping[str, Robustness], colours: Mapping[str, str]) -> Figure:
    """A panel per factor that a controller was evaluated on, at all of its levels."""
    lines = {climb.spec: DASHES[k % len(DASHES)] for k, climb in enumerate(stress.climbs)}
    panels = []
    for factor in stress.ladder.factors:
        curves = {
            climb.spec: (found[climb.spec].base, found[climb.spec].curves[factor.name])
            for climb in stress.climbs
            if factor.name in climb.levels
        }
        if curves:
            panels.append((factor, curves))
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(max(4.4, 2.7 * columns + 0.5), 2.15 * rows + 0.9))
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for ax, (factor, curves) in zip(axes.flat, panels, strict=False):
        stress_panel(ax, factor, curves, colours, lines)
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    for ax in axes[:, 0]:
        ax.set_ylabel("Success (%)")
    handles = [
        Line2D([], [], color=colours[climb.spec], ls=lines[climb.spec], marker="o", label=climb.name)
        for climb in stress.climbs
    ]
    handles += [
        Line2D([], [], color=GREY, marker="D", ls="", label="base"),
        Line2D([], [], color=BLACK, marker="X", ms=7, mec="white", ls="", label="breaking point"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(4, columns + 1))
    counts = " or ".join(map(str, sorted({climb.episodes for climb in stress.climbs})))
    figure.suptitle(f"{stress.ladder.name} ({counts} episodes per level)", x=0.01, ha="left", weight="bold")
    return figure


def write_stress_figure(
    stress: Stress,
    found: Mapping[str, Robustness],
    out_dir: Path | str,
    colours: Mapping[str, str] | None = None,
) -> list[Path]:
    """The figure of a ladder, straight into `out_dir`; nothing where no factor is whole."""
    if not any(climb.levels for climb in stress.climbs):
        return []
    colours = colours or controller_colours({climb.spec: climb.name for climb in stress.climbs})
    with styled():
        figure = stress_figure(stress, found, colours)
        return save(figure, f"{stress.ladder.name}_ladders", out_dir)
