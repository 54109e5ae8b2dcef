"""How numbers stand in a cell: units, digits, minus signs, intervals; an undefined value is a dash."""

from collections.abc import Mapping

import numpy as np

from wbc_bench.outcomes import SuccessRule
from wbc_bench.results import stats

CM = 100.0  # [cm/m]
DEG = 180.0 / np.pi  # [deg/rad]
NONE = "–"  # an undefined value


def spread_text(value: stats.Spread, digits: int) -> str:
    if np.isnan(value.mean):
        return NONE
    return f"{value.mean:.{digits}f}" + ("" if np.isnan(value.sd) else f" ± {value.sd:.{digits}f}")


def interval_text(value: stats.Estimate, scale: float, digits: int, sign: str = "") -> str:
    if np.isnan(value.point):
        return NONE
    known = (value.point, value.low, value.high)
    point, low, high = (NONE if np.isnan(x) else f"{x * scale:{sign}.{digits}f}" for x in known)
    return f"{point} [{low}, {high}]".replace("-", "−")


def p_value_text(p: float) -> str:
    return NONE if np.isnan(p) else "<0.001" if p < 0.001 else f"{p:.3f}"


def tolerance_text(rule: SuccessRule) -> str:
    return f"{rule.position * CM:g} cm and {rule.orientation * DEG:g} deg"


def window_text(rule: SuccessRule) -> str:
    return f"final {rule.window:g} s"


def names_note(names: Mapping[str, str]) -> tuple[str, ...]:
    """Which controllers stand behind their names (spec -> name); nothing where all go by their spec."""
    parts = [f"{name} is `{spec}`" for spec, name in names.items() if name != spec]
    return (f"Controllers: {', '.join(parts)}.",) if parts else ()


def number_text(value: float, digits: int) -> str:
    return NONE if np.isnan(value) else f"{value:.{digits}f}".replace("-", "−")
