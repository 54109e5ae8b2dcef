"""The paper's Table III from the records of a study.

The text of a cell is what a reader needs; the CSV holds the same numbers in full and one unit per column.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from wbc_bench.results import stats
from wbc_bench.results.analysis import (
    Evaluated,
    Mask,
    rule_of,
    subset,
)
from wbc_bench.results.analysis import column as series
from wbc_bench.results.formatting import (
    CM,
    DEG,
    NONE,
    names_note,
    spread_text,
    tolerance_text,
    window_text,
)
from wbc_bench.results.study import Paper, Study, study_rows
from wbc_bench.results.table import Table


class Column(NamedTuple):
    """A column of a table over replicates."""

    name: str  # as in a study file, and of the CSV's columns
    header: str
    metric: str
    quantile: float | None  # None is the mean
    scale: float
    digits: int


COLUMNS = (
    Column("success", "Success ↑ (%)", "success", None, 100.0, 2),
    Column("position_mean", "Pos. mean ↓ (cm)", "position_error", None, CM, 2),
    Column("position_p95", "Pos. P95 ↓ (cm)", "position_error", 0.95, CM, 2),
    Column("orientation_mean", "Ori. mean ↓ (deg)", "orientation_error", None, DEG, 2),
    Column("orientation_p95", "Ori. P95 ↓ (deg)", "orientation_error", 0.95, DEG, 2),
    Column("action_variation", "Action variation ↓", "action_variation", None, 1.0, 3),
)


def column_value(column: Column, episodes: pd.DataFrame) -> float:
    """One replicate's value, in the unit of the column; NaN without a defined value."""
    values = series(episodes, column.metric)
    values = values[~np.isnan(values)]
    if len(values) == 0:
        return float("nan")
    value = values.mean() if column.quantile is None else np.quantile(values, column.quantile)
    return float(value) * column.scale


def defined(method: Evaluated, over: Mask) -> int:
    """Episodes of `over` that have an error: one that ended before its first step has none."""
    return int((over & ~np.isnan(series(method.episodes, "position_error"))).sum())


def columns_over_replicates(
    method: Evaluated, over: Mask, where: Mask | None = None, columns: Sequence[Column] = COLUMNS
) -> dict[str, stats.Spread]:
    """Column name -> spread over replicates: success over `where`, the rest over those of them in `over`."""
    replicate = series(method.episodes, "replicate")
    where = np.ones(len(replicate), dtype=bool) if where is None else where
    result = {}
    for column in columns:
        chosen = where if column.name == "success" else where & over
        masks = (chosen & (replicate == record.replicate) for record in method.records)
        values = [column_value(column, subset(method.episodes, mask)) for mask in masks]
        # A replicate without a defined value has none: the mean is over those that have one.
        known = [value for value in values if not np.isnan(value)]
        result[column.name] = stats.spread(known) if known else stats.Spread(np.nan, np.nan, 0)
    return result


def paper_columns(paper: Paper | None, spec: str) -> dict[str, stats.Spread] | None:
    """The paper's own row for a method, or None where it prints none; a column it lacks is NaN."""
    if paper is None or spec not in paper.mean:
        return None
    nothing = stats.Spread(np.nan, np.nan, 0)
    cells = zip(paper.columns, paper.mean[spec], paper.sd[spec], strict=True)
    printed = {name: stats.Spread(mean, sd, paper.seeds) for name, mean, sd in cells}
    return {column.name: printed.get(column.name, nothing) for column in COLUMNS}


def paper_table(study: Study, evaluated: Mapping[str, Evaluated], terminated: bool = False) -> Table:
    """The paper's Table III; errors over episodes that did not terminate, or over all of them."""
    rows, data = [], []
    reads: dict[str, str] = {}
    commands: dict[str, str] = {}
    heading = None
    for row in study_rows(study, evaluated):
        group = row.heading if row.heading != heading else ""
        heading = row.heading
        method = evaluated.get(row.spec)
        base = {"study": row.heading, "method": row.label, "controller": row.spec}
        if method is None:
            note = f"not evaluated: {row.absent}"
            rows.append((group, row.label, note, *[NONE] * (len(COLUMNS) + 1)))
            data.append({**base, "source": "measured", "note": note})
        else:
            over = method.not_terminated | terminated
            values = columns_over_replicates(method, over)
            label = row.label
            for mark, found, more in (("†", reads, method.extra_signals), ("‡", commands, method.commands)):
                if more:
                    label, found[row.label] = f"{label} {mark}", ", ".join(more)
            count = defined(method, over)
            cells = (spread_text(values[column.name], column.digits) for column in COLUMNS)
            rows.append((group, label, method.counts, str(count), *cells))
            counts = {"completed": method.completed, "requested": method.requested, "errors_over": count}
            counts["replicates"] = len(method.records)
            data.append({**base, "source": "measured", "note": "", **counts, **_flat(values)})
        printed = None if terminated else paper_columns(study.paper, row.spec)
        if printed and study.paper:
            episodes = study.paper.seeds * study.paper.episodes
            cells = (spread_text(printed[column.name], column.digits) for column in COLUMNS)
            rows.append(("", "(paper)", f"{episodes}/{episodes}" if episodes else NONE, NONE, *cells))
            data.append({**base, "source": "paper", "note": "", **_flat(printed)})
    header = ("Study", "Method", "Episodes", "Errors over", *(column.header for column in COLUMNS))
    rule = rule_of(evaluated)
    if terminated:
        name, title = f"{study.name}_all", f"{study.name}: errors over all episodes"
        notes = [
            "As the table before, with the episodes that terminated: their error is the mean over the last "
            f"{rule.window:g} s before the end, and an episode that ended before its first step has none."
        ]
    else:
        name, title = study.name, f"{study.name}: errors over episodes that did not terminate"
        notes = _paper_notes(study, evaluated)
    notes += names_note({spec: method.name for spec, method in evaluated.items()})
    if reads:
        notes.append(f"† reads more than the paper's policy: {_listed(reads)}.")
    if commands:
        notes.append(
            f"‡ commands more than joint positions, and its action variation is that of its own action: "
            f"{_listed(commands)}."
        )
    columns = [
        "study",
        "method",
        "controller",
        "source",
        "note",
        "replicates",
        "completed",
        "requested",
        "errors_over",
    ]
    columns += [f"{column.name}_{part}" for column in COLUMNS for part in ("avg", "sd")]
    return Table(
        name, title, header, tuple(rows), tuple(notes), _integers(pd.DataFrame(data).reindex(columns=columns))
    )


def _listed(marks: Mapping[str, str]) -> str:
    return "; ".join(f"{method}: {what}" for method, what in marks.items())


def _flat(values: dict[str, stats.Spread]) -> dict[str, float]:
    return {f"{name}_{part}": x for name, v in values.items() for part, x in (("avg", v.mean), ("sd", v.sd))}


def _integers(frame: pd.DataFrame) -> pd.DataFrame:
    """Counts stay whole where a row has none."""
    counts = [c for c in ("replicates", "completed", "requested", "errors_over") if c in frame]
    return frame.astype(dict.fromkeys(counts, "Int64"))


def _paper_notes(study: Study, evaluated: Mapping[str, Evaluated]) -> list[str]:
    rule = rule_of(evaluated)
    notes = [
        "Episodes: completed/requested. Success counts every episode: both errors inside "
        f"{tolerance_text(rule)} at every step of the {window_text(rule)} of {rule.horizon:g} s. ± is the "
        "sample standard deviation over replicates.",
        f"Errors are means over the {window_text(rule)} of an episode; mean and P95 are over the episodes "
        "that did not end in a fall, an illegal contact or NaN (`Errors over` of them). "
        "The table over all episodes stands beside this one.",
    ]
    if study.paper:
        paper = study.paper
        notes.append(" ".join([f"Paper: {paper.source}, {paper.place}.", *paper.notes]))
    untrained = [spec for spec, method in evaluated.items() if not method.trained]
    if untrained:
        names = ", ".join(f"`{spec}`" for spec in untrained)
        notes.insert(
            1,
            f"No checkpoint is recorded for {names}. Replicates are disjoint sets of episodes: their ± says "
            "how far those sets differ, not how far training seeds do.",
        )
    return notes
