"""The gallery of a report: of each controller the worst episodes of each outcome, each with its replay."""

import html
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from wbc_bench.files import folder_name
from wbc_bench.installed import is_installed
from wbc_bench.outcomes import TERMINATED, Outcome, SuccessRule
from wbc_bench.results.analysis import (
    Evaluated,
    FloatArray,
    column,
    subset,
)
from wbc_bench.results.formatting import CM, DEG, number_text, window_text

Told = Callable[[int, int], str]  # replicate, episode -> what disturbed it
SHOWN = 10  # episodes an outcome
REPLAYED = (
    " Run a command in the folder of this report; the page it writes is linked here by the next "
    "`wbc-bench report`."
)


def order_text(rule: SuccessRule) -> str:
    """Which episodes are shown, in words."""
    return (
        f"At most {SHOWN} episodes of each outcome, the worst first. Of episodes that terminated, the worst "
        f"ended first; of the others, it has the largest error over the {window_text(rule)}: the position's "
        f"in units of {rule.position * CM:g} cm or the orientation's in units of "
        f"{rule.orientation * DEG:g}°, whichever is more. Equals come in the order of replicate and episode."
    )


def badness(episodes: pd.DataFrame, outcome: Outcome, rule: SuccessRule) -> FloatArray:
    """How bad each episode of one outcome is, (N,), see `order_text`; an undefined error is the worst."""
    if outcome in TERMINATED:
        return -np.nan_to_num(column(episodes, "duration"), nan=0.0)  # NaN: ended before its first step
    position = column(episodes, "position_error") / rule.position
    orientation = column(episodes, "orientation_error") / rule.orientation
    return np.nan_to_num(np.maximum(position, orientation), nan=np.inf)


def worst(episodes: pd.DataFrame, outcome: Outcome, rule: SuccessRule, count: int = SHOWN) -> pd.DataFrame:
    """The worst episodes of an outcome, worst first."""
    chosen = subset(episodes, np.asarray(episodes["outcome"] == str(outcome), dtype=bool))
    order = np.lexsort((chosen["episode"], chosen["replicate"], -badness(chosen, outcome, rule)))
    return chosen.take(order[:count])


def replay_path(protocol: str, controller: str, replicate: int, episode: int) -> str:
    """Where the replay of an episode stands beside a report."""
    return f"replays/{_run(protocol, controller, replicate)}/{episode}.html"


def replay_command(
    protocol: str, controller: str, replicate: int, episode: int, records: str = ".", resolved: str = ""
) -> str:
    """What writes it, in the folder of the report, from which `records` leads to that of the records.

    `resolved` is the spec that met the replicate, where a run stands under another name than that.
    """
    run = _run(protocol, controller, replicate)
    page = replay_path(protocol, controller, replicate, episode)
    spec = resolved or controller
    shipped = is_installed(controller) and spec.startswith(controller)
    code = "" if shipped else f" --controller {shlex.quote(spec)}"
    return f"wbc-bench replay {run} --episode {episode} --results {shlex.quote(records)} -o {page}{code}"


def gallery_html(
    protocol: str,
    method: Evaluated,
    beside: Path,
    records: str = ".",
    told: Told | None = None,
) -> str:
    """One table, folded away: a group of rows per outcome.

    A replay that stands in `beside` is a link; `records` leads from there to the folder of the records.
    `told` says what disturbed an episode; None where it is not known.
    """
    episodes = method.episodes
    kinds = [name for name in ("condition", "orientation") if any(episodes[name])]
    texts = ("Outcome", "Replicate", "Episode", "Stratum", *(name.capitalize() for name in kinds))
    numbers = ("Target x (m)", "y (m)", "Height (m)", "Position error (cm)", "Orientation error (deg)")
    outcomes = np.asarray(episodes["outcome"], dtype=str)
    resolved = {record.replicate: record.resolved_controller or "" for record in method.records}
    rows = []
    for outcome in (*(each for each in Outcome if each != Outcome.SUCCESS), Outcome.SUCCESS):
        for k, row in enumerate(worst(episodes, outcome, method.rule).to_dict("records")):
            where = (protocol, method.spec, int(row["replicate"]), int(row["episode"]))
            count = int((outcomes == str(outcome)).sum())
            name = f"{str(outcome).replace('_', ' ')} ({count})" if k == 0 else ""
            cells = (
                name,
                str(where[2]),
                str(where[3]),
                str(row["stratum"]),
                *(str(row[kind]) for kind in kinds),
            )
            values = (
                *(number_text(row[key], 2) for key in ("target_x", "target_y", "height")),
                number_text(row["position_error"] * CM, 1),
                number_text(row["orientation_error"] * DEG, 1),
                number_text(row["duration"], 2),
            )
            text = "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
            text += "".join(f'<td class="number">{value}</td>' for value in values)
            if told is not None:
                text += f'<td class="drawn">{html.escape(told(*where[2:]))}</td>'
            text += f"<td>{_replay(where, beside, records, resolved[where[2]])}</td>"
            rows.append(f'<tr class="group">{text}</tr>' if k == 0 else f"<tr>{text}</tr>")
    head = "".join(f"<th>{name}</th>" for name in texts)
    head += (
        "".join(f'<th class="number">{name}</th>' for name in (*numbers, "Ended at (s)"))
        + ("<th>Disturbances</th>" if told is not None else "")
        + "<th>Replay</th>"
    )
    return (
        f"<details><summary>Worst episodes of {html.escape(method.name)}</summary>\n"
        f'<div class="table gallery"><table><thead><tr>{head}</tr></thead>\n<tbody>'
        + "\n".join(rows)
        + "</tbody></table></div></details>\n"
    )


def _replay(where: tuple[str, str, int, int], beside: Path, records: str, resolved: str) -> str:
    path = replay_path(*where)
    if (beside / path).is_file():
        return f'<a href="{html.escape(path)}">watch</a>'
    return f"<code>{html.escape(replay_command(*where, records, resolved))}</code>"


def _run(protocol: str, controller: str, replicate: int) -> str:
    """A run as `wbc-bench replay` takes it."""
    return f"{folder_name(protocol)}/{folder_name(controller)}/replicate_{replicate}"
