"""Commands of the harness that are offered through the registry as those of the rooms. Light to import."""

from .specs import CommandSpec

GATE = CommandSpec(
    name="gate",
    summary="Hold a run against a committed baseline: exit code 1 where a number got worse, 3 where one is missing.",
    implementation="headbench.bench.gate.command:run",
    settings="headbench.bench.gate.settings:GateSettings",
)
