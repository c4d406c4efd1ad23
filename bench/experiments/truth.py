"""Comparison of an avatar in new poses and views with the ground truth of a synthetic capture.

Limits are not fixed numbers of decibels, which would fit only one capture. They are derived from each frame's ground truth: the
score of a blurred copy, and its difference from the subject's typical pose or from the previous frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ..contracts import ByteArray, Camera, FloatArray, Frame, GroundTruth, HeadPose, TrueFrame
from ..engine.plan import Job
from ..engine.scoring import make_metric
from ..errors import InputError, UnavailableError
from ..io.files import digest
from ..io.images import quantise, read_png, write_png
from ..io.provenance import SYNTHETIC
from ..registry import get
from ..rows import FULL
from .stability import FACE, NO_FACE, LimitCheck, absent_surface

FOLDER = "truth"
POSE_FIELDS = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")
LEAST_CHANGE = 2.0
"""Minimum change of the ground truth, root mean square in 8-bit levels, for evaluating the change of an avatar."""
NOT_FINITE = "the frame is not finite"


@dataclass(frozen=True)
class TruthLimits:
    """Limits on the difference of a frame from the ground truth."""

    blur: float = 0.015
    blur_beyond: float = 0.04
    """``blur``, ``blur_beyond``: PSNR and LPIPS must be at least as good as for the ground truth after a Gaussian
    blur relative to the image's height; the second is for views beyond the training cameras, where no training frame
    shows the hair."""
    iou: float = 0.9
    """Minimum overlap of alpha and the true mask."""
    colour: float = 5.0
    """Maximum CIEDE2000 difference of the face's mean colours."""
    response: float = 0.25
    """Minimum fraction of the ground truth's change from the typical pose that the avatar shows."""
    flicker: float = 1.5
    """Maximum flicker relative to the ground truth's change, which is the flicker of a static avatar."""


TRUTH_LIMITS = TruthLimits()


class TruthPictures:
    """Renders of a `GroundTruth`, cached in a folder under names derived from their content.

    Methods share them, in the poses and views of the capture.
    """

    def __init__(self, source: GroundTruth, folder: Path) -> None:
        self._source, self._folder = source, folder

    @classmethod
    def of(cls, job: Job) -> TruthPictures:
        """The ground truth of a cell's subject. Raises `UnavailableError` if there is none."""
        clip = job.clip
        place = f"truth of {clip.fingerprint}"
        if place not in job.kept:
            from ...datasets.synthetic.renderer import SyntheticTruth

            job.kept[place] = SyntheticTruth(clip)
        return cls(job.kept[place], job.run / FOLDER)

    @property
    def fingerprint(self) -> str:
        """Hex digest of everything that the renders depend on besides camera and pose."""
        return self._source.fingerprint

    def missing(self, frames: Iterable[tuple[Camera, HeadPose]]) -> int:
        """Number of frames whose renders are not in the folder."""
        files = {self._files(camera, pose) for camera, pose in frames}
        return sum(not (picture.exists() and mask.exists()) for picture, mask in files)

    def at(self, camera: Camera, pose: HeadPose) -> tuple[TrueFrame, tuple[Path, Path]]:
        """The ground truth of a frame, rendered if it is not in the folder, and its files: image, mask and face."""
        files = picture, masks = self._files(camera, pose)
        try:
            mask, face, _ = np.moveaxis(read_png(masks), 2, 0)
            truth = TrueFrame(read_png(picture), mask, face > 0)
        except InputError:  # missing or damaged
            truth = self._source.render(camera, pose)
            layers = [truth.mask, 255 * truth.face.astype(np.uint8), np.zeros_like(truth.mask)]
            write_png(picture, truth.rgb, SYNTHETIC)
            write_png(masks, np.stack(layers, axis=2), SYNTHETIC)
        return truth._replace(depth=self._source.depth(camera, pose)), files

    def _files(self, camera: Camera, pose: HeadPose) -> tuple[Path, Path]:
        given = (camera.K, camera.world_to_camera, *(getattr(pose, name) for name in POSE_FIELDS))
        shown = [np.asarray(values, np.float64) for values in given if values is not None]
        name = digest(self.fingerprint, camera.width, camera.height, pose.head_model, *shown)[:20]
        return self._folder / f"{name}.png", self._folder / f"{name}-mask.png"


class TruthPair(NamedTuple):
    """A rendered frame of the truth's size: (H, W, 3) 8-bit sRGB and (H, W) alpha."""

    picture: ByteArray
    alpha: FloatArray
    truth: TrueFrame

    @classmethod
    def of(cls, frame: Frame, truth: TrueFrame) -> TruthPair | None:
        """None for a frame with non-finite values."""
        rgb, alpha = np.asarray(frame.rgb, np.float32), np.asarray(frame.alpha, np.float32)
        if not (np.isfinite(rgb).all() and np.isfinite(alpha).all()):
            return None
        return cls(quantise(rgb), alpha, truth)


class TruthJudge:
    """Compares frames with the ground truth and its limits. Unavailable metrics are missing, with the reason."""

    def __init__(self, device: str = "cpu") -> None:
        self._psnr, self._lpips, self._flicker = (
            make_metric(get("metrics", name), device) for name in ("psnr", "lpips", "flicker")
        )

    def appearance(self, frame: TruthPair | None, *, extrapolated: bool = False) -> list[LimitCheck]:
        """PSNR and LPIPS of frame and face, overlap of alpha and mask, colour of the face."""
        if frame is None:
            return [_absent(name, region, NOT_FINITE) for name, region in APPEARANCE]
        truth, limits = frame.truth, TRUTH_LIMITS
        sigma = len(truth.rgb) * (limits.blur_beyond if extrapolated else limits.blur)
        blurred = np.asarray(cv2.GaussianBlur(truth.rgb, (0, 0), sigma), np.uint8)
        bounds = self._scores(blurred, truth)
        checks = []
        for (name, region), value in self._scores(frame.picture, truth).items():
            bound = bounds[name, region]
            if isinstance(value, str) or isinstance(bound, str):
                checks.append(_absent(name, region, str(value)))
            else:
                low, high = (bound, math.inf) if name == "psnr" else (0.0, bound)
                checks.append(LimitCheck(name, value, low, high, region=region))
        return [*checks, self._overlap(frame), self._colour(frame)]

    def response(self, frame: TruthPair | None, reference: TruthPair | None) -> LimitCheck:
        """Fraction of the ground truth's change between two poses in one view that the avatar shows.

        The slope of the least-squares line through 0 of the avatar's differences over those of the ground truth, over the
        pixels of the face in either frame: 0 for a static avatar, 1 for one that moves as the ground truth, regardless of
        errors common to both frames.
        """
        if frame is None or reference is None:
            return _absent("response", FULL, NOT_FINITE)
        face = frame.truth.face | reference.truth.face
        wanted = _difference(frame.truth.rgb, reference.truth.rgb)[face]
        if not face.any() or _rms(wanted) < LEAST_CHANGE:
            return _absent("response", FULL, "the truth hardly changes in this view")
        shown = _difference(frame.picture, reference.picture)[face]
        slope = float((shown * wanted).sum() / np.square(wanted).sum())
        return LimitCheck("response", slope, TRUTH_LIMITS.response, math.inf)

    def flicker(self, frame: TruthPair | None, before: TruthPair | None) -> LimitCheck:
        """The metric `flicker` of two consecutive frames."""
        if frame is None or before is None:
            return _absent("flicker", FULL, NOT_FINITE)
        value = self._flicker(frame.picture, frame.truth.rgb, before.picture, before.truth.rgb)
        change = max(LEAST_CHANGE, _rms(_difference(frame.truth.rgb, before.truth.rgb)))
        return LimitCheck("flicker", value, 0.0, TRUTH_LIMITS.flicker * change)

    def _scores(self, picture: ByteArray, truth: TrueFrame) -> dict[tuple[str, str], float | str]:
        """Values of PSNR and LPIPS by metric and region, or the reason for a missing one."""
        faces = self._psnr.in_regions(picture, truth.rgb, {FACE: truth.face})
        scores: dict[tuple[str, str], float | str] = {
            ("psnr", FULL): self._psnr(picture, truth.rgb),
            ("psnr", FACE): faces.get(FACE, NO_FACE),
        }
        for region, pixels in ((FULL, np.ones_like(truth.face)), (FACE, truth.face)):
            left, top, width, height = cv2.boundingRect(pixels.astype(np.uint8))
            crop = np.s_[top : top + height, left : left + width]
            try:
                scores["lpips", region] = self._lpips(picture[crop], truth.rgb[crop]) if width else NO_FACE
            except UnavailableError as error:
                scores["lpips", region] = error.note
        return scores

    def _overlap(self, frame: TruthPair) -> LimitCheck:
        """Intersection over union of alpha and true mask, with fractional coverage."""
        true = frame.truth.mask / 255.0
        union = float(np.maximum(frame.alpha, true).sum())
        value = float(np.minimum(frame.alpha, true).sum()) / union if union else 1.0
        return LimitCheck("iou", value, TRUTH_LIMITS.iou, math.inf)

    def _colour(self, frame: TruthPair) -> LimitCheck:
        """CIEDE2000 difference of the face's mean colours."""
        from skimage.color import deltaE_ciede2000  # loads SciPy, which help does without

        if not frame.truth.face.any():
            return _absent("colour", FULL, NO_FACE)
        means = [_lab(image)[frame.truth.face].mean(axis=0) for image in (frame.picture, frame.truth.rgb)]
        return LimitCheck("colour", float(deltaE_ciede2000(*means)), 0.0, TRUTH_LIMITS.colour)


APPEARANCE = (
    ("psnr", FULL),
    ("psnr", FACE),
    ("lpips", FULL),
    ("lpips", FACE),
    ("iou", FULL),
    ("colour", FACE),
)
"""Measures and regions of `TruthJudge.appearance`."""


def _absent(name: str, region: str, reason: str) -> LimitCheck:
    return LimitCheck(name, None, -math.inf, math.inf, reason, region)


def without_truth(reason: str) -> tuple[list[LimitCheck], LimitCheck, LimitCheck]:
    """Missing appearance, response and flicker of a frame without ground truth."""
    appearance = [_absent(name, region, reason) for name, region in APPEARANCE]
    appearance += absent_surface(reason)
    return appearance, _absent("response", FULL, reason), _absent("flicker", FULL, reason)


def _difference(image: ByteArray, other: ByteArray) -> FloatArray:
    return np.subtract(image, other, dtype=np.float64)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _lab(image: ByteArray) -> FloatArray:
    return np.asarray(cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2Lab))
