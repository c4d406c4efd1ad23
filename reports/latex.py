r"""The table as LaTeX for ``\input``: booktabs rules, nothing but text and macros the author can restyle."""

from __future__ import annotations

import re
import unicodedata
from itertools import groupby

from .table_model import Table, TableCell

ESCAPES = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "[": "{[}",
    "]": "{]}",
    "–": "--",
    "—": "---",
    "…": r"\dots{}",
    "×": r"$\times$",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "→": r"$\rightarrow$",
    "µ": r"$\mu$",
}

MACROS = {
    "tabfirst": r"\textbf{#1}",
    "tabsecond": r"\underline{#1}",
    "tabthird": r"\textit{#1}",
    "tabspread": r"{\scriptsize\,$\pm$\,#1}",
    "tabpublished": r"\textsf{#1}",
}
RANK_MACROS = {1: "tabfirst", 2: "tabsecond", 3: "tabthird"}
NARROW = 8
"""Columns up to which a table keeps the distance between them."""


def to_latex(table: Table, label: str = "tab:headbench") -> str:
    r"""Write a ``table*`` environment.

    It needs the packages booktabs and graphicx; a table wider than the page is scaled to fit it. The macros
    ``\tabfirst``, ``\tabsecond``, ``\tabthird``, ``\tabspread`` and ``\tabpublished`` are provided only if the author
    has not defined them before; define them to restyle every table at once. The protocol stands in a comment, too.
    """
    columns = table.columns
    width = len(columns) + 1
    spans = [(title, len(list(members))) for title, members in groupby(columns, key=lambda c: c.title)]
    heads, rules, start = [""], [], 2
    for title, count in spans:
        heads.append(rf"\multicolumn{{{count}}}{{c}}{{{escape(title)}}}")
        rules.append(rf"\cmidrule(lr){{{start}-{start + count - 1}}}")
        start += count
    names = ["Method"]
    for column in columns:
        unit = rf"\,({escape(column.unit)})" if column.unit else ""
        measured = f"{escape(column.label)}{unit} {escape(column.arrow)}"
        names.append(r"\tabpublished{\scriptsize published}" if column.published else measured)
    body: list[str] = []
    for index, (title, rows) in enumerate(table.groups):
        body += [r"\midrule"] if index else []
        if len(table.groups) > 1:
            body.append(rf"\multicolumn{{{width}}}{{l}}{{\emph{{{escape(title)}}}}} \\")
        body += [" & ".join([escape(row.method), *map(_cell, row.cells)]) + r" \\" for row in rows]
    notes = [rf"\par\textsuperscript{{{i + 1}}}~{escape(note)}" for i, note in enumerate(table.notes)]
    return "\n".join(
        [
            *(_comment(f"{t.title}: protocol {t.protocol_id} {t.protocol_hash}") for t in table.tasks),
            "% For coloured cells load colortbl and, before this file:",
            r"% \newcommand{\tabfirst}[1]{\cellcolor[rgb]{1,0.6,0.6}#1}, likewise \tabsecond and \tabthird.",
            *(rf"\providecommand{{\{name}}}[1]{{{style}}}" for name, style in MACROS.items()),
            r"\begin{table*}[t]",
            r"\centering",
            *([r"\setlength{\tabcolsep}{3pt}"] if len(columns) > NARROW else []),
            rf"\caption{{{escape(table.caption)}}}",
            rf"\label{{{re.sub(r'[^A-Za-z0-9:.-]', '-', label)}}}",
            rf"\sbox{{0}}{{\begin{{tabular}}{{l{'r' * len(columns)}}}",
            r"\toprule",
            " & ".join(heads) + r" \\",
            " ".join(rules),
            " & ".join(names) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}}",
            r"\ifdim\wd0>\linewidth\resizebox{\linewidth}{!}{\usebox{0}}\else\usebox{0}\fi\par",
            *(
                [r"\begin{minipage}{\linewidth}", r"\footnotesize", *notes, r"\end{minipage}"]
                if notes
                else []
            ),
            r"\end{table*}",
            "",
        ]
    )


def escape(text: str) -> str:
    """Make text stand for itself, on one line.

    What the default fonts and inputs of pdfLaTeX do not know (anything beyond Latin letters with accents) is
    written as its code point rather than left to break the author's paper.
    """
    return "".join(_escaped(character) for character in unicodedata.normalize("NFC", " ".join(text.split())))


def _escaped(character: str) -> str:
    if character in ESCAPES:
        return ESCAPES[character]
    if 32 <= ord(character) < 127 or (192 <= ord(character) < 256 and character.isalpha()):
        return character
    return rf"\texttt{{U+{ord(character):04X}}}"


def _cell(cell: TableCell) -> str:
    text = escape(cell.text)
    macro = "tabpublished" if cell.status == "published" else RANK_MACROS.get(cell.rank or 0)
    text = rf"\{macro}{{{text}}}" if macro else text
    text += rf"\tabspread{{{escape(cell.spread)}}}" if cell.spread else ""
    return text if cell.note is None else rf"{text}\textsuperscript{{{cell.note + 1}}}"


def _comment(text: str) -> str:
    return "% " + " ".join(text.split())
