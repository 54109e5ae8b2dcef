"""Margins, breaking points and curves of a severity ladder."""

from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd

from wbc_bench.results import stats
from wbc_bench.results.formatting import NONE, interval_text, names_note, number_text
from wbc_bench.results.margins import (
    BOOTSTRAP_SEED,
    LOST,
    Interval,
    Robustness,
    margin_difference,
)
from wbc_bench.results.stress import FactorRecord, Stress
from wbc_bench.results.table import Table

NEVER = "not reached"
INTERVALS = (
    f"Intervals of 95 %: Wilson for success, else bootstrap ({stats.RESAMPLES} resamples of episodes, the "
    f"same at every level, seed {BOOTSTRAP_SEED}). They cover the draw of episodes, not the training seed of "
    "a learned method."
)


def margin_table(stress: Stress, found: Mapping[str, Robustness]) -> Table:
    """Success at the base and margin of each controller; `found` is `analyse(stress)`."""
    ladder, rows, data = stress.ladder, [], []
    for climb in stress.climbs:
        base, curves, margin = found[climb.spec]
        rows.append(
            (
                *(climb.name, str(climb.episodes), interval_text(base, 100.0, 1)),
                *(f"{len(curves)}/{len(ladder.factors)}", _decimal(margin)),
            )
        )
        data.append(
            {"controller": climb.spec, "episodes": climb.episodes, "base_success": base.point}
            | {"base_low": base.low, "base_high": base.high, "factors": len(curves)}
            | {"margin": margin.point, "low": margin.low, "high": margin.high}
        )
    notes = (
        f"Each of {len(ladder.factors)} factors grows alone over the base, the first episodes of "
        f"`{ladder.source}`; every level has the same targets and, but for its factor, the same draws. "
        "Success over the severities is fitted by the closest curve that never rises; its area, relative to "
        "the base's success throughout, averaged over the factors, is the margin: 1 loses nothing, 0 has "
        "lost everything at the mildest level. Margins over different factors do not compare.",
        INTERVALS,
        *_provenance(stress),
        *_names(stress),
    )
    header = ("Controller", "Episodes", "Base success (%)", "Factors", "Margin ↑")
    title = f"{ladder.name}: margins under disturbances that grow"
    return Table(ladder.name, title, header, tuple(rows), notes, pd.DataFrame(data))


def breaking_table(stress: Stress, found: Mapping[str, Robustness]) -> Table:
    """Breaking point of each controller under each factor."""
    ladder, rows, data = stress.ladder, [], []
    for factor in ladder.factors:
        first, last = factor.severities[[0, -1]]
        group = f"{_axis(factor)} {first:g} to {last:g}"
        for climb in stress.climbs:
            curve = found[climb.spec].curves.get(factor.name)
            if curve is None:
                continue
            ends = curve.successes[[0, -1]] / climb.episodes
            cells = [number_text(100.0 * rate, 1) for rate in ends]
            rows.append((group, climb.name, *cells, _severity(curve.breaking), _decimal(curve.area)))
            group = ""
            data.append(
                {"factor": factor.name, "unit": factor.unit, "controller": climb.spec}
                | {"episodes": climb.episodes, "first_level": first, "last_level": last}
                | {"success_first": ends[0], "success_last": ends[1]}
                | dict(zip(("breaking", "breaking_low", "breaking_high"), curve.breaking, strict=True))
                | dict(zip(("area", "area_low", "area_high"), curve.area, strict=True))
            )
    notes = (
        f"Breaking point: the severity at which the fitted success has lost {LOST * 100:g} % of the base's, "
        f"linear between levels; `{NEVER}` up to the last level. A success that low at the first level gives "
        "that level. Area: under the fit, relative to the base's success. In the CSV, inf is not reached.",
        INTERVALS,
        *_names(stress),
    )
    header = ("Factor", "Controller", "Success, first level (%)", "Success, last level (%)")
    header += ("Breaking point", "Area ↑")
    title = f"{ladder.name}: breaking points"
    return Table(f"{ladder.name}_breaking", title, header, tuple(rows), notes, pd.DataFrame(data))


def difference_table(stress: Stress) -> Table:
    """Differences of margins between all pairs of controllers, on the episodes of both."""
    ladder, rows, data = stress.ladder, [], []
    for a, b in combinations(stress.climbs, 2):
        interval, episodes, factors = margin_difference(a, b, ladder, np.random.default_rng(BOOTSTRAP_SEED))
        rows.append((f"{a.name} vs {b.name}", str(episodes), str(factors), _decimal(interval, "+")))
        data.append(
            {"a": a.spec, "b": b.spec, "episodes": episodes, "factors": factors}
            | dict(zip(("difference", "low", "high"), interval, strict=True))
        )
    notes = (
        "Margin of A − that of B on the same episodes and factors; above 0 favours A. Not corrected for the "
        "number of pairs.",
        INTERVALS,
    )
    header = ("A vs B", "Episodes", "Factors", "Δ margin")
    title = f"{ladder.name}: differences of margins"
    return Table(f"{ladder.name}_pairs", title, header, tuple(rows), notes, pd.DataFrame(data))


def curve_table(stress: Stress, found: Mapping[str, Robustness]) -> Table:
    """Success at every level, a column per controller; the file of numbers has a row for each."""
    ladder, data = stress.ladder, []
    rates = {climb.spec: found[climb.spec].base for climb in stress.climbs}
    rows = [("Base", "", *(interval_text(rate, 100.0, 0) for rate in rates.values()))]
    for climb in stress.climbs:
        data.append(_point(climb.spec, "base", "", np.nan, rates[climb.spec], np.nan))
    for factor in ladder.factors:
        for k, severity in enumerate(factor.severities):
            cells = []
            for climb in stress.climbs:
                curve = found[climb.spec].curves.get(factor.name)
                if curve is None:
                    cells.append(NONE)
                    continue
                rate = stats.wilson(int(curve.successes[k]), climb.episodes)
                cells.append(interval_text(rate, 100.0, 0))
                data.append(_point(climb.spec, factor.name, factor.unit, severity, rate, curve.fit[k]))
            rows.append((_axis(factor) if k == 0 else "", f"{severity:g}", *cells))
    header = ("Factor", "Level", *(f"{climb.name}: success (%)" for climb in stress.climbs))
    title = f"{ladder.name}: success at every level"
    notes = (INTERVALS, *_names(stress))
    return Table(f"{ladder.name}_curves", title, header, tuple(rows), notes, pd.DataFrame(data))


def write_stress_tables(stress: Stress, found: Mapping[str, Robustness], out_dir: Path | str) -> list[Path]:
    """The tables of a ladder (three without a pair to compare), into `out_dir`: `<results>/tables`."""
    tables = [make(stress, found) for make in (margin_table, breaking_table, curve_table)]
    tables.append(difference_table(stress))
    return [path for table in tables if table.rows for path in table.write(Path(out_dir))]


def _point(
    spec: str, factor: str, unit: str, severity: float, rate: stats.Estimate, fit: float
) -> dict[str, object]:
    return {
        **{"factor": factor, "unit": unit, "severity": severity, "controller": spec},
        **{"episodes": rate.num_episodes, "success_rate": rate.point, "low": rate.low, "high": rate.high},
        "fit": fit,
    }


def _axis(factor: FactorRecord) -> str:
    return f"{factor.label} ({factor.unit})" if factor.unit else factor.label


def _decimal(value: Interval, sign: str = "") -> str:
    known = (NONE if np.isnan(x) else f"{x:{sign}.2f}" for x in value)
    return NONE if np.isnan(value.point) else "{} [{}, {}]".format(*known).replace("-", "−")


def _severity(value: Interval) -> str:
    known = (NONE if np.isnan(x) else NEVER if np.isinf(x) else f"{x:.3g}" for x in value)
    return NONE if np.isnan(value.point) else "{} [{}, {}]".format(*known).replace("-", "−")


def _names(stress: Stress) -> tuple[str, ...]:
    return names_note({climb.spec: climb.name for climb in stress.climbs})


def _provenance(stress: Stress) -> tuple[str, ...]:
    """Which commits the runs come from: there are too many of them to list."""
    records = [record for climb in stress.climbs for record in climb.records]
    commits = {
        (record.git_commit or "no commit")[:12] + (" + uncommitted changes" if record.git_dirty else "")
        for record in records
    }
    text = f"{len(records)} runs, evaluated by {', '.join(sorted(commits))}; base protocol digest "
    return (f"{text}`{stress.ladder.base.digest[:12]}`.",)
