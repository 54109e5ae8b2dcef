"""Success by stratum, outcomes and distributions of errors of a study.

A plot takes axes and returns them; the `write_*` functions lay axes out and save. Centimetres and
degrees appear on axes only.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from wbc_bench.outcomes import Outcome
from wbc_bench.results import stats
from wbc_bench.results.analysis import (
    Evaluated,
    column,
    rule_of,
    strata_of,
    subset,
)
from wbc_bench.results.figures.style import (
    DASHES,
    GREY,
    OUTCOME_COLOURS,
    STRATUM_COLOURS,
    controller_colours,
    save,
    styled,
)
from wbc_bench.results.formatting import CM, DEG, window_text
from wbc_bench.results.study import Study, methods_of


def success_by_stratum(ax: Axes, methods: Sequence[tuple[str, Evaluated]]) -> Axes:
    """Success [%] of each method by stratum, with Wilson intervals."""
    strata = sorted({s for _, m in methods for s in strata_of(m.episodes)}, key=list(STRATUM_COLOURS).index)
    height = 0.8 / len(strata)
    for k, stratum in enumerate(strata):
        for row, (_, method) in enumerate(methods):
            chosen = subset(method.episodes, np.asarray(method.episodes["stratum"] == stratum, dtype=bool))
            if len(chosen) == 0:
                continue
            rate = stats.wilson(int(column(chosen, "success").sum()), len(chosen))
            y = row + (k - (len(strata) - 1) / 2) * height
            point = rate.point * 100.0
            ax.barh(
                y, point, 0.92 * height, color=STRATUM_COLOURS[stratum], label=stratum if row == 0 else None
            )
            low, high = point - rate.low * 100.0, rate.high * 100.0 - point
            ax.errorbar(point, y, xerr=[[max(low, 0.0)], [max(high, 0.0)]], color="black", lw=0.8, capsize=2)
            ax.text(rate.high * 100.0 + 1.5, y, f"{point:.1f}", va="center", fontsize=7)
    ax.set(xlim=(0, 109), xlabel="Success (%), 95 % Wilson interval", title="Success by stratum")
    ax.set_xticks(range(0, 101, 20))
    return _method_axis(ax, methods)


def outcome_bars(ax: Axes, methods: Sequence[tuple[str, Evaluated]]) -> Axes:
    """How the episodes of each method ended [%]; every bar adds up to the completed episodes."""
    for row, (_, method) in enumerate(methods):
        outcome = np.asarray(method.episodes["outcome"], dtype=str)
        left = 0.0
        for name, colour in OUTCOME_COLOURS.items():
            share = 100.0 * float((outcome == str(name)).mean())
            label = str(name).replace("_", " ") if row == 0 else None
            ax.barh(row, share, 0.62, left=left, color=colour, label=label)
            if share >= 6.0:  # narrower than its own number
                ink = "white" if name in (Outcome.SUCCESS, Outcome.FELL, Outcome.ILLEGAL_CONTACT) else "black"
                ax.text(
                    left + share / 2, row, f"{share:.0f}", ha="center", va="center", fontsize=8, color=ink
                )
            left += share
    ax.set(xlim=(0, 100), xlabel="Episodes (%)", title="How the episodes ended")
    return _method_axis(ax, methods)


def error_cdf(
    ax: Axes,
    methods: Sequence[tuple[str, Evaluated]],
    metric: str,
    colours: Mapping[str, str] | None = None,
) -> Axes:
    """Share of all episodes [%] with an error up to x; what is missing to 100 % terminated."""
    colours = colours or controller_colours({method.spec: label for label, method in methods})
    rule = rule_of({method.spec: method for _, method in methods})
    scale, unit, tolerance = {
        "position_error": (CM, "cm", rule.position * CM),
        "orientation_error": (DEG, "deg", rule.orientation * DEG),
    }[metric]
    ticks, (left, right) = (0.5, 1, 2, 5, 10, 20, 50, 100), (0.3, 200.0)
    for k, (label, method) in enumerate(methods):
        error = column(method.episodes, metric)[method.not_terminated] * scale
        error = np.sort(error[~np.isnan(error)])
        share = 100.0 * np.arange(1, len(error) + 1) / method.completed
        # A thousand points draw the same curve as three thousand, in a third of the bytes.
        kept = np.unique(np.linspace(0, len(error) - 1, min(len(error), 400)).round().astype(int))
        ax.step(
            np.concatenate([[left], error[kept], [right]]) if len(error) else [],
            np.concatenate([[0.0], share[kept], share[-1:]]) if len(error) else [],
            where="post",
            label=label,
            color=colours[method.spec],
            linestyle=DASHES[k % len(DASHES)],
            zorder=2.0 + 0.1 * (k % len(DASHES)),  # dashes above solid lines
        )
    ax.axvline(tolerance, color=GREY, lw=0.9, ls="--")
    ax.text(tolerance * 0.94, 101, f"{tolerance:g} {unit}", ha="right", va="top", color=GREY, fontsize=8)
    ax.set_xscale("log")
    ax.set(xlim=(left, right), ylim=(0, 102), ylabel="All episodes (%)")
    ax.set_xlabel(f"{metric.split('_')[0].capitalize()} error, mean of the {window_text(rule)} ({unit})")
    ax.xaxis.set_major_locator(FixedLocator(ticks))
    ax.xaxis.set_minor_locator(FixedLocator([]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    return ax


def _method_axis(ax: Axes, methods: Sequence[tuple[str, Evaluated]]) -> Axes:
    """Methods from top to bottom along y."""
    ax.set_yticks(range(len(methods)), [f"{label}\n({method.counts})" for label, method in methods])
    ax.set_ylim(len(methods) - 0.45, -0.55)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)
    return ax


def write_study_figures(
    study: Study,
    evaluated: Mapping[str, Evaluated],
    out_dir: Path | str,
    colours: Mapping[str, str] | None = None,
) -> list[Path]:
    """Success by stratum, outcomes and error distributions of a study, straight into `out_dir`.

    `colours` maps a spec to its colour in all figures of a report (`controller_colours`).
    """
    methods = methods_of(study, evaluated)
    if not methods:
        return []
    paths = []
    with styled():
        figure = Figure(figsize=(6.4, 1.2 + 0.85 * len(methods)))
        ax = success_by_stratum(figure.subplots(), methods)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        paths += save(figure, f"{study.name}_success", out_dir)

        figure = Figure(figsize=(7.2, 1.3 + 0.5 * len(methods)))
        ax = outcome_bars(figure.subplots(), methods)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        paths += save(figure, f"{study.name}_outcomes", out_dir)

        figure = Figure(figsize=(7.6, 3.5))
        left, right = figure.subplots(1, 2, sharey=True)
        error_cdf(left, methods, "position_error", colours).set_title("Position")
        error_cdf(right, methods, "orientation_error", colours).set(title="Orientation", ylabel="")
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        paths += save(figure, f"{study.name}_errors", out_dir)
    return paths
