"""Specs of readers, synthetic captures, commands and benchmarks. Light to import: implementations are named, not
loaded."""

from ..bench.specs import BenchmarkSpec, CommandSpec, ConditionSpec, DatasetSpec

ERRORS = "headbench.datasets.lint.before_run:errors"

GA_LAYOUT = DatasetSpec(
    name="ga",
    summary="A capture in the GaussianAvatars/VHAP layout: a UNION folder or a single sequence.",
    implementation="headbench.datasets.ga.reader:read_capture",
    errors=ERRORS,
    find="headbench.datasets.ga.reader:find_captures",
    listing="headbench.datasets.ga.reader:listed_frames",
    pose_files="headbench.datasets.ga.reader:pose_files",
)

COLMAP = DatasetSpec(
    name="colmap",
    summary="A COLMAP dataset with tracked FLAME parameters beside its model, as `export colmap --tracking` writes.",
    implementation="headbench.datasets.colmap.reader:read_dataset",
    errors=ERRORS,
    find="headbench.datasets.colmap.reader:find_datasets",
    pose_files="headbench.datasets.colmap.reader:pose_files",
)

MONOCULAR = DatasetSpec(
    name="monocular",
    summary="A tracked video of one camera, in the layout of INSTA and Metrical Tracker, or of IMavatar and PointAvatar.",
    implementation="headbench.datasets.monocular.reader:read_video",
    errors=ERRORS,
    find="headbench.datasets.monocular.reader:find_videos",
)

SYNTHETIC = DatasetSpec(
    name="synthetic",
    summary="A ray-traced procedural head with exact tracking, written in the same layout.",
    implementation="headbench.datasets.synthetic.capture:synthesize",
    reads=False,
    truth="headbench.datasets.synthetic.truth:SyntheticTruth",
    needs="headbench.datasets.synthetic.needs:needs",
)

HEAD = BenchmarkSpec(
    name="head",
    summary="the head model: numerical extremes",
    stress="headbench.datasets.head.extremes:stress",
)

SYNTH = CommandSpec(
    name="synth",
    group="data",
    summary="Render a synthetic multi-view capture in the GaussianAvatars/VHAP layout.",
    settings="headbench.datasets.synthetic.command:SynthSettings",
    function="headbench.datasets.synthetic.command:synth",
)

PREPARE_NERSEMBLE = CommandSpec(
    name="prepare nersemble",
    group="data",
    summary="Convert raw NeRSemble recordings to captures.",
    settings="headbench.datasets.nersemble.settings:PrepareSettings",
    function="headbench.datasets.nersemble.command:prepare_nersemble",
)

LINT = CommandSpec(
    name="lint",
    group="data",
    summary="Check a capture for faults that make a comparison unfair or wrong.",
    settings="headbench.datasets.lint.settings:LintSettings",
    function="headbench.datasets.lint.command:lint",
)

TONGUE = CommandSpec(
    name="prepare tongue",
    group="data",
    summary="Find the frames that show the tongue, for review on a contact sheet.",
    settings="headbench.datasets.steps.tongue.command:TongueSettings",
    function="headbench.datasets.steps.tongue.command:tongue",
    writes="out",
)

REFIT_COMMAND = CommandSpec(
    name="prepare refit",
    group="data",
    summary="Refit the tracking of a capture to another head model.",
    settings="headbench.datasets.head.refit.settings:RefitCommandSettings",
    function="headbench.datasets.head.refit.command:refit_capture",
    writes="out",
    kinds=("captures",),
)

TRACK = CommandSpec(
    name="track",
    group="data",
    summary="Track the head model of a capture in its images, without using its tracking.",
    settings="headbench.datasets.tracking.settings:TrackSettings",
    function="headbench.datasets.tracking.command:track_capture",
    writes="out",
    kinds=("captures",),
    programs={
        "vhap": "headbench.datasets.tracking.needs:vhap",
        "pixel3dmm": "headbench.datasets.tracking.needs:pixel3dmm",
    },
)

TRACKED = ConditionSpec(
    name="tracked",
    summary="Clip: tracking estimated from images, as by `track`; parameters landmarks, embedding, seed.",
    kind="clip",
    implementation="headbench.datasets.tracked_clip:with_tracking",
)

RIGID_HEAD = ConditionSpec(
    name="rigid-head",
    summary="Clip: the rotation of the neck moved into the motion of the head, as in trackers without a neck joint.",
    kind="clip",
    implementation="headbench.datasets.steps.rigid:as_rigid_head",
)

REST_EXPRESSION = ConditionSpec(
    name="rest-expression",
    summary="Clip: expressions that are not zero at rest, with unchanged meshes; parameters millimetres, seed.",
    kind="clip",
    implementation="headbench.datasets.steps.rest:with_rest_expression",
)

PACKED_CHART = ConditionSpec(
    name="packed-chart",
    summary="Clip: texture coordinates for a head model without any, with a separate area for every triangle.",
    kind="clip",
    implementation="headbench.datasets.steps.charted:with_packed_chart",
)

IMPORT_TRACKING = CommandSpec(
    name="import tracking",
    group="data",
    summary="Make a capture from the files of another tracker and the frames of the video.",
    settings="headbench.datasets.tracker_files.settings:ImportTrackingSettings",
    function="headbench.datasets.tracker_files.command:import_tracking",
    writes="out",
    kinds=("captures",),
)

INSPECT = CommandSpec(
    name="inspect",
    group="inspect",
    summary="Plot a capture: camera rig, splits, tracked mesh over images, motion.",
    settings="headbench.datasets.inspect.command:InspectSettings",
    function="headbench.datasets.inspect.command:inspect",
    writes="out",
)

STEPS = CommandSpec(
    name="inspect steps",
    group="inspect",
    summary="Plot the jaw bases and expression clusters of a capture's training frames.",
    settings="headbench.datasets.steps.pictures.command:StepsSettings",
    function="headbench.datasets.steps.pictures.command:steps",
    writes="out",
)

DRIVE = CommandSpec(
    name="drive",
    group="inspect",
    summary="Drive a stored avatar with any signal: coefficients, blendshapes, FLAME parameters, a capture.",
    settings="headbench.datasets.drive.settings:DriveSettings",
    function="headbench.datasets.drive.command:drive_avatar",
)

EXPORT_COLMAP = CommandSpec(
    name="export colmap",
    group="export",
    summary="Write frames of a capture as a COLMAP dataset: images, masks, sparse model.",
    settings="headbench.datasets.colmap.command:ExportColmapSettings",
    function="headbench.datasets.colmap.command:export_colmap",
    writes="out",
    kinds=("a COLMAP dataset",),
)

SUBMISSION_RENDER = CommandSpec(
    name="submission render",
    group="export",
    summary="Render the test frames of a NeRSemble benchmark participant.",
    settings="headbench.datasets.nersemble.benchmark.settings:SubmissionRenderSettings",
    function="headbench.datasets.nersemble.benchmark.render:render_participant",
    writes="out",
)

SUBMISSION_WRITE = CommandSpec(
    name="submission write",
    group="export",
    summary="Write a submission to the NeRSemble benchmark; exit code 3 without ffmpeg.",
    settings="headbench.datasets.nersemble.benchmark.settings:SubmissionWriteSettings",
    function="headbench.datasets.nersemble.benchmark.command:submission_write",
)

SUBMISSION_CHECK = CommandSpec(
    name="submission check",
    group="export",
    summary="Check a submission to the NeRSemble benchmark as its server does.",
    settings="headbench.datasets.nersemble.benchmark.settings:SubmissionCheckSettings",
    function="headbench.datasets.nersemble.benchmark.command:submission_check",
)
