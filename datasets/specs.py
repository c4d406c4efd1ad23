"""Captures that headbench reads or makes, and benchmarks. Light to import: implementations are named, not loaded."""

from ..bench.specs import BenchmarkSpec, DatasetSpec

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
    summary="A tracked video of one camera, as INSTA and Metrical Tracker or IMavatar and PointAvatar lay it out.",
    implementation="headbench.datasets.monocular.reader:read_video",
    errors=ERRORS,
    find="headbench.datasets.monocular.reader:find_videos",
)

SYNTHETIC = DatasetSpec(
    name="synthetic",
    summary="A ray-traced procedural head with exact tracking, written in the same layout.",
    implementation="headbench.datasets.synthetic.capture:synthesize",
    reads=False,
    needs="headbench.datasets.synthetic.needs:needs",
)

HEAD = BenchmarkSpec(
    name="head",
    summary="the head model: time of a forward pass, fast beside readable path; numerical extremes",
    speed="headbench.datasets.benchmarks.head:speed",
    stress="headbench.datasets.benchmarks.head:stress",
)

REFIT = BenchmarkSpec(
    name="refit",
    summary="the refit to another head model: residuals, timesteps a second",
    speed="headbench.datasets.benchmarks.refit:speed",
)
