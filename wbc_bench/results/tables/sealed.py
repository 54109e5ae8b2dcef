"""Success on public and on sealed episodes of one protocol, side by side."""

from collections.abc import Mapping

import pandas as pd

from wbc_bench.files import SEALED
from wbc_bench.results import stats
from wbc_bench.results.analysis import Evaluated, column, rule_of
from wbc_bench.results.formatting import interval_text, names_note
from wbc_bench.results.table import Table

SUFFIX = "_public_and_sealed"  # of the table's name: `<protocol>_sealed` is the main table of the sealed runs


def sealed_table(protocol: str, public: Mapping[str, Evaluated], sealed: Mapping[str, Evaluated]) -> Table:
    """Success of every controller with runs of both sets, and the difference.

    Args:
        protocol: Name of the public protocol.
        public: Spec -> runs under it.
        sealed: Spec -> runs under its sealed set; with another rule of success there are no rows.
    """
    rows, data, changed = [], [], []
    both = [spec for spec in public if spec in sealed] if rule_of(public) == rule_of(sealed) else []
    for spec in both:
        one, two = public[spec], sealed[spec]
        rates = [_success(one), _success(two)]
        difference = stats.newcombe(*rates)
        before, after = _versions(one), _versions(two)
        if any(before[resolved] != after[resolved] for resolved in before.keys() & after.keys()):
            changed.append(spec)
        rows.append(
            (
                one.name + (" ‡" if spec in changed else ""),
                *(one.counts, interval_text(rates[0], 100.0, 1)),
                *(two.counts, interval_text(rates[1], 100.0, 1)),
                interval_text(difference, 100.0, 1, "+"),
            )
        )
        flat = {"controller": spec, "same_files": spec not in changed}
        for name, method, rate in (("public", one, rates[0]), ("sealed", two, rates[1])):
            flat |= {f"{name}_completed": method.completed, f"{name}_requested": method.requested}
            flat |= {name: rate.point, f"{name}_low": rate.low, f"{name}_high": rate.high}
        flat |= {"difference": difference.point, "low": difference.low, "high": difference.high}
        data.append(flat)
    header = (
        *("Method", "Public episodes", "Public success ↑ (%) [95 %]"),
        *("Sealed episodes", "Sealed success ↑ (%) [95 %]", "Public − sealed (pp) [95 %]"),
    )
    notes = [
        f"Sealed: runs of `{protocol}{SEALED}`, another draw of the same distribution. An interval of the "
        "difference above 0 suggests that a controller was fitted to the public episodes.",
        "Intervals over episodes, replicates pooled: Wilson for success, Newcombe's method 10 for the "
        "difference of two independent proportions. They cover the draw of episodes, not the training seed "
        "of a learned method.",
        *names_note({spec: public[spec].name for spec in both}),
    ]
    if changed:
        files = ", ".join(f"`{spec}`" for spec in changed)
        notes.append(f"‡ evaluated with different code or files of the controller: {files}.")
    title = f"{protocol}: success on public and on sealed episodes"
    return Table(protocol + SUFFIX, title, header, tuple(rows), tuple(notes), pd.DataFrame(data))


def _success(method: Evaluated) -> stats.Estimate:
    successes = int(column(method.episodes, "success").sum())
    return stats.wilson(successes, method.completed, len(method.records))


def _versions(method: Evaluated) -> dict[str, str]:
    """Controller as resolved -> digest of its code and files; records before 0.1.0 do not tell."""
    return {
        record.resolved_controller: record.controller_sha256
        for record in method.records
        if record.resolved_controller and record.controller_sha256
    }
