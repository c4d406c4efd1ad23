"""Commands of this room. Light to import: implementations are named, not loaded."""

from ..bench.specs import CommandSpec

EXTREMES = CommandSpec(
    name="extremes",
    summary="Try a run's avatars on views and expressions beyond those of training: limits held or not, contact sheet.",
    implementation="headbench.reports.robustness.extremes_command:run",
    settings="headbench.reports.robustness.settings:ExtremesSettings",
)

REENACT = CommandSpec(
    name="reenact",
    summary="Drive a run's avatars with another subject's expressions: limits held or not, frames, contact sheet.",
    implementation="headbench.reports.robustness.reenact_command:run",
    settings="headbench.reports.robustness.settings:ReenactSettings",
)

SWEEP = CommandSpec(
    name="sweep",
    summary="Derive smaller and faster avatars from a run's without training: quality against size and frame time.",
    implementation="headbench.reports.pareto.sweep_command:run",
    settings="headbench.reports.pareto.settings:SweepSettings",
)

PARETO = CommandSpec(
    name="pareto",
    summary="Quality against size and frame time over finished runs: CSV, and a plot with the Pareto front marked.",
    implementation="headbench.reports.pareto.command:run",
    settings="headbench.reports.pareto.settings:ParetoSettings",
    writes="out",
)

COMPARE = CommandSpec(
    name="compare",
    summary="Paired differences between methods of finished runs: interval, exact test over subjects, Holm's correction.",
    implementation="headbench.reports.comparison.command:run",
    settings="headbench.reports.comparison.settings:CompareSettings",
)
