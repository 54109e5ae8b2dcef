"""Figures of a store as PNG and SVG; the same store gives the same bytes.

A plot takes axes and returns them; the `write_*` functions lay axes out and save. Centimetres and
degrees appear on axes only.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MultipleLocator

from wbc_bench import stats
from wbc_bench.analysis import (
    ANGLE_TOLERANCE,
    REACH_TOLERANCE,
    Evaluated,
    StoreLike,
    by_height,
    collect,
    column,
    paper_values,
    reach_range,
    stood,
    strata_of,
    subset,
    variants,
)
from wbc_bench.files import folder_name
from wbc_bench.formatting import CM, DEG
from wbc_bench.outcomes import Outcome
from wbc_bench.tables import Study, methods_of
from wbc_bench.tracking import STOOD, Track

STYLE = Path(__file__).with_name("wbc.mplstyle")

# Okabe-Ito, named.
BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7"),
    *("#E69F00", "#56B4E9", "#000000"),
)
GREY = "#767676"
SHADE = "#EDEDED"
OUTCOME_COLOURS = {
    Outcome.SUCCESS: GREEN,
    Outcome.DRIFTED: SKY,
    Outcome.MISSED: ORANGE,
    Outcome.QP_INFEASIBLE: PINK,
    Outcome.FELL: VERMILION,
    Outcome.ILLEGAL_CONTACT: BLUE,
    Outcome.INVALID: BLACK,
}
STRATUM_COLOURS = {"arm": BLUE, "posture": ORANGE, "step": GREEN, "beyond": GREY}
CONDITION_COLOURS = {"nominal": BLUE, "randomised": VERMILION}
METHOD_COLOURS = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK)
# noise and pushes make many lines of one: they stay behind the undisturbed
CONDITION_LINES: dict[str, dict[str, Any]] = {
    "nominal": {"lw": 1.4, "zorder": 3},
    "randomised": {"lw": 0.6, "alpha": 0.45, "zorder": 2},
}
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1.2)))  # so that curves that coincide both show


def save(figure: Figure, name: str, out_dir: Path | str) -> list[Path]:
    """Writes <out_dir>/<name>.png and .svg without dates or program versions in them."""
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    png, svg = folder / f"{name}.png", folder / f"{name}.svg"
    figure.savefig(png, metadata={"Software": None})
    figure.set_layout_engine("none")  # laid out by now; both files look the same
    figure.savefig(svg, metadata={"Date": None, "Creator": None})
    return [png, svg]


def styled():
    """The bench's style as a context."""
    # "default" first: a reader's own matplotlibrc must not change the figure.
    return style.context(["default", str(STYLE)])


# --- a study ----------------------------------------------------------------------------------------


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


def error_cdf(ax: Axes, methods: Sequence[tuple[str, Evaluated]], metric: str) -> Axes:
    """Share of all episodes [%] that stood with an error up to x; what is missing to 100 % terminated."""
    scale, unit, tolerance = {
        "position_error": (CM, "cm", REACH_TOLERANCE * CM),
        "orientation_error": (DEG, "deg", ANGLE_TOLERANCE * DEG),
    }[metric]
    ticks, (left, right) = (0.5, 1, 2, 5, 10, 20, 50, 100), (0.3, 200.0)
    for k, (label, method) in enumerate(methods):
        error = column(method.episodes, metric)[method.stood] * scale
        error = np.sort(error[~np.isnan(error)])
        share = 100.0 * np.arange(1, len(error) + 1) / method.completed
        # A thousand points draw the same curve as three thousand, in a third of the bytes.
        kept = np.unique(np.linspace(0, len(error) - 1, min(len(error), 400)).round().astype(int))
        ax.step(
            np.concatenate([[left], error[kept], [right]]) if len(error) else [],
            np.concatenate([[0.0], share[kept], share[-1:]]) if len(error) else [],
            where="post",
            label=label,
            color=METHOD_COLOURS[k % len(METHOD_COLOURS)],
            linestyle=DASHES[k % len(DASHES)],
            zorder=2.0 + 0.1 * (k % len(DASHES)),  # dashes above solid lines
        )
    ax.axvline(tolerance, color=GREY, lw=0.9, ls="--")
    ax.text(tolerance * 0.94, 101, f"{tolerance:.0f} {unit}", ha="right", va="top", color=GREY, fontsize=8)
    ax.set_xscale("log")
    ax.set(xlim=(left, right), ylim=(0, 102), ylabel="All episodes (%)")
    ax.set_xlabel(f"{metric.split('_')[0].capitalize()} error, mean of the final 1 s ({unit})")
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


def write_study(store: StoreLike, study: Study, out_dir: Path | str) -> list[Path]:
    """Success by stratum, outcomes and error distributions of a study, straight into `out_dir`."""
    methods = methods_of(study, collect(store, study.protocol))
    if not methods:
        return []
    paths = []
    with styled():
        figure = Figure(figsize=(6.4, 1.2 + 0.85 * len(methods)))
        ax = success_by_stratum(figure.subplots(), methods)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        paths += save(figure, f"{study.protocol}_success", out_dir)

        figure = Figure(figsize=(7.2, 1.3 + 0.5 * len(methods)))
        ax = outcome_bars(figure.subplots(), methods)
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        paths += save(figure, f"{study.protocol}_outcomes", out_dir)

        figure = Figure(figsize=(7.6, 3.5))
        left, right = figure.subplots(1, 2, sharey=True)
        error_cdf(left, methods, "position_error").set_title("Position")
        error_cdf(right, methods, "orientation_error").set(title="Orientation", ylabel="")
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        paths += save(figure, f"{study.protocol}_errors", out_dir)
    return paths


# --- reach ------------------------------------------------------------------------------------------


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
    """Median of a metric times `scale` at each height [cm], of episodes that stood, and a band to a quantile.

    The band covers what nine in ten of the episodes on the bad side of the median stay within.
    """
    rows = []
    for height, group in by_height(episodes):
        values = column(group, metric)[stood(group)] * scale
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


def _paper_ranges() -> list[tuple[str, float, float, str]]:
    block = paper_values()["reach"]
    return [(f"{k} (paper)", float(v[0]), float(v[1]), GREY) for k, v in block.items() if k != "source"]


def _shade_beyond(ax: Axes, episodes: pd.DataFrame) -> None:
    """Marks heights at which no feasible pose exists; adjacent ones as one band."""
    groups = by_height(episodes)
    if len(groups) < 2:
        return
    step = min(np.diff([height for height, _ in groups])) * CM
    for height, group in groups:
        if strata_of(group) == ["beyond"]:
            ax.axvspan(height * CM - step / 2, height * CM + step / 2, color=SHADE, lw=0, zorder=0)


def reach_figure(protocol: str, method: Evaluated) -> Figure:
    """A column a gripper orientation: range, success, error, sway over height; a colour a condition."""
    parts = variants(method.episodes)
    orientations = sorted({orientation for _, orientation, _ in parts})
    figure = Figure(figsize=(1.6 + 3.6 * len(orientations), 9.2))
    axes = figure.subplots(
        5, len(orientations), sharex=True, sharey="row", squeeze=False, height_ratios=(0.75, 1, 1, 1, 1)
    )
    for ax_column, orientation in zip(axes.T, orientations, strict=True):
        ranges, success, error, speed, smoothness = ax_column
        bars = _paper_ranges()
        for condition, episodes in ((c, e) for c, o, e in parts if o == orientation):
            colour = CONDITION_COLOURS.get(condition, GREEN)
            span = reach_range(episodes)
            bars.append((condition, span.low * CM, span.high * CM, colour))
            reach_success(success, episodes, condition, colour)
            reach_metric(error, episodes, "position_error", condition, colour, 0.95, CM)
            reach_metric(speed, episodes, "ee_speed_rms", condition, colour, 0.95, CM)
            reach_metric(smoothness, episodes, "ee_sparc", condition, colour, 0.05, 1.0)
            for ax in ax_column[1:]:
                _shade_beyond(ax, episodes)
        reach_bars(ranges, bars).set_title(f"Gripper {orientation}: range reached (cm)")
        error.axhline(REACH_TOLERANCE * CM, color=GREY, lw=0.9, ls="--")
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
        f"{method.spec}: vertical reach ({method.counts} episodes)", x=0.01, ha="left", weight="bold"
    )
    return figure


def write_reach(store: StoreLike, protocol: str, out_dir: Path | str) -> list[Path]:
    """One figure a controller, straight into `out_dir`."""
    paths = []
    with styled():
        for spec, method in collect(store, protocol).items():
            paths += save(reach_figure(protocol, method), f"{protocol}_{folder_name(spec)}", out_dir)
    return paths


# --- targets ------------------------------------------------------------------------------------------


def target_scatter(ax: Axes, frame: pd.DataFrame, stratum: str, view: str) -> Axes:
    """Targets of one stratum: `side` is forward against height, `top` forward against left [m]."""
    chosen = subset(frame, np.asarray(frame["stratum"] == stratum, dtype=bool))
    other = column(chosen, "height" if view == "side" else "target_y")
    # As an image inside the SVG: thousands of circles are megabytes of text.
    ax.scatter(
        column(chosen, "target_x"),
        other,
        s=5,
        lw=0,
        alpha=0.5,
        color=STRATUM_COLOURS[stratum],
        rasterized=True,
    )
    ax.plot(0, 0, marker="+", color="black", ms=8, mew=1.2)
    ax.set_aspect("equal", adjustable="box")
    return ax


def write_targets(frame: pd.DataFrame, name: str, out_dir: Path | str) -> list[Path]:
    """Side and top view of a manifest's targets, a column a stratum, as <name>_targets.

    Args: frame with target_x, target_y, height [m] and stratum; world frame, base starts over the origin.
    """
    strata = [s for s in strata_of(frame) if s in STRATUM_COLOURS]
    margin = 0.1  # [m]
    x, y, z = (column(frame, name) for name in ("target_x", "target_y", "height"))
    limits = {"x": (min(x.min(), 0.0) - margin, x.max() + margin), "y": (y.min() - margin, y.max() + margin)}
    limits["z"] = (-margin, z.max() + margin)
    width, depth, height = (limits[axis][1] - limits[axis][0] for axis in "xyz")
    scale = min(7.5 / (len(strata) * width), 5.5 / (depth + height))  # [inch/m]
    with styled():
        size = (1.2 + len(strata) * (width * scale + 0.2), 1.5 + (depth + height) * scale)
        figure = Figure(figsize=size)
        axes = figure.subplots(
            2, len(strata), sharex=True, sharey="row", squeeze=False, height_ratios=(height, depth)
        )
        for (side, top), stratum in zip(axes.T, strata, strict=True):
            count = int(np.count_nonzero(frame["stratum"] == stratum))
            target_scatter(side, frame, stratum, "side").set_title(f"{stratum} ({count})")
            target_scatter(top, frame, stratum, "top").set_xlabel("Forward x (m)")
            side.axhline(0.0, color="black", lw=0.9)
            side.set(xlim=limits["x"], ylim=limits["z"])
            top.set_ylim(limits["y"])
            for axis in (side.yaxis, top.yaxis, top.xaxis):
                axis.set_major_locator(MultipleLocator(0.5))
        axes[0, 0].set_ylabel("Height (m)")
        axes[1, 0].set_ylabel("Left y (m)")
        figure.suptitle(f"{name}: targets (+ start of the base)", x=0.01, ha="left", weight="bold")
        return save(figure, f"{name}_targets", out_dir)


# --- moving targets -------------------------------------------------------------------------------------


def tracking_error(ax: Axes, tracks: Sequence[Track], name: str, colours: dict[str, str]) -> Axes:
    """Error over time of every run of one source, `name` as in `Tracked`; a cross at the top where one fell.

    The axis is that of the runs that stood: the error of a robot on its way to the ground says nothing.
    """
    scale, least = (CM, 6.0) if name == "position_error" else (DEG, 6.0)
    stood = [track for track in tracks if track.tracked.outcome == STOOD]
    top = max(np.max(getattr(track.tracked, name), initial=0.0) * scale for track in stood or tracks)
    top = max(top, least)
    for record, tracked in tracks:
        colour = colours[record.controller]
        ax.plot(
            tracked.time, getattr(tracked, name) * scale, color=colour, **CONDITION_LINES[record.condition]
        )
        if tracked.outcome != STOOD and len(tracked.time):
            ax.plot(tracked.time[-1], top, "x", color=colour, ms=7, mew=1.6, clip_on=False)
    ax.set_ylim(0, 1.08 * top)
    return ax


def write_tracking(tracks: Sequence[Track], out_dir: Path | str) -> list[Path]:
    """Error over time as `tracking`: a row a source, position left, orientation right."""
    sources = list(dict.fromkeys(track.record.source for track in tracks))
    controllers = sorted({track.record.controller for track in tracks})
    colours = dict(zip(controllers, METHOD_COLOURS * len(controllers), strict=False))
    conditions = sorted({track.record.condition for track in tracks})
    with styled():
        figure = Figure(figsize=(8.0, 0.9 + 1.45 * len(sources)))
        axes = figure.subplots(len(sources), 2, squeeze=False)
        for row, source in zip(axes, sources, strict=True):
            own = [track for track in tracks if track.record.source == source]
            tracking_error(row[0], own, "position_error", colours).set(title=source, ylabel="Position (cm)")
            tracking_error(row[1], own, "orientation_error", colours).set(ylabel="Orientation (deg)")
            for ax in row:
                ax.set_xlim(0, max(track.record.requested_s for track in own))
        for ax in axes[-1]:
            ax.set_xlabel("Time (s)")
        figure.align_ylabels()
        handles = [Line2D([], [], color=colours[name], label=name) for name in controllers]
        if len(conditions) > 1:
            handles += [
                Line2D([], [], color=GREY, label=name, **CONDITION_LINES[name]) for name in conditions
            ]
        if any(track.record.outcome != STOOD for track in tracks):
            handles.append(Line2D([], [], color=GREY, ls="none", marker="x", ms=7, mew=1.6, label="fell"))
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        figure.suptitle("Error of the hand while its target moves", x=0.01, ha="left", weight="bold")
        return save(figure, "tracking", out_dir)
