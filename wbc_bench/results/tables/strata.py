"""Success, outcomes and the paper's columns by stratum of the targets."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from wbc_bench.outcomes import Outcome
from wbc_bench.results import stats
from wbc_bench.results.analysis import (
    Evaluated,
    Mask,
    strata_of,
)
from wbc_bench.results.formatting import (
    interval_text,
    spread_text,
)
from wbc_bench.results.study import Study, methods_of
from wbc_bench.results.table import Table
from wbc_bench.results.tables.paper import COLUMNS, _flat, columns_over_replicates, defined


def _groups(method: Evaluated) -> list[tuple[str, Mask]]:
    """(stratum or "all", mask) of a method."""
    stratum = np.asarray(method.episodes["stratum"], dtype=str)
    return [*((s, stratum == s) for s in strata_of(method.episodes)), ("all", stratum == stratum)]


def outcome_table(study: Study, evaluated: Mapping[str, Evaluated]) -> Table:
    """Success by stratum with its interval, and how the rest ended; the counts of a row add up."""
    rows, data = [], []
    for label, method in methods_of(study, evaluated):
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
    title = f"{study.name}: success and outcomes by stratum"
    return Table(f"{study.name}_outcomes", title, header, tuple(rows), notes, pd.DataFrame(data))


def stratum_table(study: Study, evaluated: Mapping[str, Evaluated]) -> Table:
    """The paper's columns by stratum, over episodes that did not terminate and over all."""
    rows, data = [], []
    for label, method in methods_of(study, evaluated):
        for k, (stratum, mask) in enumerate(_groups(method)[:-1]):
            for terminated in (False, True):
                over = method.not_terminated | terminated
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
    title = f"{study.name}: the paper's columns by stratum"
    return Table(f"{study.name}_strata", title, header, tuple(rows), notes, pd.DataFrame(data))
