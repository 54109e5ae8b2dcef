"""Tables of a store, each in Markdown, LaTeX (booktabs) and CSV; the same store gives the same bytes.

The text of a cell is what a reader needs; the CSV holds the same numbers in full and one unit a column.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from wbc_bench import stats
from wbc_bench.analysis import (
    END_ZONE,
    REACH_TOLERANCE,
    Evaluated,
    HeightRange,
    Mask,
    StoreLike,
    by_height,
    collect,
    median,
    oscillation,
    paper_values,
    reach_range,
    reached,
    stood,
    strata_of,
    subset,
    variants,
)
from wbc_bench.analysis import column as series
from wbc_bench.errors import UnknownNameError
from wbc_bench.files import folder_name
from wbc_bench.formatting import CM, DEG, NONE, interval_text, number_text, p_value_text, spread_text
from wbc_bench.markup import Table
from wbc_bench.outcomes import Outcome

BOOTSTRAP_SEED = 0


class Row(NamedTuple):
    """One method of a study."""

    heading: str
    label: str
    spec: str
    absent: str = "no checkpoint"  # why, when the store holds no run of it


@dataclass(frozen=True)
class Study:
    """The methods that share a table, and the pairs of them that are tested against each other."""

    protocol: str
    rows: Sequence[Row | tuple[str, str, str]]
    pairs: Sequence[tuple[str, str]] = ()  # (spec, spec), named before the results are seen; () is every pair


ABLATION = Study(
    protocol="ablation_v1",
    rows=(
        Row("Model-based", "Hold posture", "hold", "no run"),
        Row("Model-based", "Whole-body IK", "ik", "no run"),
        Row("Model-based", "IK, kinematic only", "ik:kinematic", "no run"),
        Row("Model-based", "IK on OSQP", "ik:osqp", "no run"),
        Row("Reward", "Matched additive", "learned:transformer_gru_additive"),
        Row("Reward", "Reward gating", "learned:transformer_gru"),
        Row("Temporal context", "No latent", "learned:no_latent"),
        Row("Temporal context", "DreamWaQ/CENet", "learned:cenet"),
        Row("Temporal context", "GRU only", "learned:gru"),
        Row("Temporal context", "Transformer only", "learned:transformer"),
        Row("Temporal context", "Transformer + GRU", "learned:transformer_gru"),
        Row("Upper bound", "Privileged oracle", "learned:oracle"),
    ),
    pairs=(
        ("ik", "hold"),
        ("ik", "ik:kinematic"),
        ("ik", "ik:osqp"),
        ("learned:transformer_gru", "ik"),
        ("learned:transformer_gru", "learned:transformer_gru_additive"),
        ("learned:transformer_gru", "learned:no_latent"),
        ("learned:transformer_gru", "learned:cenet"),
        ("learned:transformer_gru", "learned:gru"),
        ("learned:transformer_gru", "learned:transformer"),
        ("learned:oracle", "learned:transformer_gru"),
    ),
)


def study_rows(study: Study, evaluated: dict[str, Evaluated]) -> list[Row]:
    """The study's rows, then whatever else the store holds: a user's own controller needs no list."""
    rows = [Row(*row) for row in study.rows]
    named = {row.spec for row in rows}
    heading = "Other" if rows else "Evaluated"
    return rows + [Row(heading, spec, spec) for spec in evaluated if spec not in named]


# --- cells --------------------------------------------------------------------------------------------


# --- the paper's table --------------------------------------------------------------------------------


class Column(NamedTuple):
    """A column of the paper's Table III."""

    name: str  # as in paper_values.toml
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
    method: Evaluated, over: Mask, where: Mask | None = None
) -> dict[str, stats.Spread]:
    """Column name -> spread over replicates: success over `where`, errors over those of them in `over`."""
    replicate = series(method.episodes, "replicate")
    where = np.ones(len(replicate), dtype=bool) if where is None else where
    result = {}
    for column in COLUMNS:
        chosen = where if column.name == "success" else where & over
        masks = (chosen & (replicate == record.replicate) for record in method.records)
        values = [column_value(column, subset(method.episodes, mask)) for mask in masks]
        # A replicate without a defined value has none: the mean is over those that have one.
        known = [value for value in values if not np.isnan(value)]
        result[column.name] = stats.spread(known) if known else stats.Spread(np.nan, np.nan, 0)
    return result


def paper_columns(spec: str) -> dict[str, stats.Spread] | None:
    """The paper's own row for a method, or None where it prints none."""
    block = paper_values()["ablation"]
    if spec not in block["mean"]:
        return None
    cells = zip(block["columns"], block["mean"][spec], block["sd"][spec], strict=True)
    return {name: stats.Spread(mean, sd, 3) for name, mean, sd in cells}


def paper_table(store: StoreLike, study: Study, terminated: bool = False) -> Table:
    """The paper's Table III; errors over episodes that did not terminate, or over all of them."""
    evaluated = collect(store, study.protocol)
    rows, data, marks = [], [], {}
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
            over = method.stood | terminated
            values = columns_over_replicates(method, over)
            if method.extra_signals:
                marks[row.label] = ", ".join(method.extra_signals)
            label = row.label + (" †" if method.extra_signals else "")
            count = defined(method, over)
            cells = (spread_text(values[column.name], column.digits) for column in COLUMNS)
            rows.append((group, label, method.counts, str(count), *cells))
            counts = {"completed": method.completed, "requested": method.requested, "errors_over": count}
            counts["replicates"] = len(method.records)
            data.append({**base, "source": "measured", "note": "", **counts, **_flat(values)})
        printed = None if terminated else paper_columns(row.spec)
        if printed:
            cells = (spread_text(printed[column.name], column.digits) for column in COLUMNS)
            rows.append(("", "(paper)", "3000/3000", NONE, *cells))
            data.append({**base, "source": "paper", "note": "", **_flat(printed)})
    header = ("Study", "Method", "Episodes", "Errors over", *(column.header for column in COLUMNS))
    if terminated:
        name, title = f"{study.protocol}_all", f"{study.protocol}: errors over all episodes"
        notes = [
            "As the table before, with the episodes that terminated: their error is the mean over the last "
            "1 s before the end, and an episode that ended before its first step has none."
        ]
    else:
        name, title = study.protocol, f"{study.protocol}: errors over episodes that did not terminate"
        notes = _paper_notes(evaluated)
    if marks:
        notes.append(
            "† reads more than the paper's policy: " + "; ".join(f"{m}: {s}" for m, s in marks.items()) + "."
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


def _flat(values: dict[str, stats.Spread]) -> dict[str, float]:
    return {f"{name}_{part}": x for name, v in values.items() for part, x in (("avg", v.mean), ("sd", v.sd))}


def _integers(frame: pd.DataFrame) -> pd.DataFrame:
    """Counts stay whole where a row has none."""
    counts = [c for c in ("replicates", "completed", "requested", "errors_over") if c in frame]
    return frame.astype(dict.fromkeys(counts, "Int64"))


def _paper_notes(evaluated: dict[str, Evaluated]) -> list[str]:
    notes = [
        "Episodes: completed/requested. Success counts every episode. ± is the sample standard deviation "
        "over replicates.",
        "Errors are means over the final 1 s of an episode; mean and P95 are over the episodes that did not "
        "end in a fall, an illegal contact or NaN (`Errors over` of them). The paper's columns are read so: "
        "a P95 of 5.38 cm at 88 % success leaves no room for falls. "
        "The table over all episodes stands beside this one.",
        f"Paper: {paper_values()['source']}, {paper_values()['ablation']['source']}. Its ± is over three "
        "training seeds; its simulator and robot model are not ours.",
    ]
    untrained = [spec for spec, method in evaluated.items() if not method.trained]
    if untrained:
        names = ", ".join(f"`{spec}`" for spec in untrained)
        notes.insert(
            1,
            f"Not trained: {names}. Their replicates are disjoint sets of episodes met by one and the same "
            "controller, not training seeds; their ± says how far those sets differ.",
        )
    return notes


# --- by stratum -----------------------------------------------------------------------------------------


def _groups(method: Evaluated) -> list[tuple[str, Mask]]:
    """(stratum or "all", mask) of a method."""
    stratum = np.asarray(method.episodes["stratum"], dtype=str)
    return [*((s, stratum == s) for s in strata_of(method.episodes)), ("all", stratum == stratum)]


def methods_of(study: Study, evaluated: dict[str, Evaluated]) -> list[tuple[str, Evaluated]]:
    """Evaluated methods, once each (a method may stand under two headings)."""
    rows = {row.spec: row.label for row in reversed(study_rows(study, evaluated))}
    return [(label, evaluated[spec]) for spec, label in reversed(rows.items()) if spec in evaluated]


def outcome_table(store: StoreLike, study: Study) -> Table:
    """Success by stratum with its interval, and how the rest ended; the counts of a row add up."""
    rows, data = [], []
    for label, method in methods_of(study, collect(store, study.protocol)):
        for k, (stratum, mask) in enumerate(_groups(method)):
            outcome = np.asarray(method.episodes["outcome"], dtype=str)[mask]
            counts = {str(name): int((outcome == str(name)).sum()) for name in Outcome}
            rate = stats.wilson(counts[Outcome.SUCCESS], len(outcome), len(method.records))
            cells = (str(count) for count in counts.values())
            total = method.counts if stratum == "all" else str(len(outcome))
            rows.append((label if k == 0 else "", stratum, total, interval_text(rate, 100.0, 1), *cells))
            data.append(
                {
                    **{"controller": method.spec, "stratum": stratum, "episodes": len(outcome)},
                    **{"success_rate": rate.point, "low": rate.low, "high": rate.high, **counts},
                }
            )
    header = ("Method", "Stratum", "Episodes", "Success (%) [95 %]", *(o.replace("_", " ") for o in Outcome))
    notes = (
        "Success with its Wilson interval over episodes, replicates pooled. The counts of a row add up to "
        "its episodes; on the row `all` these are completed/requested.",
        "Strata: `arm` can be reached with the base where it is, `posture` with the feet where they are, "
        "`step` asks for stepping.",
        "`missed`: stood, never inside the tolerance; `drifted`: was inside, did not hold it; `qp "
        "infeasible`: stood, off target, its solver without a solution at the end; "
        "`invalid`: NaN or diverged.",
    )
    title = f"{study.protocol}: success and outcomes by stratum"
    return Table(f"{study.protocol}_outcomes", title, header, tuple(rows), notes, pd.DataFrame(data))


def stratum_table(store: StoreLike, study: Study) -> Table:
    """The paper's columns by stratum, over episodes that did not terminate and over all."""
    rows, data = [], []
    for label, method in methods_of(study, collect(store, study.protocol)):
        for k, (stratum, mask) in enumerate(_groups(method)[:-1]):
            for terminated in (False, True):
                over = method.stood | terminated
                count = defined(method, over & mask)
                values = columns_over_replicates(method, over, mask)
                name = "all" if terminated else "not terminated"
                cells = (spread_text(values[column.name], column.digits) for column in COLUMNS)
                first = (label if k == 0 else "", stratum) if not terminated else ("", "")
                rows.append((*first, f"{count} {name}", *cells))
                base = {"controller": method.spec, "stratum": stratum, "over": name, "errors_over": count}
                data.append({**base, **_flat(values)})
    header = ("Method", "Stratum", "Errors over", *(column.header for column in COLUMNS))
    notes = (
        "Mean ± sample standard deviation over replicates. Success counts every episode of the stratum in "
        "both rows; the other columns are over the episodes named in the row.",
    )
    title = f"{study.protocol}: the paper's columns by stratum"
    return Table(f"{study.protocol}_strata", title, header, tuple(rows), notes, pd.DataFrame(data))


# --- pairs ------------------------------------------------------------------------------------------------


def _compare_rows(pairs: Sequence[tuple[str, Evaluated, Evaluated, str | None]]) -> list[dict[str, Any]]:
    """One dict a comparison (name, a, b, stratum); p-values adjusted over the tests of all of them."""
    results, tests = [], []
    for name, a, b, stratum in pairs:
        both = pd.merge(
            a.episodes.assign(stood=a.stood),
            b.episodes.assign(stood=b.stood),
            on=["replicate", "episode"],
            suffixes=("_a", "_b"),
            validate="one_to_one",
        )
        if stratum is not None:
            both = subset(both, np.asarray(both["stratum_a"] == stratum))
        seeds = len(np.unique(series(both, "replicate")))
        neither = subset(both, np.asarray(both["stood_a"] & both["stood_b"], dtype=bool))
        result: dict[str, Any] = {"name": name, "a": a.spec, "b": b.spec}
        result |= {"episodes": len(both), "both_stood": len(neither)}
        p_values = dict.fromkeys(("success", "position_error", "orientation_error"), float("nan"))
        for metric in p_values:
            frame = both if metric == "success" else neither
            x, y = series(frame, f"{metric}_a"), series(frame, f"{metric}_b")
            known = ~np.isnan(x) & ~np.isnan(y)
            x, y = x[known], y[known]
            nothing = stats.Estimate(np.nan, np.nan, np.nan, seeds, 0, "no common episode")
            result[metric] = nothing
            if len(x):
                rng = np.random.default_rng(BOOTSTRAP_SEED)
                result[metric], p_values[metric] = stats.paired_bootstrap(x, y, rng, seeds)
                if metric == "success":
                    test = stats.mcnemar_exact(x, y)
                    result |= {"only_a": test.only_a, "only_b": test.only_b}
                    p_values[metric] = test.p_value
        result["p"] = p_values
        results.append(result)
        tests += list(p_values.values())
    adjusted = iter(stats.holm(tests))
    for result in results:
        result["p_holm"] = {metric: float(next(adjusted)) for metric in result["p"]}
    return results


DIFFERENCES = (
    ("success", "pp", 100.0, 1),
    ("position_error", "cm", CM, 2),
    ("orientation_error", "deg", DEG, 2),
)


def _compare_table(name: str, title: str, first: str, results: list[dict[str, Any]]) -> Table:
    rows, data = [], []
    for result in results:
        cells, flat = [], {}
        for metric, unit, scale, digits in DIFFERENCES:
            estimate, p = result[metric], result["p_holm"][metric]
            cells += [interval_text(estimate, scale, digits, "+"), p_value_text(p)]
            values = zip(("diff", "low", "high"), estimate[:3], strict=True)
            flat |= {f"{metric}_{part}_{unit}": value * scale for part, value in values}
            flat |= {f"{metric}_p": result["p"][metric], f"{metric}_p_holm": p}
        counts = [result["episodes"], result.get("only_a", 0), result.get("only_b", 0), result["both_stood"]]
        rows.append((result["name"], *map(str, counts), *cells))
        keys = ("episodes", "only_a", "only_b", "both_stood")
        data.append(
            {"a": result["a"], "b": result["b"], first.lower(): result["name"]}
            | dict(zip(keys, counts, strict=True))
            | flat
        )
    header = (
        *(first, "Episodes", "Only A succeeds", "Only B succeeds", "Neither terminated"),
        *("Δ success (pp)", "p", "Δ pos. (cm)", "p", "Δ ori. (deg)", "p"),
    )
    notes = (
        "Differences are A − B on the same episodes with their 95 % paired bootstrap interval "
        f"({stats.RESAMPLES} resamples of episodes, seed {BOOTSTRAP_SEED}); Δ success above 0 and Δ errors "
        "below 0 favour A. Errors are compared on episodes that neither method terminated in.",
        "p: exact McNemar for success, bootstrap for errors (no smaller than "
        f"{2 / (stats.RESAMPLES + 1):.4f} before correction); Holm-corrected over every test of this table.",
        "The intervals cover the draw of episodes, not the training seed of a learned method.",
    )
    return Table(name, title, header, tuple(rows), notes, pd.DataFrame(data))


def pair_table(store: StoreLike, study: Study) -> Table:
    """The study's pairs of methods on the episodes both of them met."""
    evaluated = collect(store, study.protocol)
    specs = [method.spec for _, method in methods_of(study, evaluated)]
    pairs = study.pairs or [(a, b) for k, a in enumerate(specs) for b in specs[k + 1 :]]
    known = [
        (f"{a} vs {b}", evaluated[a], evaluated[b], None)
        for a, b in pairs
        if a in evaluated and b in evaluated
    ]
    title = f"{study.protocol}: pairs of methods on the same episodes"
    return _compare_table(f"{study.protocol}_pairs", title, "A vs B", _compare_rows(known))


def compare_table(store: StoreLike, protocol: str, a: str, b: str) -> Table:
    """Two controllers on the same episodes, by stratum and together.

    Raises: UnknownNameError for a controller without a run under the protocol.
    """
    evaluated = collect(store, protocol)
    for spec in (a, b):
        if spec not in evaluated:
            raise UnknownNameError("evaluated controller", spec, evaluated, f"runs of {protocol}")
    one, two = evaluated[a], evaluated[b]
    rows = [(s, one, two, None if s == "all" else s) for s in (*strata_of(one.episodes), "all")]
    name = f"{protocol}_{folder_name(a)}_vs_{folder_name(b)}"
    title = f"{protocol}: A = {a} against B = {b}"
    return _compare_table(name, title, "Stratum", _compare_rows(rows))


# --- reach ------------------------------------------------------------------------------------------------


def _range(span: HeightRange) -> str:
    return "none" if np.isnan(span.low) else f"{span.low * CM:.0f}–{span.high * CM:.0f}"


def reach_table(store: StoreLike, protocol: str) -> Table:
    """Lowest and highest height of each controller and variant, and how much it sways near them."""
    rows, data = [], []
    block = paper_values()["reach"]
    for name, (low, high) in ((k, v) for k, v in block.items() if k != "source"):
        rows.append((f"{name}, paper ({block['source']})", *[NONE] * 3, f"{low}–{high}", *[NONE] * 4))
        data.append({"controller": name, "source": "paper", "low_cm": low, "high_cm": high})
    for spec, method in collect(store, protocol).items():
        for k, (condition, orientation, episodes) in enumerate(variants(method.episodes)):
            span, strict = reach_range(episodes), reach_range(episodes, strict=True)
            speed = oscillation(episodes, span, "ee_speed_rms")
            sparc = oscillation(episodes, span, "ee_sparc")
            total = f"{len(episodes)}" if k else f"{len(episodes)} (run: {method.counts})"
            rows.append(
                (
                    *(spec if k == 0 else "", condition, orientation, total),
                    *(_range(span), f"{span.reached}/{len(by_height(episodes))}", _range(strict)),
                    " / ".join(number_text(value * CM, 1) for value in speed),
                    " / ".join(number_text(value, 2) for value in sparc),
                )
            )
            zones = ("low_end", "middle", "high_end")
            data.append(
                {
                    **{"controller": spec, "source": "measured", "condition": condition},
                    **{"orientation": orientation, "episodes": len(episodes)},
                    **{"low_cm": span.low * CM, "high_cm": span.high * CM, "heights_reached": span.reached},
                    **{"strict_low_cm": strict.low * CM, "strict_high_cm": strict.high * CM},
                    **{f"speed_rms_{zone}_cm_s": v * CM for zone, v in zip(zones, speed, strict=True)},
                    **{f"sparc_{zone}": v for zone, v in zip(zones, sparc, strict=True)},
                }
            )
    header = (
        *("Controller", "Dynamics", "Gripper", "Episodes", "Reached (cm)", "Heights reached"),
        *("Succeeded (cm)", "EE speed RMS (cm/s) low / mid / high", "SPARC low / mid / high"),
    )
    notes = (
        "Reached: the longest run of neighbouring heights at which the median position error over the final "
        f"1 s is below {REACH_TOLERANCE * CM:.0f} cm, a terminated episode counting as infinitely far. "
        "Succeeded: the same with more than half of the episodes inside 5 cm and 7 deg at every step "
        "of that second.",
        "Oscillation in the final 1 s, median over episodes that did not terminate: within "
        f"{END_ZONE * CM:.0f} cm of the low end of the range reached, between, within as much of the high "
        "end. SPARC is the spectral arc length of the end-effector's speed (0 is smoothest).",
        "The paper's ranges are of a real robot; it states no rule for what counts as reached.",
    )
    frame = pd.DataFrame(data)
    frame["episodes"] = frame["episodes"].astype("Int64") if "episodes" in frame else pd.NA
    return Table(f"{protocol}", f"{protocol}: heights reached", header, tuple(rows), notes, frame)


def height_table(protocol: str, method: Evaluated) -> Table:
    """Success with its interval and median error at every height, a pair of columns a variant."""
    parts = [(c, o, dict(by_height(episodes))) for c, o, episodes in variants(method.episodes)]
    heights = sorted({height for _, _, groups in parts for height in groups})
    rows, data = [], []
    for height in heights:
        cells = []
        for condition, orientation, groups in parts:
            if height not in groups:
                cells += [NONE, NONE]
                continue
            episodes = groups[height]
            kept = subset(episodes, stood(episodes))
            rate = stats.wilson(int(series(episodes, "success").sum()), len(episodes), len(method.records))
            error = median(series(kept, "position_error"))
            terminated = len(episodes) - len(kept)
            cells += [
                f"{rate.point * 100:.0f} [{rate.low * 100:.0f}, {rate.high * 100:.0f}]",
                number_text(error * CM, 1) + (f" ({terminated})" if terminated else ""),
            ]
            data.append(
                {
                    **{"controller": method.spec, "condition": condition, "orientation": orientation},
                    **{
                        "height_cm": height * CM,
                        "stratum": "+".join(strata_of(episodes)),
                        "episodes": len(episodes),
                    },
                    **{
                        "terminated": terminated,
                        "success_rate": rate.point,
                        "low": rate.low,
                        "high": rate.high,
                    },
                    "reached": reached(episodes),
                    "median_position_error_cm": error * CM,
                    "median_ee_speed_rms_cm_s": median(series(kept, "ee_speed_rms")) * CM,
                    "median_ee_sparc": median(series(kept, "ee_sparc")),
                }
            )
        rows.append((f"{height * CM:.0f}", *cells))
    labels = [f"{c}, {o}: {what}" for c, o, _ in parts for what in ("success (%) [95 %]", "median pos. (cm)")]
    sizes = sorted({len(episodes) for _, _, groups in parts for episodes in groups.values()})
    notes = (
        f"{' or '.join(map(str, sizes))} episodes a height and variant. Success with its Wilson interval; "
        "median position error over the final 1 s of episodes that did not terminate (in brackets: how many "
        "did).",
    )
    name, title = f"{protocol}_heights_{folder_name(method.spec)}", f"{protocol}: {method.spec} by height"
    return Table(name, title, ("Height (cm)", *labels), tuple(rows), notes, pd.DataFrame(data))


# --- what the command line calls ------------------------------------------------------------------------


def _write(tables: Sequence[Table], out_dir: Path | str) -> list[Path]:
    return [path for table in tables if table.rows for path in table.write(Path(out_dir))]


def write_study(store: StoreLike, study: Study, out_dir: Path | str) -> list[Path]:
    """The study's five tables (four without a pair to compare), into `out_dir` itself (<results>/tables)."""
    tables = [paper_table(store, study), paper_table(store, study, terminated=True)]
    tables += [outcome_table(store, study), stratum_table(store, study), pair_table(store, study)]
    return _write(tables, out_dir)


def write_reach(store: StoreLike, protocol: str, out_dir: Path | str) -> list[Path]:
    """The summary over controllers and one table of heights a controller."""
    methods = collect(store, protocol).values()
    return _write([reach_table(store, protocol), *(height_table(protocol, m) for m in methods)], out_dir)


def write_compare(store: StoreLike, protocol: str, a: str, b: str, out_dir: Path | str) -> list[Path]:
    """Two controllers on the same episodes; `compare_table(...).rich()` is the same for a terminal."""
    return _write([compare_table(store, protocol, a, b)], out_dir)
