"""Specs of reports and their commands, without heavy imports."""

from __future__ import annotations

from ..bench.specs import CommandSpec, ReportSpec

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
    implementation="headbench.reports.method_cards:citations",
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
    implementation="headbench.reports.robustness.sheets:robustness_report",
    writes=False,
)

TABLE_COMMAND = CommandSpec(
    name="table",
    group="compare",
    summary="Print a table of finished runs on the same frames, or write it to a file.",
    settings="headbench.reports.table_command:TableSettings",
    function="headbench.reports.table_command:print_table",
)

PROTOCOLS = CommandSpec(
    name="protocols",
    group="compare",
    summary="Show how each choice of an evaluation changes the results: pixels, metrics, cameras, means.",
    settings="headbench.reports.protocols:ProtocolsSettings",
    function="headbench.reports.protocols:protocols_command",
)

COMPARE = CommandSpec(
    name="compare",
    group="compare",
    summary="Test differences between methods, or compare a run with a baseline file (CI).",
    settings="headbench.reports.statistics.command:CompareSettings",
    function="headbench.reports.statistics.command:compare_runs",
)


REPORT_COMMAND = CommandSpec(
    name="report",
    group="inspect",
    summary="Write an HTML report of finished runs; it opens without a network.",
    settings="headbench.reports.page.settings:PageSettings",
    function="headbench.reports.page.report:write_report",
)

CURVES = CommandSpec(
    name="report curve",
    group="inspect",
    summary="Join runs of `headbench run curve`: means over subjects, and the best method for each cost of a training.",
    settings="headbench.reports.curve.settings:CurveReportSettings",
    function="headbench.reports.curve.curve:curve_runs",
    writes="out",
)

PARETO = CommandSpec(
    name="report pareto",
    group="inspect",
    summary="Plot quality against size and frame time of runs, with the Pareto front.",
    settings="headbench.reports.pareto.settings:ParetoSettings",
    function="headbench.reports.pareto.command:pareto_runs",
    writes="out",
)

RENDER = CommandSpec(
    name="render",
    group="inspect",
    summary="Render a stored avatar: frames of a task, or an orbit; as images and video.",
    settings="headbench.reports.render.settings:RenderSettings",
    function="headbench.reports.render.render:render_avatar",
    writes="out",
)

VIEW = CommandSpec(
    name="view",
    group="inspect",
    summary="View avatars in a browser, side by side, with sliders and recorded sequences.",
    settings="headbench.reports.view.settings:ViewSettings",
    function="headbench.reports.view.server:view_avatars",
)
