"""The heights that a controller reaches straight ahead."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from wbc_bench.files import folder_name
from wbc_bench.results import stats
from wbc_bench.results.analysis import (
    END_ZONE,
    Evaluated,
    HeightRange,
    by_height,
    median,
    not_terminated,
    oscillation,
    reach_range,
    reached,
    rule_of,
    strata_of,
    subset,
    variants,
)
from wbc_bench.results.analysis import column as series
from wbc_bench.results.formatting import (
    CM,
    NONE,
    names_note,
    number_text,
    tolerance_text,
    window_text,
)
from wbc_bench.results.study import Study
from wbc_bench.results.table import Table


def _range(span: HeightRange) -> str:
    return "none" if np.isnan(span.low) else f"{span.low * CM:.0f}–{span.high * CM:.0f}"


def reach_table(study: Study, evaluated: Mapping[str, Evaluated]) -> Table:
    """Lowest and highest height of each controller and variant, and how much it sways near them."""
    rows, data = [], []
    rule = rule_of(evaluated)
    paper = study.paper
    for name, (low, high) in (paper.ranges_cm if paper else {}).items():
        place = paper.place if paper else ""
        rows.append((f"{name}, paper ({place})", *[NONE] * 4, f"{low:g}–{high:g}", *[NONE] * 3))
        data.append({"controller": name, "source": "paper", "low_cm": low, "high_cm": high})
    for spec, method in evaluated.items():
        for k, (condition, orientation, episodes) in enumerate(variants(method.episodes)):
            span, strict = reach_range(episodes, rule), reach_range(episodes, rule, strict=True)
            speed = oscillation(episodes, span, "ee_speed_rms")
            sparc = oscillation(episodes, span, "ee_sparc")
            total = f"{len(episodes)}" if k else f"{len(episodes)} (run: {method.counts})"
            rows.append(
                (
                    *(method.name if k == 0 else "", condition, orientation, total),
                    *(_range(strict), _range(span), f"{span.reached}/{len(by_height(episodes))}"),
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
        *("Controller", "Dynamics", "Gripper", "Episodes", "Succeeded (cm)", "Reached (cm)"),
        *("Heights reached", "EE speed RMS (cm/s) low / mid / high", "SPARC low / mid / high"),
    )
    notes = (
        "Succeeded: the longest run of neighbouring heights at which more than half of the episodes are "
        f"inside {tolerance_text(rule)} at every step of the {window_text(rule)}. Reached: the same with a "
        f"median position error over that window below {rule.position * CM:g} cm, a terminated episode "
        "counting as infinitely far.",
        f"Oscillation in the {window_text(rule)}, median over episodes that did not terminate: within "
        f"{END_ZONE * CM:.0f} cm of the low end of the range reached, between, within as much of the high "
        "end. SPARC is the spectral arc length of the end-effector's speed (0 is smoothest).",
        *(paper.notes if paper else ()),
        *names_note({spec: method.name for spec, method in evaluated.items()}),
    )
    frame = pd.DataFrame(data)
    frame["episodes"] = frame["episodes"].astype("Int64") if "episodes" in frame else pd.NA
    return Table(study.name, f"{study.name}: heights reached", header, tuple(rows), notes, frame)


def height_table(study: Study, method: Evaluated) -> Table:
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
            kept = subset(episodes, not_terminated(episodes))
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
                    "reached": reached(episodes, method.rule),
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
        f"median position error over the {window_text(method.rule)} of episodes that did not terminate "
        "(in brackets: how many did).",
    )
    name, title = f"{study.name}_heights_{folder_name(method.spec)}", f"{study.name}: {method.name} by height"
    return Table(name, title, ("Height (cm)", *labels), tuple(rows), notes, pd.DataFrame(data))
