"""Colours and line styles of all figures, and how a figure is saved: equal figures give equal bytes."""

from collections.abc import Iterable, Mapping
from itertools import chain, count, islice
from pathlib import Path
from typing import Any

from matplotlib import rcParams, style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import hsv_to_rgb, to_hex
from matplotlib.figure import Figure

from wbc_bench.outcomes import Outcome
from wbc_bench.results.study import ColourName, Row, released_rows

STYLE = Path(__file__).with_name("wbc.mplstyle")
# Okabe-Ito, named.
BLUE, VERMILION, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
GREY = "#767676"
COLOURS: dict[ColourName, str] = {
    **{"blue": BLUE, "vermilion": VERMILION, "green": GREEN, "pink": PINK},
    **{"orange": ORANGE, "sky": SKY, "black": BLACK, "grey": GREY},
}
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
METHOD_COLOURS: tuple[str, ...] = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK)
GOLDEN = 0.618033988749895  # of a turn of hue: colours beyond the palette are far from their neighbours
# noise and pushes make many lines of one: they stay behind the undisturbed
CONDITION_LINES: dict[str, dict[str, Any]] = {
    "nominal": {"lw": 1.4, "zorder": 3},
    "randomised": {"lw": 0.6, "alpha": 0.45, "zorder": 2},
}
DASHES = ("-", (0, (4, 1.5)), (0, (1, 1.2)))  # so that curves that coincide both show


def controller_colours(names: Mapping[str, str], rows: Iterable[Row] | None = None) -> dict[str, str]:
    """Spec -> colour. A name has the colour that a study gives it, each of the others one of its own.

    Args:
        names: Spec -> name in the figures, of every controller of a report or a figure.
        rows: Rows of the studies that give names a colour; those of the released ones when not given.
    """
    rows = released_rows() if rows is None else rows
    given = {row.label: COLOURS[row.colour] for row in rows if row.colour}
    label = {
        name: name.rpartition(", seed ")[0] or name for name in names.values()
    }  # a seed is of its method
    known = {name: given[of] for name, of in label.items() if of in given}
    others = sorted(set(names.values()) - known.keys())
    more = (to_hex(tuple(hsv_to_rgb((k * GOLDEN % 1.0, 0.85, (0.75, 0.5)[k % 2])))) for k in count(1))
    free = (each for each in chain(METHOD_COLOURS, more) if each not in known.values())
    known |= dict(zip(others, list(islice(free, len(others))), strict=True))
    return {spec: known[name] for spec, name in names.items()}


def save(figure: Figure, name: str, out_dir: Path | str) -> list[Path]:
    """Writes `<out_dir>/<name>.png` and .svg without dates or program versions in them."""
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    png, svg = folder / f"{name}.png", folder / f"{name}.svg"
    # `savefig` draws each file twice, the first time for its size alone: the canvases draw once
    figure.dpi = rcParams["savefig.dpi"]
    figure.patch.set_facecolor(rcParams["savefig.facecolor"])
    FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})
    figure.set_layout_engine("none")  # laid out by now; both files look the same
    FigureCanvasSVG(figure).print_svg(svg, metadata={"Date": None, "Creator": None})
    return [png, svg]


def styled():
    """The bench's style as a context."""
    # "default" first: a reader's own matplotlibrc must not change the figure.
    return style.context(["default", str(STYLE)])
