"""Commands of this room. Light to import: implementations are named, not loaded."""

from ..bench.specs import CommandSpec

EXPORT_COLMAP = CommandSpec(
    name="export colmap",
    summary="Write frames of a capture as a COLMAP dataset: images, masks and a sparse model.",
    implementation="headbench.datasets.colmap.command:run",
    settings="headbench.datasets.colmap.settings:ExportColmapSettings",
    writes="out",
)

STEPS = CommandSpec(
    name="steps",
    summary="Draw the jaw bases and expression classes that a capture's training frames give, and their numbers.",
    implementation="headbench.datasets.steps.pictures.command:run",
    settings="headbench.datasets.steps.pictures.settings:StepsSettings",
    writes="out",
)

LINT = CommandSpec(
    name="lint",
    summary="Search a capture for faults that make a comparison unfair or wrong; --list explains the codes.",
    implementation="headbench.datasets.lint.command:run",
    settings="headbench.datasets.lint.settings:LintSettings",
)

INSPECT = CommandSpec(
    name="inspect",
    summary="Draw what a capture holds: camera rig, splits, tracked mesh on images, motion by sequence.",
    implementation="headbench.datasets.inspect.command:run",
    settings="headbench.datasets.inspect.settings:InspectSettings",
    writes="out",
)

PREPARE_NERSEMBLE = CommandSpec(
    name="prepare nersemble",
    summary="Turn raw NeRSemble recordings into captures that methods train on; continues after a kill.",
    implementation="headbench.datasets.nersemble.command:run",
    settings="headbench.datasets.nersemble.settings:PrepareSettings",
)

RECORD_NERSEMBLE = CommandSpec(
    name="record nersemble",
    summary="Write a synthetic capture as a raw NeRSemble recording with VHAP's tracking, to try prepare on.",
    implementation="headbench.datasets.nersemble.re_record:run",
    settings="headbench.datasets.nersemble.settings:RecordSettings",
    writes="out",
)

REFIT = CommandSpec(
    name="refit",
    summary="Carry a capture's tracking over to another head model; residuals in millimetres, a heat map.",
    implementation="headbench.datasets.head.refit.command:run",
    settings="headbench.datasets.head.refit.settings:RefitCommandSettings",
    writes="out",
)

TONGUE = CommandSpec(
    name="tongue",
    summary="Find the frames that show the tongue; scores, reasons, your overrides, and a contact sheet to review.",
    implementation="headbench.datasets.steps.tongue.command:run",
    settings="headbench.datasets.steps.tongue.settings:TongueSettings",
    writes="out",
)
