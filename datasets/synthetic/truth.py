"""Ground truth of a synthetic capture for poses and views without recorded images."""

from __future__ import annotations

from dataclasses import asdict, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from ...bench.contracts import Camera, Clip, FloatArray, HeadPose, TrueFrame
from ...bench.engine.captures import synthesis_arguments
from ...bench.errors import UnavailableError
from ...bench.io.files import digest
from ..region_masks import HeadRegions, select
from .history import over_time
from .panels import KERNEL, default_samples, sample_count
from .plan import (
    EDITION,
    FIRST_SUBJECT,
    PROCEDURAL,
    SubjectPlan,
    SyntheticSettings,
    load_geometry,
    plan_subject,
)
from .renderer import CaptureRenderer

_HELD_SECONDS = 60.0


class SyntheticTruth:
    """The person of a synthetic capture, rendered in any pose and view; a `GroundTruth`.

    Shape, skin, hair, lights, samples a pixel, tone curve and errors of masks are the capture's, the
    background is the clip's. Blood flow and wrinkles are in the steady state of the expression, and the tongue is inside.
    Effects that depend on time (`--hair-lag`, `--motion-blur`) and the response of single cameras (`--camera-colour`) are
    left out.

    The pose is taken as it is. If the capture's tracking has errors, an avatar that was trained with them is compared with
    the true person in the pose that it is given, not with the pictures that were tracked as that pose.

    Attributes
    ----------
    fingerprint : str
        Hex digest of everything that a picture depends on beside pose and camera.
    """

    def __init__(self, clip: Clip) -> None:
        self._posed: HeadPose | None = None
        self._subject, self._background = clip.subject, np.asarray(clip.background, np.float64)
        self._settings = _settings(clip)
        KERNEL.load()
        self._geometry = load_geometry(self._settings.head)
        made = self._geometry.head.version
        if clip.head.version != made:
            raise UnavailableError(
                f"The clip has poses of {clip.head.version}; the true person is rendered in poses of {made}.",
                "Make the capture with that head model (`headbench synth --head`).",
                f"poses are of {clip.head.version}, the truth is of {made}",
            )
        self.fingerprint = digest(
            asdict(self._settings), EDITION, clip.subject, self._geometry.head.fingerprint(), self._background
        )

    def render(self, camera: Camera, pose: HeadPose, seed: int = 0) -> TrueFrame:
        """Picture of the person, the same bytes for the same input. ``seed`` is that of the samples of the pixels."""
        if pose is not self._posed:  # light is computed once for all views of a pose
            activations = self._geometry.translation.activations(pose)
            (skin,) = over_time([activations], _HELD_SECONDS, self._plan.person)
            self._renderer.set_pose(pose, activations, skin)
            self._posed = pose
        rgb, mask = self._renderer.render_view(camera, seed, self._background)
        return TrueFrame(rgb, mask, select(self._regions.labels(camera, pose, mask), "face"))

    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W) distance of the head's mesh along the camera's axis, metres; infinity beside it. Hair, beard and glasses have none."""
        return self._regions.depth(camera, pose)

    @cached_property
    def _plan(self) -> SubjectPlan:
        index = int(self._subject) - FIRST_SUBJECT
        return plan_subject(Path("unwritten"), index, self._geometry, self._settings)

    @cached_property
    def _regions(self) -> HeadRegions:
        return HeadRegions(self._geometry.head, self._plan.shape, self._plan.writer.plan.static_offset)

    @cached_property
    def _renderer(self) -> CaptureRenderer:
        return CaptureRenderer(self._plan)


def _settings(clip: Clip) -> SyntheticSettings:
    """Settings that a clip's capture was made with. Raises `UnavailableError` if they cannot be reproduced."""
    recorded = clip.steps[0].parameters.get("synthetic") if clip.steps else None
    if not recorded:
        raise UnavailableError(
            f"Subject {clip.subject} is recorded; only a synthetic capture has a truth for every pose and view.",
            "Use a capture of `headbench synth`.",
            "the capture is not synthetic",
        )
    if any(step.name == "mask_below_neck" for step in clip.steps):
        raise UnavailableError(
            "The clip's pictures are cut off below the neck; the truth shows the shoulders.",
            "Read the capture with its shoulders (`below_neck`).",
            "the pictures are cut off below the neck",
        )
    if recorded.get("edition") != EDITION:
        raise UnavailableError(
            f"The capture is of edition {recorded.get('edition', 1)}; this version renders edition {EDITION}.",
            "Make the capture again with this version (`headbench synth`).",
            f"the capture is of edition {recorded.get('edition', 1)}, not {EDITION}",
        )
    if recorded.get("head") not in PROCEDURAL:
        raise UnavailableError(
            f"The capture has the head model {recorded.get('head')}, whose file it does not name.",
            "Use a capture of the procedural head.",
            "the capture is not of the procedural head",
        )
    given = synthesis_arguments([asdict(step) for step in clip.steps], clip.subject)
    size = given["size"]
    wanted = given["samples_per_pixel"]
    values = {field.name: given[field.name] for field in fields(SyntheticSettings)}
    samples = default_samples(*size) if wanted is None else sample_count(wanted)
    return SyntheticSettings(**{**values, "size": (size[0], size[1]), "samples_per_pixel": samples})
