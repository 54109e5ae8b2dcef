"""The error of the hand over time while its target moves."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from wbc_bench.results.figures.style import CONDITION_LINES, GREY, controller_colours, save, styled
from wbc_bench.results.formatting import CM, DEG
from wbc_bench.results.tracking import STOOD, Track


def tracking_error(ax: Axes, tracks: Sequence[Track], name: str, colours: Mapping[str, str]) -> Axes:
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


def write_tracking(
    tracks: Sequence[Track],
    out_dir: Path | str,
    labels: Mapping[str, str] | None = None,
    colours: Mapping[str, str] | None = None,
) -> list[Path]:
    """Error over time as `tracking`: a row per source, position left, orientation right.

    `labels` and `colours` map a spec to its name and its colour in all figures of a report.
    """
    sources = list(dict.fromkeys(track.record.source for track in tracks))
    controllers = sorted({track.record.controller for track in tracks})
    names = {spec: (labels or {}).get(spec, spec) for spec in controllers}
    colours = colours or controller_colours(names)
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
        handles = [Line2D([], [], color=colours[spec], label=name) for spec, name in names.items()]
        if len(conditions) > 1:
            handles += [
                Line2D([], [], color=GREY, label=name, **CONDITION_LINES[name]) for name in conditions
            ]
        if any(track.record.outcome != STOOD for track in tracks):
            handles.append(Line2D([], [], color=GREY, ls="none", marker="x", ms=7, mew=1.6, label="fell"))
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
        figure.suptitle("Error of the hand while its target moves", x=0.01, ha="left", weight="bold")
        return save(figure, "tracking", out_dir)
