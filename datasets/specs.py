"""Captures that headbench reads or makes. Light to import: implementations are named, not loaded."""

from ..bench.specs import DatasetSpec

GA_LAYOUT = DatasetSpec(
    name="ga",
    summary="A capture in the GaussianAvatars/VHAP layout: a UNION folder or a single sequence.",
    implementation="headbench.datasets.ga.reader:read_capture",
    find="headbench.datasets.ga.reader:find_captures",
    adapt="headbench.datasets.steps.for_method:clip_for_method",
)

SYNTHETIC = DatasetSpec(
    name="synthetic",
    summary="A path-traced procedural head with exact tracking, written in the same layout.",
    implementation="headbench.datasets.synthetic.capture:synthesize",
    reads=False,
)
