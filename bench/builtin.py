"""The commands of `bench`; light to import."""

from .specs import CommandSpec

DEMO = CommandSpec(
    name="demo",
    group="compare",
    summary="Run a complete comparison on a synthetic capture: render it, train, measure, print the table.",
    settings="headbench.bench.comparison:DemoSettings",
    function="headbench.bench.comparison:demo",
)

RUN = CommandSpec(
    name="run",
    group="compare",
    summary="Train methods on a capture, render, measure, and write tables and pictures.",
    settings="headbench.bench.comparison:RunSettings",
    function="headbench.bench.comparison:run",
)

STATUS = CommandSpec(
    name="status",
    group="compare",
    summary="Show which cells of a run are waiting, running, done or failed, and the time left.",
    settings="headbench.bench.executors.command:StatusSettings",
    function="headbench.bench.executors.command:status",
)

SPEED = CommandSpec(
    name="speed",
    group="compare",
    summary="Measure the speed of a finished run's avatars again, without training, and update its tables and report.",
    settings="headbench.bench.executors.command:SpeedSettings",
    function="headbench.bench.executors.command:speed",
)

EVALUATE = CommandSpec(
    name="evaluate",
    group="compare",
    summary="Score a folder of images or a stored avatar, so that a method can be compared without a plug-in.",
    settings="headbench.bench.audit.settings:EvaluateSettings",
    function="headbench.bench.audit.evaluate:evaluate_folder",
)

FRAMES = CommandSpec(
    name="frames",
    group="compare",
    summary="List the frames that `evaluate` needs as CSV: file names, cameras and pose files.",
    settings="headbench.bench.audit.settings:FramesSettings",
    function="headbench.bench.audit.frames:write_frames",
    writes="out",
)

VERIFY = CommandSpec(
    name="verify",
    group="validate",
    summary="Recompute a run's digests and metrics from its frames: exit code 1 if anything differs, 3 if it is not a run.",
    settings="headbench.bench.audit.settings:VerifySettings",
    function="headbench.bench.audit.verify:verify_run",
)

BUNDLE = CommandSpec(
    name="bundle",
    group="export",
    summary="Write the results of a finished run to one file, for a leaderboard and for `headbench verify`.",
    settings="headbench.bench.audit.settings:BundleSettings",
    function="headbench.bench.audit.bundle:write_bundle",
)

GATE = CommandSpec(
    name="gate",
    group="validate",
    summary="Compare a run with a committed baseline: exit code 1 if a number got worse, 3 if one is missing.",
    settings="headbench.bench.gate.settings:GateSettings",
    function="headbench.bench.gate.command:gate",
)

CHECK_PLUGIN = CommandSpec(
    name="check-plugin",
    group="validate",
    summary="Check a method, reader or metric against its contract and list every violation; exit code 1 if there are any.",
    settings="headbench.bench.conformance.command:CheckPluginSettings",
    function="headbench.bench.conformance.command:check_plugin",
)

DOCTOR = CommandSpec(
    name="doctor",
    group="validate",
    summary="Report for every method, metric and reader what is missing on this machine, and how to install it.",
    settings="headbench.bench.doctor:DoctorSettings",
    function="headbench.bench.doctor:doctor",
)

LIST = CommandSpec(
    name="list",
    group="inspect",
    summary="List what is installed: methods, presets, metrics, their profiles, readers, reports, benchmarks, commands.",
    settings="headbench.bench.listing:ListSettings",
    function="headbench.bench.listing:list_installed",
)

BENCH = CommandSpec(
    name="bench",
    group="validate",
    summary="Benchmark a part of headbench itself on this machine.",
    settings="headbench.bench.benchmarks:BenchSettings",
    function="headbench.bench.benchmarks:bench",
)

STRESS = CommandSpec(
    name="stress",
    group="validate",
    summary="Test a part of headbench at numerical extremes and print the result of each case.",
    settings="headbench.bench.benchmarks:StressSettings",
    function="headbench.bench.benchmarks:stress",
)
