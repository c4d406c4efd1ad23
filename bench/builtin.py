"""The commands of `bench`; light to import."""

from .specs import CommandSpec

DEMO = CommandSpec(
    name="demo",
    group="compare",
    summary="Compare all methods on a synthetic capture; needs no data, GPU or network.",
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
    summary="Show which cells of a run are waiting, running, done or failed.",
    settings="headbench.bench.executors.command:StatusSettings",
    function="headbench.bench.executors.command:status",
)

EVALUATE = CommandSpec(
    name="evaluate",
    group="compare",
    summary="Score a folder of images or a stored avatar, without a plug-in.",
    settings="headbench.bench.audit.settings:EvaluateSettings",
    function="headbench.bench.audit.evaluate:evaluate_folder",
)

FRAMES = CommandSpec(
    name="frames",
    group="compare",
    summary="List the frames that `evaluate` scores: file names, cameras, pose files.",
    settings="headbench.bench.audit.settings:FramesSettings",
    function="headbench.bench.audit.frames:write_frames",
    writes="out",
)

VERIFY = CommandSpec(
    name="verify",
    group="validate",
    summary="Score a run's stored frames again and report values that differ.",
    settings="headbench.bench.audit.settings:VerifySettings",
    function="headbench.bench.audit.verify:verify_runs",
)

CHECK_PLUGIN = CommandSpec(
    name="doctor check",
    group="validate",
    summary="Check a method, reader or metric against its contract.",
    settings="headbench.bench.conformance.command:CheckPluginSettings",
    function="headbench.bench.conformance.command:check_plugin",
)

DOCTOR = CommandSpec(
    name="doctor",
    group="validate",
    summary="Report what methods, metrics and readers lack here, and how to install it.",
    settings="headbench.bench.doctor:DoctorSettings",
    function="headbench.bench.doctor:doctor",
)

LIST = CommandSpec(
    name="list",
    group="inspect",
    summary="List installed methods, presets, metrics, readers, reports and commands.",
    settings="headbench.bench.listing:ListSettings",
    function="headbench.bench.listing:list_installed",
)

BENCH = CommandSpec(
    name="doctor bench",
    group="validate",
    summary="Benchmark a part of headbench itself on this machine.",
    settings="headbench.bench.benchmarks:BenchSettings",
    function="headbench.bench.benchmarks:bench",
)

STRESS = CommandSpec(
    name="doctor stress",
    group="validate",
    summary="Test a part of headbench at numerical extremes.",
    settings="headbench.bench.benchmarks:StressSettings",
    function="headbench.bench.benchmarks:stress",
)
