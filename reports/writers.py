"""Writers of a table: plain text, Markdown, LaTeX, HTML, CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..bench import terminal
from ..bench.io.provenance import tool
from ..bench.io.style import SHAPES, escape_markdown, stylesheet
from .tables import METHODS_TITLE, TITLES, Table, TableCell, compact

if TYPE_CHECKING:
    from jinja2 import Environment

HERE = Path(__file__).parent
MARKDOWN_RANKS = {1: ("**", "**"), 2: ("<ins>", "</ins>"), 3: ("*", "*")}


def to_markdown(table: Table) -> str:
    """Write a pipe table, aligned to be readable as plain text. Header: tasks, first body row: metrics.

    First bold, second underlined (``<ins>``), third italic.
    """
    tasks, names = [""], ["**Method**"]
    for title, count in _spans(table):
        tasks += [escape_markdown(title), *[""] * (count - 1)]
    for column in table.columns:
        unit = f" ({escape_markdown(column.unit)})" if column.unit else ""
        names.append(f"**{escape_markdown(column.label)}**{unit} {column.arrow}")
    lines = [tasks, names]
    for title, rows in table.groups:
        if table.titled:
            lines.append([f"*{escape_markdown(title)}*", *[""] * len(table.columns)])
        lines += [[escape_markdown(row.method), *map(_markdown_cell, row.cells)] for row in rows]
    widths = [max(3, *(len(line[i]) for line in lines)) for i in range(len(names))]
    body = [[line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])] for line in lines]
    rule = [":" + "-" * (widths[0] - 1), *("-" * (width - 1) + ":" for width in widths[1:])]
    text = pipe_table([body[0], rule, *body[1:]])
    notes = [f"<sup>{i}</sup> {escape_markdown(note)}  " for i, note in enumerate(table.notes, 1)]
    return "\n\n".join([text, escape_markdown(table.caption), *(["\n".join(notes)] if notes else [])]) + "\n"


def pipe_table(lines: Iterable[Sequence[str]]) -> str:
    """Lines of cells, the second with the rules, as a pipe table."""
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _markdown_cell(cell: TableCell) -> str:
    before, after = MARKDOWN_RANKS.get(cell.rank or 0, ("", ""))
    text = f"{before}{escape_markdown(cell.shown)}{after}"
    return text if cell.note is None else f"{text}<sup>{cell.note + 1}</sup>"


def to_text(table: Table, *, details: bool = False, fit: bool = False) -> str:
    """Write one aligned table for each task and one for the avatar, fitted to the terminal with ``fit``.

    Only the best values are marked. With ``details``, the text below states protocols and how values were averaged.
    """
    sizes = {task.title: f" ({task.size})" for task in table.tasks}
    warnings = "\n".join(map(terminal.wrapped, table.warnings) if fit else table.warnings)
    blocks = [warnings] if warnings else []
    for title in dict.fromkeys(column.title for column in table.columns):
        chosen = [i for i, column in enumerate(table.columns) if column.title == title]
        columns = [table.columns[i] for i in chosen]
        heads = [f"{c.label}{f' ({c.unit})' if c.unit else ''} {c.arrow}" for c in columns]
        lines: list[list[str]] = []
        for group, rows in table.groups:
            lines += [[group]] if table.titled and group != METHODS_TITLE else []
            lines += [[row.method, *(_text_cell(row.cells[i]) for i in chosen)] for row in rows]
        blocks.append(terminal.table(["Method", *heads], lines, title=title + sizes.get(title, ""), fit=fit))
    notes = [f"[{i}] {note}" for i, note in enumerate(table.notes, 1)]
    below = [*table.sentences(table.starred, details=details), *notes]
    return "\n\n".join([*blocks, "\n".join(map(terminal.wrapped, below) if fit else below)]) + "\n"


def _text_cell(cell: TableCell) -> str:
    return cell.shown + " *" * (cell.rank == 1) + ("" if cell.note is None else f" [{cell.note + 1}]")


LATEX_ESCAPES = {
    **{c: f"\\{c}" for c in "{}$&#%_"},
    "\\": r"\textbackslash{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "[": "{[}",
    "]": "{]}",
    "*": "{*}",  # after the end of a row it would be the star of that command
    "`": "{`}",  # a question mark before it would be inverted
    "–": "--",
    "—": "---",
    "…": r"\dots{}",
    "×": r"$\times$",
    "±": r"$\pm$",
    "µ": r"$\mu$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "→": r"$\rightarrow$",
}
LATEX_MACROS = {
    "tabfirst": r"\textbf{#1}",
    "tabsecond": r"\underline{#1}",
    "tabthird": r"\textit{#1}",
    "tabspread": r"{\scriptsize\,$\pm$\,#1}",
    "tabpublished": r"\textsf{#1}",
}
LATEX_RANKS = {1: "tabfirst", 2: "tabsecond", 3: "tabthird"}
LATEX_PAGE = r"""% Needs the packages booktabs and graphicx, and a file read as UTF-8, which LaTeX does since 2018.
% For coloured cells load colortbl and, before this file:
% \newcommand{\tabfirst}[1]{\cellcolor[rgb]{1,0.6,0.6}#1}, likewise \tabsecond and \tabthird.
MACROS
\begin{table*}[t]
\centeringNARROW
\caption{CAPTION}
\label{LABEL}
\sbox{0}{\begin{tabular}{COLUMNS}
\toprule
HEAD
\midrule
BODY
\bottomrule
\end{tabular}}
\ifdim\wd0>\linewidth\resizebox{\linewidth}{!}{\usebox{0}}\else\usebox{0}\fi\parNOTES
\end{table*}
"""
NARROW = 8
"""Maximum number of columns with the default column separation."""


def to_latex(table: Table) -> str:
    r"""Write a ``table*`` environment for ``\input``, with booktabs rules and a caption as papers print it.

    It needs the packages booktabs and graphicx; a table wider than the page is scaled to fit it. The macros
    ``\tabfirst``, ``\tabsecond``, ``\tabthird``, ``\tabspread`` and ``\tabpublished`` are provided only if the author
    has not defined them before; define them to restyle every table at once. Comments before it state the protocol,
    the frames and how values were averaged. The label is ``tab:headbench-`` and the layout's name.
    """
    heads, rules, start = [""], [], 2
    for title, count in _spans(table):
        heads.append(rf"\multicolumn{{{count}}}{{c}}{{{escape_latex(title)}}}")
        rules.append(rf"\cmidrule(lr){{{start}-{start + count - 1}}}")
        start += count
    names = ["Method"]
    for column in table.columns:
        unit = rf"\,({escape_latex(column.unit)})" if column.unit else ""
        names.append(f"{escape_latex(column.label)}{unit} {escape_latex(column.arrow)}")
    body: list[str] = []
    for index, (title, rows) in enumerate(table.groups):
        body += [r"\midrule"] if index else []
        if table.titled:
            body.append(rf"\multicolumn{{{len(names)}}}{{l}}{{\emph{{{escape_latex(title)}}}}} \\")
        lines = ([escape_latex(row.method), *map(_latex_cell, row.cells)] for row in rows)
        body += [" & ".join(line) + r" \\" for line in lines]
    notes = [rf"\par\textsuperscript{{{i}}}~{escape_latex(note)}" for i, note in enumerate(table.notes, 1)]
    if notes:
        notes = ["", r"\begin{minipage}{\linewidth}", r"\footnotesize", *notes, r"\end{minipage}"]
    parts = {
        "MACROS": "\n".join(rf"\providecommand{{\{name}}}[1]{{{x}}}" for name, x in LATEX_MACROS.items()),
        "NARROW": "\n" + r"\setlength{\tabcolsep}{3pt}" if len(table.columns) > NARROW else "",
        "CAPTION": escape_latex(table.short_caption),
        "LABEL": re.sub(r"[^A-Za-z0-9:.-]", "-", f"tab:headbench-{table.name or 'table'}"),
        "COLUMNS": "l" + "r" * len(table.columns),
        "HEAD": "\n".join([" & ".join(heads) + r" \\", " ".join(rules), " & ".join(names) + r" \\"]),
        "BODY": "\n".join(body),
        "NOTES": "\n".join(notes),
    }
    page = re.sub("|".join(parts), lambda match: parts[match[0]], LATEX_PAGE)
    comments = (f"A table of headbench{f', layout {table.name}' if table.name else ''}.", *table.facts)
    return "".join(f"% {' '.join(text.split())}\n" for text in comments) + page


def escape_latex(text: str) -> str:
    """Escape text for LaTeX, on one line; characters that pdfLaTeX's fonts lack become code points."""

    def escaped(match: re.Match[str]) -> str:
        matched = match[0]
        if len(matched) > 1:  # hyphens, which would become a dash
            return "{}".join(matched)
        printable = " " <= matched <= "~" or (
            "À" <= matched <= "ÿ" and matched.isalpha() and matched not in "ÐÞðþ"
        )
        return LATEX_ESCAPES.get(matched, matched if printable else rf"\texttt{{U+{ord(matched):04X}}}")

    return re.sub("--+|.", escaped, unicodedata.normalize("NFC", " ".join(text.split())))


def _latex_cell(cell: TableCell) -> str:
    text = escape_latex(cell.text)
    macro = "tabpublished" if cell.status == "published" else LATEX_RANKS.get(cell.rank or 0)
    text = rf"\{macro}{{{text}}}" if macro else text
    text += rf"\tabspread{{{escape_latex(cell.spread)}}}" if cell.spread else ""
    return text if cell.note is None else rf"{text}\textsuperscript{{{cell.note + 1}}}"


def to_html(table: Table) -> str:
    """Write one page that needs no network, the best rows first; columns can be sorted. Tooltips have values in full precision."""
    heading = " and ".join(task.title.lower() if i else task.title for i, task in enumerate(table.tasks))
    return render_page("table.html", table=table, heading=heading or TITLES.get(table.name, "Comparison"))


def render_page(template: str, **content: Any) -> str:
    """Fill an HTML template of this package, with the shared style as ``look``; text is escaped."""
    shared = {
        "look": stylesheet(),
        "shapes": SHAPES,
        "sort": (HERE / "sort.js").read_text("utf-8"),
        "tool": tool(),
    }
    ranks = {1: "first", 2: "second", 3: "third"}
    page = _templates().get_template(template)
    return page.render(**shared | content, spans=_spans, ranks=ranks, compact=compact)


@cache
def _templates() -> Environment:
    """The templates, compiled on first use."""
    from jinja2 import Environment, FileSystemLoader

    folders = [HERE, HERE / "page"]
    return Environment(autoescape=True, keep_trailing_newline=True, loader=FileSystemLoader(folders))


def to_csv(table: Table) -> str:
    """Write one line per method, in full precision.

    Columns: method, version, group; per column of the table the value (``novel_view/psnr``, empty where there is
    none), its rank (``.../rank``), its status (``.../status``) and, with several seeds, its standard deviation from
    seed to seed as displayed (``.../spread``); notes; protocol.
    """
    header = ["method", "version", "group"]
    extras = ["rank", "status", *(["spread"] if table.seeds > 1 else [])]
    for column in table.columns:
        name = column.name
        header += [name, *(f"{name}/{extra}" for extra in extras)]
    lines: list[list[object]] = [[*header, "notes", "protocol"]]
    protocol = " ".join(f"{task.task}={task.protocol_hash}" for task in table.tasks)
    for title, rows in table.groups:
        for row in rows:
            line: list[object] = [row.method, row.version, title]
            for cell in row.cells:
                line.append("" if cell.value is None else repr(cell.value))
                line += [str(cell.rank or ""), cell.status, cell.spread][: len(extras)]
            notes = sorted({cell.note for cell in row.cells if cell.note is not None})
            lines.append([*line, " ".join(table.notes[note] for note in notes), protocol])
    return csv_text(lines)


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Write lines as CSV, None as an empty cell."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()


def to_json(table: Table) -> str:
    """Write the typed table unchanged."""
    return json.dumps({**asdict(table), "caption": table.caption}, indent=1, ensure_ascii=False) + "\n"


WRITERS: dict[str, tuple[str, Callable[[Table], str]]] = {
    "md": ("md", to_markdown),
    "csv": ("csv", to_csv),
    "latex": ("tex", to_latex),
    "html": ("html", to_html),
    "json": ("json", to_json),
}
"""File suffix and writer by name of the format."""


def _spans(table: Table) -> list[tuple[str, int]]:
    """Titles over the columns, each with the number of columns that it spans."""
    return [(title, len(list(members))) for title, members in groupby(table.columns, key=lambda c: c.title)]
