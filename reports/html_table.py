"""The table as one HTML page that needs nothing else: no script, no font, no network."""

from __future__ import annotations

from html import escape
from itertools import groupby

from .table_model import Column, Table, TableCell

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; }
div.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.7rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead tr:first-child th { border-top: 2px solid; text-align: center; }
thead tr:last-child th { border-bottom: 1px solid; font-weight: 600; }
tbody tr.group th { border-top: 1px solid; font-style: italic; font-weight: 400; }
tbody:last-child tr:last-child td { border-bottom: 2px solid; }
td.first { background: #ff999980; font-weight: 700; }
td.second { background: #ffcc9980; text-decoration: underline; }
td.third { background: #ffff9980; font-style: italic; }
.published { color: GrayText; font-style: italic; }
.unit { font-weight: 400; }
p, ol { max-width: 60rem; }
"""
RANKS = {1: "first", 2: "second", 3: "third"}


def to_html(table: Table) -> str:
    """Write a page. Values in full precision stand in tooltips; first, second and third are classes of cells."""
    spans = [(title, len(list(members))) for title, members in groupby(table.columns, key=lambda c: c.title)]
    heads = "".join(f'<th scope="colgroup" colspan="{count}">{escape(title)}</th>' for title, count in spans)
    names = "".join(map(_head, table.columns))
    body = []
    for title, rows in table.groups:
        body.append("<tbody>")
        if len(table.groups) > 1:
            body.append(f'<tr class="group"><th colspan="{len(table.columns) + 1}">{escape(title)}</th></tr>')
        for row in rows:
            body.append(f"<tr><td>{escape(row.method)}</td>{''.join(map(_cell, row.cells))}</tr>")
        body.append("</tbody>")
    notes = "".join(f'<li id="note-{i + 1}">{escape(note)}</li>' for i, note in enumerate(table.notes))
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            "<title>headbench</title>",
            f"<style>{STYLE}</style>",
            "</head>",
            "<body>",
            '<div class="wide"><table>',
            f"<thead><tr><th></th>{heads}</tr>",
            f'<tr><th scope="col">Method</th>{names}</tr></thead>',
            *body,
            "</table></div>",
            f"<p>{escape(table.caption)}</p>",
            *([f"<ol>{notes}</ol>"] if notes else []),
            "</body>",
            "</html>",
            "",
        ]
    )


def _head(column: Column) -> str:
    if column.published:
        return '<th scope="col" class="published">published</th>'
    unit = f' <span class="unit">({escape(column.unit)})</span>' if column.unit else ""
    return f'<th scope="col">{escape(column.label)}{unit} {column.arrow}</th>'


def _cell(cell: TableCell) -> str:
    kind = "published" if cell.status == "published" else RANKS.get(cell.rank or 0, "")
    attributes = f' class="{kind}"' if kind else ""
    attributes += f' title="{cell.value!r}"' if cell.value is not None and kind != "published" else ""
    note = "" if cell.note is None else f'<sup><a href="#note-{cell.note + 1}">{cell.note + 1}</a></sup>'
    return f"<td{attributes}>{escape(cell.shown)}{note}</td>"
