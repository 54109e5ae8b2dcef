"""Paired differences between two controllers on the episodes that both met."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from wbc_bench.errors import UnknownNameError
from wbc_bench.files import folder_name
from wbc_bench.results import stats
from wbc_bench.results.analysis import (
    Evaluated,
    strata_of,
    subset,
)
from wbc_bench.results.analysis import column as series
from wbc_bench.results.formatting import (
    CM,
    DEG,
    interval_text,
    p_value_text,
)
from wbc_bench.results.study import Study, methods_of
from wbc_bench.results.table import Table

BOOTSTRAP_SEED = 0


def _compare_rows(pairs: Sequence[tuple[str, Evaluated, Evaluated, str | None]]) -> list[dict[str, Any]]:
    """One dict a comparison (name, a, b, stratum); p-values adjusted over the tests of all of them."""
    results, tests = [], []
    for name, a, b, stratum in pairs:
        both = pd.merge(
            a.episodes.assign(not_terminated=a.not_terminated),
            b.episodes.assign(not_terminated=b.not_terminated),
            on=["replicate", "episode"],
            suffixes=("_a", "_b"),
            validate="one_to_one",
        )
        if stratum is not None:
            both = subset(both, np.asarray(both["stratum_a"] == stratum))
        seeds = len(np.unique(series(both, "replicate")))
        neither = subset(both, np.asarray(both["not_terminated_a"] & both["not_terminated_b"], dtype=bool))
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


def pair_table(study: Study, evaluated: Mapping[str, Evaluated]) -> Table:
    """The study's pairs of methods on the episodes both of them met."""
    labels = {method.spec: label for label, method in methods_of(study, evaluated)}
    specs = list(labels)
    pairs = study.pairs or [(a, b) for k, a in enumerate(specs) for b in specs[k + 1 :]]
    known = [
        (f"{labels[a]} vs {labels[b]}", evaluated[a], evaluated[b], None)
        for a, b in pairs
        if a in evaluated and b in evaluated
    ]
    title = f"{study.name}: pairs of methods on the same episodes"
    return _compare_table(f"{study.name}_pairs", title, "A vs B", _compare_rows(known))


def compare_table(protocol: str, evaluated: Mapping[str, Evaluated], a: str, b: str) -> Table:
    """Two controllers on the same episodes, by stratum and together.

    Raises: UnknownNameError for a controller without a run under the protocol.
    """
    for spec in (a, b):
        if spec not in evaluated:
            raise UnknownNameError("evaluated controller", spec, evaluated, f"runs of {protocol}")
    one, two = evaluated[a], evaluated[b]
    rows = [(s, one, two, None if s == "all" else s) for s in (*strata_of(one.episodes), "all")]
    name = f"{protocol}_{folder_name(a)}_vs_{folder_name(b)}"
    title = f"{protocol}: A = {a} against B = {b}"
    return _compare_table(name, title, "Stratum", _compare_rows(rows))
