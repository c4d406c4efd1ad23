"""Commands of the harness that are offered through the registry as those of the rooms. Light to import."""

from .specs import CommandSpec

GATE = CommandSpec(
    name="gate",
    summary="Hold a run against a committed baseline: exit code 1 where a number got worse, 3 where one is missing.",
    implementation="headbench.bench.gate.command:run",
    settings="headbench.bench.gate.settings:GateSettings",
)

VERIFY = CommandSpec(
    name="verify",
    summary="Recompute a run's hashes and metrics from the frames it left: exit code 1 where anything differs, 3 where it is no finished run.",
    implementation="headbench.bench.audit.verify:run",
    settings="headbench.bench.audit.settings:VerifySettings",
)

EVALUATE = CommandSpec(
    name="evaluate",
    summary="Score a folder of images named by key: a method is compared without a plug-in.",
    implementation="headbench.bench.audit.evaluate:run",
    settings="headbench.bench.audit.settings:EvaluateSettings",
)

CHECK_PLUGIN = CommandSpec(
    name="check-plugin",
    summary="Try a method, a reader or a metric and list every breach of its contract; exit code 1 where there is one.",
    implementation="headbench.bench.conformance.command:run",
    settings="headbench.bench.conformance.settings:CheckPluginSettings",
)
