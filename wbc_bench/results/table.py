"""A table as text: Markdown, LaTeX (booktabs), CSV, HTML, terminal. The same table gives the same bytes."""

import html
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from rich.table import Table as RichTable
from rich.text import Text

from wbc_bench.errors import StoreError
from wbc_bench.readers import read_text

LONG = 30  # rows beyond which a page shows a table on demand only


@dataclass(frozen=True)
class Table:
    """Cells as text, the same numbers as a frame, and what a reader must know to read them."""

    name: str  # of its files
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]  # a blank first cell continues the group above
    notes: tuple[str, ...] = ()
    data: pd.DataFrame = field(default_factory=pd.DataFrame)

    @property
    def numeric(self) -> list[bool]:
        """Columns that hold a number somewhere, and so align right."""
        return [any(_is_number(row[k]) for row in self.rows) for k in range(len(self.header))]

    def markdown(self) -> str:
        def line(cells: Sequence[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"

        rule = ["---:" if number else "---" for number in self.numeric]
        table = [line(self.header), line(rule), *map(line, self.rows)]
        notes = ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join([f"## {self.title}", "", *table, *notes]) + "\n"

    def latex(self) -> str:
        body = []
        for k, row in enumerate(self.rows):
            if k and row[0]:
                body.append(r"\midrule")
            body.append(" & ".join(map(_latex, row)) + r" \\")
        # \resizebox would also stretch a narrow table: its width is the natural one where that fits.
        fit = r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{"
        return "\n".join(
            [
                r"% needs \usepackage{booktabs} and \usepackage{graphicx}",
                r"\begin{table*}[t]",
                r"\centering",
                rf"\caption{{{_latex(self.title)}}}",
                rf"\label{{tab:{self.name}}}",
                r"\footnotesize\setlength{\tabcolsep}{3pt}",
                rf"{fit}\begin{{tabular}}{{{''.join('r' if number else 'l' for number in self.numeric)}}}",
                r"\toprule",
                " & ".join(map(self._latex_header, range(len(self.header)))) + r" \\",
                r"\midrule",
                *body,
                r"\bottomrule",
                r"\end{tabular}}",
                *(rf"\par\smallskip\raggedright {_latex(note)}" for note in self.notes),
                r"\end{table*}",
                "",
            ]
        )

    def _latex_header(self, k: int) -> str:
        """The header of a column, over as many lines as keep it about as narrow as the cells."""
        width = max([8, *(len(row[k]) for row in self.rows)])  # characters; no column is narrower
        lines = textwrap.wrap(self.header[k], width, break_long_words=False) or [""]
        stacked = r" \\ ".join(rf"\textbf{{{_latex(line)}}}" for line in lines)
        return rf"\shortstack[{'r' if self.numeric[k] else 'l'}]{{{stacked}}}"

    def csv(self) -> str:
        # Six digits: the last bits of a mean depend on the vector width of the processor.
        return self.data.to_csv(index=False, float_format="%.6g", lineterminator="\n")

    def html(self) -> str:
        """A `<table>` that folds away under its title, cells escaped; `code` marks as in Markdown."""

        def line(tag: str, cells: Sequence[str], kind: str = "") -> str:
            classes = (' class="number"' if number else "" for number in self.numeric)
            marked = (f"<{tag}{c}>{code_html(cell)}</{tag}>" for c, cell in zip(classes, cells, strict=True))
            return f"<tr{kind}>{''.join(marked)}</tr>"

        body = (line("td", row, ' class="group"' if row[0] else "") for row in self.rows)
        notes = "".join(f"<li>{code_html(note)}</li>" for note in self.notes)
        table = f'<div class="table"><table><thead>{line("th", self.header)}</thead>\n<tbody>'
        table += "\n".join(body) + "</tbody></table></div>\n"
        table += f"<ul>{notes}</ul>\n" if notes else ""
        # folded by the reader; a long one is folded already
        long = len(self.rows) > LONG
        title = code_html(self.title) + (f" ({len(self.rows)} rows)" if long else "")
        return f"<details{'' if long else ' open'}><summary>{title}</summary>\n{table}</details>\n"

    def rich(self) -> Any:
        """For the terminal: split into grids below each other where it is wider than the console."""
        return _Terminal(self)

    def write(self, out_dir: Path) -> list[Path]:
        """Writes `<out_dir>/<name>.md`, .tex and .csv."""
        out_dir.mkdir(parents=True, exist_ok=True)
        paths = []
        for suffix, text in (("md", self.markdown()), ("tex", self.latex()), ("csv", self.csv())):
            path = out_dir / f"{self.name}.{suffix}"
            path.write_text(text, encoding="utf-8", newline="\n")
            paths.append(path)
        return paths


class _Terminal:
    """Draws a table in the width of the console; neither a number nor a name loses a character."""

    def __init__(self, table: Table) -> None:
        self._table = table
        # The first columns name a row, up to the first number; they are repeated in every grid.
        self._names = max(1, next((k for k, number in enumerate(table.numeric) if number), 0))
        cells = [[row[k] for row in table.rows] for k in range(len(table.header))]
        self._widths = [
            max([*map(len, column), *map(len, name.split())])  # a header wraps between words
            for name, column in zip(table.header, cells, strict=True)
        ]

    def __rich_console__(self, console: Any, options: Any) -> Iterator[Any]:
        names, grids = self._layout(options.max_width)
        yield Text(self._table.title, style="italic")
        for columns in grids:
            yield self._grid(names, columns)
        for note in self._table.notes:
            yield Text(note, style="dim")

    def _layout(self, width: int) -> tuple[list[int], list[list[int]]]:
        """Widths of the columns that name a row, and which other columns each grid holds."""
        frame = 3  # characters of padding and border per column, and one more border on the left
        rest = list(range(self._names, len(self._widths)))
        names = self._widths[: self._names]
        if sum(self._widths) + frame * len(self._widths) + 1 <= width:
            return names, [rest]
        # Half of the console at least is for numbers, or every grid would hold a column or two.
        widest = max([width // 2, *(self._widths[k] + frame for k in rest)])
        while sum(names) + frame * len(names) + widest + 1 > width and max(names) > 1:
            names[names.index(max(names))] -= 1  # the longest names go over two lines
        room = width - 1 - sum(names) - frame * len(names)
        grids: list[list[int]] = [[]]
        left = room
        for k in rest:
            if grids[-1] and self._widths[k] + frame > left:
                grids.append([])
                left = room
            grids[-1].append(k)
            left -= self._widths[k] + frame
        return names, grids

    def _grid(self, names: Sequence[int], columns: Sequence[int]) -> Any:
        rows, numeric = self._table.rows, self._table.numeric
        grid = RichTable()
        for k, width in enumerate(names):
            grid.add_column(Text(self._table.header[k]), width=width, overflow="fold")
        for k in columns:
            grid.add_column(
                Text(self._table.header[k]),
                width=self._widths[k],
                justify="right" if numeric[k] else "left",
                overflow="fold",
            )
        for k, row in enumerate(rows):
            cells = [Text(row[c]) for c in (*range(self._names), *columns)]  # "[...]" is no markup
            grid.add_row(*cells, end_section=k + 1 < len(rows) and bool(rows[k + 1][0]))
        return grid


def read_markdown(path: Path) -> Table:
    """The table that `Table.write` wrote as Markdown, without its frame.

    Raises: StoreError when the file cannot be read or has no table.
    """
    lines = read_text(path, "table", StoreError).splitlines()
    cells = [tuple(c.strip() for c in line.strip("|").split("|")) for line in lines if line.startswith("|")]
    if len(cells) < 2 or len({len(row) for row in cells}) > 1:
        raise StoreError(f"table '{path}' is damaged, valid: rows of one length, a header first")
    title = next((line.removeprefix("## ") for line in lines if line.startswith("## ")), path.stem)
    notes = tuple(line.removeprefix("- ") for line in lines if line.startswith("- "))
    return Table(path.stem, title, cells[0], tuple(cells[2:]), notes)


def code_html(text: str) -> str:
    """Text, escaped, with `code` marks as in Markdown."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text, quote=False))


def _is_number(cell: str) -> bool:
    return bool(re.match(r"[+−-]?[\d<]", cell))


LATEX = {
    **{character: "\\" + character for character in "&%_#$"},
    **{
        "±": r"$\pm$",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "Δ": r"$\Delta$",
        "−": "$-$",
        "–": "--",
        "—": "---",
    },
    **{
        "†": r"$^\dagger$",
        "‡": r"$^\ddagger$",
        "≥": r"$\geq$",
        "≤": r"$\leq$",
        "<": "$<$",
        ">": "$>$",
        "×": r"$\times$",
    },
}


def _latex(text: str) -> str:
    text = re.sub(r"`([^`]*)`", lambda m: m[1], text)
    return "".join(LATEX.get(character, character) for character in text)
