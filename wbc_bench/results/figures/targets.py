"""The targets of a protocol, from the side and from above."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from wbc_bench.results.analysis import (
    column,
    strata_of,
    subset,
)
from wbc_bench.results.figures.style import STRATUM_COLOURS, save, styled


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
    """Side and top view of a manifest's targets, a column per stratum, as `<name>_targets`.

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
