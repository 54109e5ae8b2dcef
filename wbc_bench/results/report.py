"""report.html: every table and figure of a results folder and where each run came from, in one file.

Self-contained: style and figures are inside, nothing is loaded; links to replays beside it are all that leads
out. The same folder gives the same bytes.
"""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from wbc_bench.errors import StoreError
from wbc_bench.outcomes import SuccessRule
from wbc_bench.readers import read_bytes, read_json, read_text
from wbc_bench.results import gallery
from wbc_bench.results.analysis import Evaluated, rule_of
from wbc_bench.results.formatting import window_text
from wbc_bench.results.stress import Stress
from wbc_bench.results.table import code_html, read_markdown
from wbc_bench.results.tables.sealed import SUFFIX as SEALED_TABLE

CSS = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; color: #1c1c1c;
  background: #fff; max-width: 1200px; margin: 0 auto; padding: 24px 28px 64px; }
h1 { font-size: 26px; margin: 0 0 4px; }
h2 { font-size: 20px; margin: 44px 0 8px; padding-bottom: 4px; border-bottom: 2px solid #0072b2; }
p.lead, p.rule, nav { color: #555; }
p.rule { font-size: 12.5px; max-width: 960px; margin: 24px 0 0; }
a { color: #0072b2; text-decoration: none; }
nav a { margin-right: 16px; }
/* shadows tell that a table goes on: many browsers hide a scroll bar that is not in use */
.table { overflow-x: auto; scrollbar-width: thin;
  background: linear-gradient(90deg, #fff 30%, #fff0) 0 0 / 40px 100% no-repeat local,
    linear-gradient(270deg, #fff 30%, #fff0) 100% 0 / 40px 100% no-repeat local,
    linear-gradient(90deg, #0003, #0000) 0 0 / 12px 100% no-repeat scroll,
    linear-gradient(270deg, #0003, #0000) 100% 0 / 12px 100% no-repeat scroll; }
table { border-collapse: collapse; font-size: 12px; border-top: 1.5px solid #1c1c1c;
  border-bottom: 1.5px solid #1c1c1c; font-variant-numeric: tabular-nums; }
th { text-align: left; max-width: 130px; vertical-align: bottom;
  border-bottom: 1px solid #1c1c1c; font-weight: 600; }
th, td { padding: 3px 7px; }
td { white-space: nowrap; }
td:first-child { font-weight: 600; white-space: normal; }
.provenance td { white-space: normal; }
.number { text-align: right; }
tr.group td { border-top: 1px solid #c9c9c9; }
tbody tr:hover { background: #f3f7fa; }
ul { font-size: 12.5px; color: #555; margin: 8px 0 0; padding-left: 18px; max-width: 960px; }
code { font: 12px ui-monospace, "DejaVu Sans Mono", monospace; }
figure { margin: 20px 0; }
figure img { max-width: 100%; height: auto; }
figcaption { font-size: 12.5px; color: #555; max-width: 960px; }
details { margin: 20px 0 0; }
summary { cursor: pointer; font-weight: 600; margin: 0 0 6px; }
.gallery td:last-child { white-space: normal; min-width: 430px; line-height: 1.25; }
.gallery td.drawn { white-space: normal; min-width: 260px; line-height: 1.25; }
.gallery code { font-size: 10.5px; color: #555; user-select: all; }
.tag { color: #b34a00; font-weight: 600; }
"""


# What is not made of records, stands beside the report and is shown in it or linked from it.
GIVEN = ("figures/strip_*", "figures/latent_*", "figures/learning_curves*", "replays/**/*")
GIVEN_SECTIONS = (
    ("strip_", "Successive frames"),
    ("latent_", "Latent spaces"),
    ("learning_curves", "Learning curves"),
)
CAPTIONS = {  # end of a figure's name -> what it shows; {window} is that of the success rule
    "_success": "Success by stratum of the targets.",
    "_outcomes": "How the episodes ended.",
    "_errors": "Share of all episodes that stood with an error up to x, in the {window}.",
    "_workspace": "Targets, and where they are reached: success over bins of target positions, "
    "projected on the vertical plane and on the ground. Faint bins hold few episodes, blank ones none.",
    "_targets": "Targets of the protocol by stratum, from the side and from above.",
    "_ladders": "Success as one disturbance at a time grows, with Wilson intervals, and the closest curve "
    "that never rises; a cross is where half of the base's success is lost, the base stands on the left.",
    "tracking": "Error of the hand over time while its target moves.",
}
LADDERS_ONLY = "All runs are of ladders: the notes of their tables of margins say where they come from."
REACH_CAPTION = (
    "Straight ahead over height: success, the range reached, and in the {window} the position error and "
    "how the hand oscillates, as speed and as smoothness (spectral arc length, 0 is smoothest)."
)


def figure_html(path: Path, caption: str) -> str:
    """An image as an `<img>` with its bytes inside; separate images, so that ids of two SVGs cannot meet."""
    kind = {".svg": "svg+xml", ".png": "png"}[path.suffix]
    data = base64.b64encode(read_bytes(path, "figure", StoreError)).decode("ascii")
    return (
        f'<figure><img alt="{html.escape(path.stem)}" src="data:image/{kind};base64,{data}">'
        f"<figcaption>{html.escape(caption)} <code>{html.escape(path.stem)}</code></figcaption></figure>\n"
    )


def given_caption(figure: Path) -> str:
    """What stands in `<name>.txt`, or as `caption` in `<name>.json`, beside a figure; "" without either.

    Raises: StoreError, a sidecar that cannot be read.
    """
    text, facts = figure.with_suffix(".txt"), figure.with_suffix(".json")
    if text.exists():
        return read_text(text, f"caption of '{figure.name}'", StoreError).strip()
    if facts.exists():
        return read_json(facts, _Sidecar, f"caption of '{figure.name}'", StoreError).caption
    return ""


class _Sidecar(msgspec.Struct):
    """A figure's .json; whatever else is in it is for others."""

    caption: str


def provenance_html(records: list[Any]) -> str:
    """One row per run, and under it the machines and versions that occur, each once."""
    header = ("Protocol", "Controller", "Replicate", "Completed", "Protocol digest", "Manifest sha256")
    header += ("Checkpoint", "Commit", "Created (UTC)", "Wall time (s)", "Workers", "Setup")
    setups: dict[tuple[str, str], str] = {}
    rows = []
    for record in records:
        key = (_pairs(record.machine), _pairs(record.versions))
        setup = setups.setdefault(key, chr(ord("A") + len(setups)))
        dirty = ' <span class="tag">+ uncommitted changes</span>' if record.git_dirty else ""
        cells = (
            *(html.escape(record.protocol), f"<code>{html.escape(record.controller)}</code>"),
            *(str(record.replicate), f"{record.completed}/{record.requested}"),
            *(_digest(record.protocol_digest), _digest(record.manifest_sha256)),
            *(
                _digest(record.checkpoint_sha256),
                _digest(record.git_commit) + dirty,
                html.escape(record.created.removesuffix("+00:00").replace("T", " ")),  # breaks at the space
            ),
            *(f"{record.wall_time_s:.1f}", str(record.workers), setup),
        )
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    head = "".join(f"<th>{name}</th>" for name in header)
    table = f'<div class="table provenance"><table><thead><tr>{head}</tr></thead>\n<tbody>' + "\n".join(rows)
    details = "".join(
        f"<li><b>Setup {name}</b>: {machine}<br>{versions}</li>\n"
        for (machine, versions), name in setups.items()
    )
    return f"{table}</tbody></table></div>\n<ul>{details}</ul>\n"


def _digest(value: str | None) -> str:
    """The first twelve digits; the whole on hovering."""
    return f'<code title="{html.escape(value)}">{html.escape(value[:12])}</code>' if value else "–"


def _pairs(values: dict[str, Any]) -> str:
    return html.escape(", ".join(f"{key} {values[key]}" for key in sorted(values)))


def write(
    evaluated: Mapping[str, Mapping[str, Evaluated]],
    results_dir: Path | str,
    beside: Path | str | None = None,
    studies: Mapping[str, str] | None = None,
    ladders: Sequence[Stress] = (),
    records_at: str = ".",
    told: Mapping[str, gallery.Told] | None = None,
) -> Path:
    """Writes `<results_dir>/report.html` from its tables/*.md, its figures and the runs (`collect_all`).

    Replays and figures that are not made of records are looked for in `beside`, the folder where the report
    will stand; `results_dir` when not given. `studies` maps the name of a study to its protocol; `ladders`
    are severity ladders, whose tables and figures form a section each; `records_at` leads from the report's
    folder to that of the records; `told` says for a protocol what disturbed its episodes.

    Raises: StoreError, runs that must not be mixed, or a figure's caption that cannot be read.
    """
    root = Path(results_dir)
    beside = root if beside is None else Path(beside)
    tables = sorted((root / "tables").glob("*.md"))
    figures = [stem for stem in _stems(root / "figures") if not _is_given(stem)]
    given = [stem for stem in _stems(beside / "figures") if _is_given(stem)]
    records = [
        record for methods in evaluated.values() for method in methods.values() for record in method.records
    ]
    # A section per protocol: its files begin with its name or a study's; the longest such name owns a file.
    protocols = list(evaluated)
    parts_of_report = [*protocols, *(stress.ladder.name for stress in ladders), "tracking", "doors"]
    section_of = {name: of for name, of in (studies or {}).items() if of in protocols}
    section_of |= {name: name for name in parts_of_report}

    def owner(stem: str) -> str:
        names = (name for name in section_of if stem == name or stem.startswith(f"{name}_"))
        return section_of.get(max(names, key=len, default=""), "")

    sections = []
    for protocol in [*parts_of_report, ""]:
        rule = rule_of(evaluated.get(protocol, {}))
        own = sorted((path for path in tables if owner(path.stem) == protocol), key=_order)
        shown = [read_markdown(path).html() for path in own]
        stems = (stem for stem in figures if owner(stem) == protocol)
        images = [figure_html(_figure(root, stem), _caption(stem, rule)) for stem in stems]
        parts = [*shown[:1], *images, *shown[1:]]  # what most readers came for, first
        if protocol in protocols:
            parts.append(f'<p class="rule">{code_html(gallery.order_text(rule) + gallery.REPLAYED)}</p>\n')
            methods = evaluated[protocol].values()
            said = (told or {}).get(protocol)
            parts += [gallery.gallery_html(protocol, method, beside, records_at, said) for method in methods]
        if parts:
            sections.append((protocol or "More", "".join(parts)))
    for prefix, title in GIVEN_SECTIONS:
        own = [_figure(beside, stem) for stem in given if stem.startswith(prefix)]
        if own:
            sections.append((title, "".join(figure_html(path, given_caption(path)) for path in own)))
    climbed = [record for stress in ladders for climb in stress.climbs for record in climb.records]
    origin = f"<p>{LADDERS_ONLY if climbed else 'No run yet.'}</p>"
    sections.append(("Where the numbers come from", provenance_html(records) if records else origin))
    links = "".join(f'<a href="#s{k}">{html.escape(name)}</a>' for k, (name, _) in enumerate(sections))
    body = "".join(
        f'<h2 id="s{k}">{html.escape(name)}</h2>\n{part}' for k, (name, part) in enumerate(sections)
    )
    controllers = len({record.controller for record in (*records, *climbed)})
    episodes = sum(record.completed for record in (*records, *climbed))
    lead = f"{episodes} episodes, {controllers} controllers, {len(protocols)} protocols"
    path = root / "report.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>wbc-bench report</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{CSS}</style></head>\n<body><h1>wbc-bench report</h1>\n"
        f'<p class="lead">{lead}. Every controller meets exactly the same episodes.</p>\n'
        f"<nav>{links}</nav>\n{body}</body></html>\n",
        encoding="utf-8",
        newline="\n",
    )
    return path


def _order(path: Path) -> tuple[int, str]:
    """The main table of a protocol first, then from the general to the particular."""
    suffixes = ("_all", "_outcomes", "_strata", "_pairs", "_motion", SEALED_TABLE)
    known = [k for k, suffix in enumerate(suffixes, 1) if path.stem.endswith(suffix)]
    particular = "_vs_" in path.stem or "_heights_" in path.stem
    return known[0] if known else len(suffixes) + 1 if particular else 0, path.stem


def _stems(folder: Path) -> list[str]:
    """Names of the figures in a folder."""
    return sorted({path.stem for path in folder.glob("*") if path.suffix in (".svg", ".png")})


def _is_given(stem: str) -> bool:
    return any(stem.startswith(prefix) for prefix, _ in GIVEN_SECTIONS)


def _caption(stem: str, rule: SuccessRule) -> str:
    found = [caption for end, caption in CAPTIONS.items() if stem.endswith(end)]
    return (found[0] if found else REACH_CAPTION).format(window=window_text(rule))


def _figure(root: Path, stem: str) -> Path:
    """The SVG where there is one."""
    svg = root / "figures" / f"{stem}.svg"
    return svg if svg.exists() else svg.with_suffix(".png")
