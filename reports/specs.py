"""The reports offered, and benchmarks; light to import."""

from __future__ import annotations

from ..bench.specs import BenchmarkSpec, ReportSpec

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

CURVE = ReportSpec(
    name="curve",
    summary="Quality over what trainings were given, as a table, CSV and a plot.",
    implementation="headbench.reports.curve.curve:curve_report",
    writes=False,
)

PARETO = ReportSpec(
    name="pareto",
    summary="Quality over size and frame time with the Pareto front, as a table, CSV and a plot.",
    implementation="headbench.reports.pareto.command:pareto",
    writes=False,
)

SUITE = ReportSpec(
    name="suite",
    summary="Results of the suite by region and sequence, with differences from a method and ablations.",
    implementation="headbench.reports.suite.suite:suite_report",
    writes=False,
)

ROBUSTNESS = ReportSpec(
    name="robustness",
    summary="Contact sheet and summary of avatars rendered beyond a run, from what extremes and reenact left.",
    implementation="headbench.reports.robustness.sheets:robustness_report",
    writes=False,
)

STATISTICS = BenchmarkSpec(
    name="statistics",
    summary="tests and intervals on simulated comparisons: do they reject and cover as often as stated?",
    stress="headbench.reports.statistics.calibration:stress",
)

VIEWER = BenchmarkSpec(
    name="viewer",
    summary="the viewer in a browser: updates a second while a slider moves, milliseconds by step",
    speed="headbench.reports.view.benchmark:speed",
)
