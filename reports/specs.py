"""Specs of reports, without heavy imports."""

from __future__ import annotations

from ..bench.specs import ReportSpec

TABLE = ReportSpec(
    name="table",
    summary="Comparison of all methods over all metrics, as Markdown, CSV and LaTeX files.",
    implementation="headbench.reports.table_report:write_tables",
)

TABLE_TEXT = ReportSpec(
    name="table-text",
    summary="The same comparison as text: Markdown, CSV or LaTeX.",
    implementation="headbench.reports.table_report:table_text",
    writes=False,
)

PAPERS = ReportSpec(
    name="papers",
    summary="Papers whose table layouts are available, with their tables.",
    implementation="headbench.reports.papers:listed",
    writes=False,
)

CITATIONS = ReportSpec(
    name="citations",
    summary="Source, citation and published values of every registered method.",
    implementation="headbench.reports.papers:citations",
    writes=False,
)

CONTACT_SHEET = ReportSpec(
    name="contact-sheet",
    summary="Some frames of each task side by side: ground truth, renders and error maps of all methods, as PNG.",
    implementation="headbench.reports.contact_sheet:write_contact_sheet",
)

PAGE = ReportSpec(
    name="page",
    summary="One HTML file with tables, frames of all methods side by side, curves and the record of the run.",
    implementation="headbench.reports.page.report:write_page",
)
