"""Conditions that the experiments register, and names that reports share; light to import."""

from __future__ import annotations

from typing import Literal, TypeAlias

from ..specs import ConditionSpec, MetricSpec

Over: TypeAlias = Literal["budget", "seconds", "cameras", "timesteps", "pictures", "tracking_error"]
"""What `run curve` varies."""
RECORD_FILE = "record.json"
"""Results of `run extremes` and `run reenact`."""

MOVED_LINES = "lines-move-splats"
"""The ablation of ours in the suite's endpoints."""
RUN, RECORDED_RUN, SEEDS_RUN = "run", "run-recorded", "run-seeds"
"""Folders of a suite's runs, each with one folder per subject: exact captures, captures as recordings are, and other training
seeds on the latter."""

HOLD_OUT = ConditionSpec(
    name="hold-out",
    summary="Clip: holds a camera and every n-th timestep out of the training frames; parameters camera, every.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:hold_out",
)

CAMERAS = ConditionSpec(
    name="cameras",
    summary="Clip: a part of the training cameras; parameter part.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:fewer_cameras",
)

TIMESTEPS = ConditionSpec(
    name="timesteps",
    summary="Clip: a part of the training timesteps; parameter part.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:fewer_timesteps",
)

PICTURES = ConditionSpec(
    name="pictures",
    summary="Clip: a number of training frames, over all timesteps and cameras; parameter count.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:fewer_pictures",
)

TRACKING_ERROR = ConditionSpec(
    name="tracking-error",
    summary="Clip: another level of tracking error, of synthetic captures; parameter level.",
    kind="clip",
    implementation="headbench.bench.experiments.held_out:with_tracking_error",
)

VARIANT = ConditionSpec(
    name="variant",
    summary="Derive: a smaller or faster avatar without training; parameter name, see `run sweep`.",
    kind="derive",
    implementation="headbench.bench.experiments.curve:variant",
)

TEST_REFIT = ConditionSpec(
    name="test-refit",
    summary="Views: fits expression, jaw and camera of each scored frame to its own picture, with the avatar frozen.",
    kind="views",
    implementation="headbench.bench.experiments.refit:refit",
)

MEASURES = (
    MetricSpec("non_finite", "Not finite", "share", False, 3, ""),
    MetricSpec("coverage", "Coverage", "ratio", True, 3, ""),
    MetricSpec("translucent", "Translucent", "share", False, 3, ""),
    MetricSpec("largest_splat", "Largest splat", "share of the height", False, 3, ""),
    MetricSpec("mean_opacity", "Mean opacity", "ratio", True, 3, ""),
)
"""Metrics of `stability.Measures`, with limits."""

AGAINST_TRUTH = (
    MetricSpec("psnr", "PSNR", "dB", True, 2, ""),
    MetricSpec("lpips", "LPIPS", "", False, 4, ""),
    MetricSpec("iou", "Overlap of masks", "ratio", True, 3, ""),
    MetricSpec("colour", "Colour of the face", "CIEDE2000", False, 2, ""),
    MetricSpec("depth", "Depth of the face", "mm", False, 1, ""),
    MetricSpec("normals", "Normals of the face", "degrees", False, 1, ""),
    MetricSpec("response", "Response", "ratio", True, 2, "", kind="avatar"),
    MetricSpec("flicker", "Flicker", "levels", False, 3, "", kind="avatar"),
)
"""Metrics of `truth.TruthJudge` and `stability.surface`, with limits derived from the ground truth."""

EXTREMES = ConditionSpec(
    name="extremes",
    summary="Renders new views and poses; checks them against the ground truth of synthetic captures, and stability limits.",
    kind="drive",
    implementation="headbench.bench.experiments.extremes:drive",
    protocols="headbench.bench.experiments.extremes:protocols",
    metrics=(*MEASURES, *AGAINST_TRUTH),
)

REENACT = ConditionSpec(
    name="reenact",
    summary="Renders the held-out performance of other subjects; checks stability limits and identity.",
    kind="drive",
    implementation="headbench.bench.experiments.reenactment:drive",
    protocols="headbench.bench.experiments.reenactment:protocols",
    metrics=(*MEASURES, MetricSpec("identity", "Identity", "CIEDE2000", False, 2, "")),
)
