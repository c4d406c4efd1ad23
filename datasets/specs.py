"""Specs of readers, synthetic captures and benchmarks. Light to import: implementations are named, not loaded."""

from ..bench.specs import BenchmarkSpec, ConditionSpec, DatasetSpec

ERRORS = "headbench.datasets.lint.catalogue:errors"

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
    truth="headbench.datasets.synthetic.renderer:SyntheticTruth",
    needs="headbench.datasets.synthetic.command:needs",
)

HEAD = BenchmarkSpec(
    name="head",
    summary="the head model: numerical extremes",
    stress="headbench.datasets.head.extremes:stress",
)

TRACKED = ConditionSpec(
    name="tracked",
    summary="Clip: tracking estimated from images, as by `track`; parameters landmarks, embedding, seed.",
    kind="clip",
    implementation="headbench.datasets.tracking.track:with_tracking",
)

RIGID_HEAD = ConditionSpec(
    name="rigid-head",
    summary="Clip: the rotation of the neck moved into the motion of the head, as in trackers without a neck joint.",
    kind="clip",
    implementation="headbench.datasets.steps.rest:as_rigid_head",
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
    implementation="headbench.datasets.steps.rest:with_packed_chart",
)
