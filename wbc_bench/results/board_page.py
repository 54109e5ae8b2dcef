"""The page of a board: who submitted what, how it was checked, rows by success, and the worst episodes."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from wbc_bench.files import folder_name
from wbc_bench.outcomes import Outcome
from wbc_bench.results import stats
from wbc_bench.results.analysis import Evaluated, column, rule_of
from wbc_bench.results.formatting import NONE, interval_text
from wbc_bench.results.gallery import gallery_html, order_text, replay_path, worst
from wbc_bench.results.report import CSS, figure_html
from wbc_bench.results.submission import Submission
from wbc_bench.results.table import Table, code_html

FIGURES = {"_success": "Success by stratum of the targets.", "_outcomes": "How the episodes ended."}
REPLAYED = (
    " Run a command in the folder of this page; `wbc-bench report --results .` then links what it writes in "
    "the "
    "report."
)
STYLE = """
pre { overflow-x: auto; font-size: 12px; }
p.rule code { overflow-wrap: anywhere; }
"""
LINKED = 3  # worst episodes that a row leads to


class Again(NamedTuple):
    """What came of running a sample of a submission's episodes again."""

    tried: int = 0
    equal: int = 0  # to the last bit
    missing: int = 0  # runs whose controller or episodes are not at hand


def submission_table(submissions: Sequence[Submission], again: Mapping[str, Again]) -> Table:
    """One row per submission: its file, its controller, and how it was checked."""
    rows, data = [], []
    for one in submissions:
        card, tried = one.manifest.card, again[one.name]
        checked = NONE
        if tried.tried:
            checked = f"{tried.equal} of {tried.tried} episodes equal"
        elif tried.missing:
            checked = "not at hand"
        digests = ", ".join(f"`{digest[:12]}`" for digest in sorted(set(card.digests.values())))
        what = ", ".join([*card.signals, *(f"commands {part}" for part in card.commands)]) or "nothing"
        rows.append(
            (
                one.name,
                f"`{card.controller}`",
                digests,
                what,
                str(len(one.runs)),
                f"`{one.sha256[:12]}`",
                checked,
            )
        )
        data.append(
            {"submission": one.name, "sha256": one.sha256, "controller": card.controller}
            | {"runs": len(one.runs), "rerun": tried.tried, "rerun_equal": tried.equal}
        )
    header = ("Submission", "Controller", "Digest", "Reads", "Runs", "File sha256", "Run again")
    notes = (
        "Of every submission, the file, records and episodes agree with their hashes, and the episodes are "
        "those "
        "of the protocols' manifests. This finds damage and mixed files, not a writer who makes them all "
        "anew.",
        "Run again: episodes chosen by the hash of their run, compared to the last bit. On another "
        "processor or "
        "with other packages the bits may differ. Only controllers that are installed or that were named "
        "for the "
        "board are run; code of a submission is not.",
    )
    return Table("submissions", "Submissions", header, tuple(rows), notes, pd.DataFrame(data))


def worst_of_all(method: Evaluated, count: int) -> list[tuple[int, int]]:
    """(replicate, episode) of the worst failures: outcomes in their order, in each the worst first."""
    failed = [outcome for outcome in Outcome if outcome != Outcome.SUCCESS]
    chosen = [worst(method.episodes, outcome, method.rule, count) for outcome in failed]
    found = pd.concat(chosen)[:count]
    return [(int(r), int(e)) for r, e in zip(found["replicate"], found["episode"], strict=True)]


def board_html(
    table: Table,
    submissions: Sequence[Submission],
    evaluated: Mapping[str, Mapping[str, Evaluated]],
    sizes: Mapping[str, int | None],
    root: Path,
) -> str:
    """The page; it loads nothing and runs no script.

    Args:
        table: See `submission_table`.
        submissions: In the order of the table.
        evaluated: Protocol -> name of a submission -> its runs.
        sizes: Protocol -> episodes that it has, where that is known.
        root: The folder of the page, with figures and replays.
    """
    parts = [table.html()]
    for one in submissions:
        if one.card:
            parts.append(
                f"<details><summary>Card of {html.escape(one.name)}</summary>\n"
                f"<pre>{html.escape(one.card)}</pre></details>\n"
            )
    sections = [("Submissions", "".join(parts))]
    for protocol, methods in evaluated.items():
        parts = [_leaders(protocol, methods, sizes.get(protocol), root)]
        digests = next(
            one.manifest.protocols[protocol] for one in submissions if protocol in one.manifest.protocols
        )
        kind = "sealed manifest" if digests.sealed else "manifest"
        parts.append(
            f'<p class="rule">Protocol digest <code>{digests.protocol_digest}</code>, {kind} sha256 '
            f"<code>{digests.manifest_sha256}</code>.</p>\n"
        )
        for end, caption in FIGURES.items():
            figure = root / "figures" / f"{protocol}{end}.svg"
            if figure.is_file():
                parts.append(figure_html(figure, caption))
        parts.append(f'<p class="rule">{code_html(order_text(rule_of(methods)) + REPLAYED)}</p>\n')
        for name, method in methods.items():
            place = f'</summary><span id="{_anchor(protocol, name)}"></span>'  # a link there unfolds the list
            parts.append(gallery_html(protocol, method, root).replace("</summary>", place, 1))
        sections.append((protocol, "".join(parts)))
    links = "".join(f'<a href="#s{k}">{html.escape(name)}</a>' for k, (name, _) in enumerate(sections))
    body = "".join(
        f'<h2 id="s{k}">{html.escape(name)}</h2>\n{part}' for k, (name, part) in enumerate(sections)
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>wbc-bench board</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{CSS}{STYLE}</style></head>\n"
        "<body><h1>wbc-bench board</h1>\n"
        f'<p class="lead">{len(submissions)} submissions. Every controller meets exactly the same episodes. '
        f"All "
        'tables, paired tests and figures: <a href="report.html">report</a>.</p>\n'
        f"<nav>{links}</nav>\n{body}</body></html>\n"
    )


def _leaders(protocol: str, methods: Mapping[str, Evaluated], size: int | None, root: Path) -> str:
    """The rows of a protocol, the highest success first."""
    rates = {name: _success(method) for name, method in methods.items()}
    rows = []
    for name in sorted(methods, key=lambda name: (-rates[name].point, name)):
        method = methods[name]
        of = f" of {size}" if size else ""
        terminated = 100.0 * (1.0 - method.not_terminated.mean())
        cells = (
            f"<td>{html.escape(name)}</td>",
            f'<td class="number">{method.completed}{of}</td>',
            f'<td class="number">{interval_text(rates[name], 100.0, 1)}</td>',
            f'<td class="number">{terminated:.1f}</td>',
            f"<td>{_worst_links(protocol, method, root)}</td>",
        )
        rows.append(f'<tr class="group">{"".join(cells)}</tr>')
    head = '<th>Submission</th><th class="number">Episodes</th><th class="number">Success (%) [95 %]</th>'
    head += '<th class="number">Terminated (%)</th><th>Worst episodes (replicate/episode)</th>'
    return (
        f'<div class="table"><table><thead><tr>{head}</tr></thead>\n<tbody>'
        + "\n".join(rows)
        + ("</tbody></table></div>\n")
    )


def _worst_links(protocol: str, method: Evaluated, root: Path) -> str:
    """Links to replays where there are, otherwise to the row's list with the commands that write them."""
    links = []
    for replicate, episode in worst_of_all(method, LINKED):
        path = replay_path(protocol, method.spec, replicate, episode)
        href = path if (root / path).is_file() else f"#{_anchor(protocol, method.spec)}"
        links.append(f'<a href="{html.escape(href)}">{replicate}/{episode}</a>')
    return ", ".join(links) or NONE


def _anchor(protocol: str, name: str) -> str:
    return f"worst-{folder_name(protocol)}-{folder_name(name)}"


def _success(method: Evaluated) -> stats.Estimate:
    return stats.wilson(int(column(method.episodes, "success").sum()), method.completed, len(method.records))
