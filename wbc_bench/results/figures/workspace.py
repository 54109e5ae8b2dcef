"""Where in the workspace episodes succeed: rates over bins of target positions, from the side and above."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from wbc_bench.errors import UnknownNameError
from wbc_bench.results.analysis import Evaluated, FloatArray, column
from wbc_bench.results.figures.style import save, styled
from wbc_bench.results.study import Study, methods_of

BINS = (0.1, 0.15, 0.2, 0.3, 0.4)  # [m] edges of a bin to choose from
ENOUGH = 0.8  # of the episodes lie in bins of FEW or more: then a bin is not too small
FEW = 10  # episodes; a rate over fewer says little (Wilson: 5 of 10 is 24..76 %), its bin is drawn faint
FAINT = 0.35
MARGIN = 0.1  # [m] below the ground
GREYS = LinearSegmentedColormap.from_list("counts", ["#E2E2E2", "#101010"])  # one episode is not white
VIEWS = (("height", "Height (m)"), ("target_y", "Left y (m)"))  # against target_x: from the side, from above


class Grid(NamedTuple):
    """Episodes and successes in square bins; the first axis is x, the second that of the view."""

    edges: tuple[FloatArray, FloatArray]  # [m]
    episodes: FloatArray  # (X, Y)
    successes: FloatArray  # (X, Y)

    @property
    def rate(self) -> FloatArray:
        """Share of successes, (X, Y); NaN where there is no episode."""
        undefined = np.full_like(self.episodes, np.nan)
        return np.divide(self.successes, self.episodes, out=undefined, where=self.episodes > 0)


def bin_edges(values: FloatArray, size: float) -> FloatArray:
    """Multiples of a bin's size around values, all [m]: bins of different records lie on one raster."""
    low, high = np.floor(values.min() / size), np.floor(values.max() / size) + 1
    return size * np.arange(low, high + 1)


def bin_size(method: Evaluated) -> float:
    """The finest of BINS [m] that leaves ENOUGH of the episodes in bins of FEW or more, else the coarsest."""
    x = column(method.episodes, "target_x")
    for size in BINS:
        shares = []
        for name, _ in VIEWS:
            y = column(method.episodes, name)
            count, *_ = np.histogram2d(x, y, [bin_edges(x, size), bin_edges(y, size)])
            shares.append(count[count >= FEW].sum() / len(x))
        if min(shares) >= ENOUGH:
            return size
    return BINS[-1]


def success_grid(method: Evaluated, other: str, edges: tuple[FloatArray, FloatArray]) -> Grid:
    """The episodes of a method over target_x and another column."""
    x, y = column(method.episodes, "target_x"), column(method.episodes, other)
    count, *_ = np.histogram2d(x, y, edges)
    successes, *_ = np.histogram2d(x, y, edges, weights=column(method.episodes, "success"))
    return Grid(edges, count, successes)


def draw_rates(ax: Axes, grid: Grid) -> Axes:
    """Success rates [%] as colours; faint where fewer than FEW episodes are behind one, blank without any."""
    opacity = np.where(grid.episodes < FEW, FAINT, 1.0).T
    return _mesh(ax, grid, 100.0 * grid.rate, "viridis", 100.0, opacity)


def draw_counts(ax: Axes, grid: Grid, most: float) -> Axes:
    """Episodes a bin as greys, `most` being the darkest."""
    return _mesh(ax, grid, np.where(grid.episodes > 0, grid.episodes, np.nan), GREYS, most, None)


def _mesh(
    ax: Axes, grid: Grid, values: FloatArray, cmap: str | Colormap, most: float, opacity: FloatArray | None
) -> Axes:
    # As an image inside the SVG: a path a cell is ten times the bytes.
    style: dict[str, Any] = {"edgecolors": "white", "lw": 0.3, "rasterized": True, "alpha": opacity}
    ax.pcolormesh(*grid.edges, values.T, cmap=cmap, norm=Normalize(0.0, most), **style)
    for colour, width in (("white", 3.0), ("black", 1.2)):  # seen on light and on dark bins
        ax.plot(0, 0, marker="+", color=colour, ms=8 + width, mew=width)
    ax.set_aspect("equal", adjustable="box")
    ax.grid(False)
    return ax


def best(methods: Sequence[tuple[str, Evaluated]], count: int = 2) -> list[tuple[str, Evaluated]]:
    """The methods of the highest success rate, best first; of equals the one listed first."""
    return sorted(methods, key=lambda method: -column(method[1].episodes, "success").mean())[:count]


def chosen(methods: Sequence[tuple[str, Evaluated]], specs: Sequence[str]) -> list[tuple[str, Evaluated]]:
    """The methods named, in that order. Raises: UnknownNameError, one is not evaluated."""
    known = {method.spec: (label, method) for label, method in methods}
    for spec in specs:
        if spec not in known:
            raise UnknownNameError("evaluated controller", spec, known, "--workspace")
    return [known[spec] for spec in specs]


def write_workspace(
    study: Study, evaluated: Mapping[str, Evaluated], out_dir: Path | str, specs: Sequence[str] = ()
) -> list[Path]:
    """Targets, and beside them success of some controllers (default: the best two), as `<study>_workspace`.

    Raises: UnknownNameError, a controller named has no run.
    """
    known = methods_of(study, evaluated)
    methods = chosen(known, specs) if specs else best(known)
    if not methods:
        return []
    size = bin_size(methods[0][1])
    x, *others = (
        bin_edges(np.concatenate([column(method.episodes, name) for _, method in methods]), size)
        for name in ("target_x", *(name for name, _ in VIEWS))
    )
    heights = [edges[-1] - min(edges[0], -MARGIN) for edges in others]
    columns, width = 1 + len(methods), x[-1] - x[0]
    scale = min(7.2 / (columns * width), 5.6 / sum(heights))  # [inch/m]
    with styled():
        figure = Figure(figsize=(1.5 + columns * (width * scale + 0.25), 1.9 + sum(heights) * scale))
        axes = figure.subplots(2, columns, sharex=True, sharey="row", squeeze=False, height_ratios=heights)
        rows = [
            [success_grid(method, name, (x, edges)) for _, method in methods]
            for (name, _), edges in zip(VIEWS, others, strict=True)
        ]
        most = max(row[0].episodes.max() for row in rows)
        for row, grids, (_, label) in zip(axes, rows, VIEWS, strict=True):
            draw_counts(row[0], grids[0], most).set_ylabel(label)
            for ax, grid in zip(row[1:], grids, strict=True):
                draw_rates(ax, grid)
            row[0].yaxis.set_major_locator(MultipleLocator(0.5))
        for ax in axes[0]:
            ax.axhline(0.0, color="black", lw=0.9)
            ax.set_ylim(bottom=-MARGIN)
        for ax in axes[1]:
            ax.set_xlabel("Forward x (m)")
            ax.xaxis.set_major_locator(MultipleLocator(0.5))
        axes[0, 0].set_title(f"Targets ({methods[0][1].completed})")
        for ax, (name, method) in zip(axes[0, 1:], methods, strict=True):
            ax.set_title(f"{name}: {100.0 * column(method.episodes, 'success').mean():.1f} %")
        bar: dict[str, Any] = {"orientation": "horizontal", "shrink": 0.9, "pad": 0.02}
        figure.colorbar(axes[1, 0].collections[0], ax=axes[:, 0], label="Episodes in a bin", aspect=30, **bar)
        rates = f"Success (%), faint: fewer than {FEW} episodes"
        colours = ScalarMappable(Normalize(0.0, 100.0), "viridis")  # without the opacities of a mesh
        figure.colorbar(colours, ax=axes[:, 1:], label=rates, aspect=60, **bar)
        figure.suptitle(
            f"{study.name}: success over the workspace (+ start of the base)",
            x=0.01,
            ha="left",
            weight="bold",
        )
        return save(figure, f"{study.name}_workspace", out_dir)
