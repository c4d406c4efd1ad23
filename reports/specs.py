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

CURVE_REPORT = ReportSpec(
    name="curve",
    summary="Quality against training time, cameras, timesteps, images or tracking error, as a table, CSV and a plot.",
    implementation="headbench.reports.curve.curve:curve_report",
    writes=False,
)

PARETO_REPORT = ReportSpec(
    name="pareto",
    summary="Quality over size and frame time with the Pareto front, as a table, CSV and a plot.",
    implementation="headbench.reports.pareto.command:pareto",
    writes=False,
)

SUITE_REPORT = ReportSpec(
    name="suite",
    summary="Results of the suite by region and sequence, with differences from a method, tracking from images and ablations.",
    implementation="headbench.reports.suite.suite:suite_report",
    writes=False,
)

ROBUSTNESS = ReportSpec(
    name="robustness",
    summary="Contact sheet and summary of the output of `run extremes` and `run reenact`.",
    implementation="headbench.reports.contact_sheet:robustness_report",
    writes=False,
)
