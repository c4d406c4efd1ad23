r"""The table as LaTeX for ``\input``: booktabs rules, nothing but text and macros the author can restyle."""

from __future__ import annotations

import re
import unicodedata
from itertools import groupby

from .tables import Table, TableCell

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


def to_latex(table: Table, label: str = "tab:headbench") -> str:
    r"""Write a ``table*`` environment.

    It needs the package booktabs. The macros ``\best`` and ``\second`` are provided only if the author has not
    defined them before; redefine them to restyle every table at once. The protocol stands in a comment, too.
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
        names.append(f"{escape(column.label)}{unit} {escape(column.arrow)}")
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
            r"\providecommand{\best}[1]{\textbf{#1}}",
            r"\providecommand{\second}[1]{\underline{#1}}",
            r"\begin{table*}[t]",
            r"\centering",
            rf"\caption{{{escape(table.caption)}}}",
            rf"\label{{{re.sub(r'[^A-Za-z0-9:.-]', '-', label)}}}",
            rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
            r"\toprule",
            " & ".join(heads) + r" \\",
            " ".join(rules),
            " & ".join(names) + r" \\",
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
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
    if cell.rank == 1:
        text = rf"\best{{{text}}}"
    elif cell.rank == 2:
        text = rf"\second{{{text}}}"
    return text if cell.note is None else rf"{text}\textsuperscript{{{cell.note + 1}}}"


def _comment(text: str) -> str:
    return "% " + " ".join(text.split())
