"""Masks: compositing on any background, and removal of pixels below the neck.

Straight alpha throughout: the colour of a pixel with coverage a, foreground colour F and background B is a F + (1 - a)
B, in display-referred colours, as in other tools.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.special import ndtr

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadAsset, IntArray
from ...bench.errors import InputError
from ...bench.io.files import digest, digest_file
from ...bench.io.images import read_pixels
from ..clip import CaptureClip, FramePixels
from ..head.model import PosedSubject

Ground = Sequence[float] | FloatArray
"""A colour (3,) in [0, 1], or an image (H, W, 3) of the empty set."""

SOFTNESS = 0.005
"""Standard deviation of the edge below the neck, in image widths: VHAP blurs with a Gaussian kernel 3 % wide,
which reaches about three deviations to either side."""

_SIDEWAYS = (
    0.3  # limit of the neck's foreshortening relative to the head's, beyond which its sides define no line
)


def composite(foreground: FloatArray, coverage: FloatArray, background: Ground) -> FloatArray:
    """(H, W, 3): straight foreground colours over a background, by (H, W) coverage."""
    share = coverage[..., None]
    return share * foreground + (1 - share) * np.asarray(background, dtype=foreground.dtype)


def recomposite(image: FloatArray, coverage: FloatArray, old: Ground, new: Ground) -> FloatArray:
    """Replace the background of a composited image.

    The contribution of the foreground, image - (1 - a) old, is between 0 and a for any real colour and clamped to this
    range, so that rounding of the image or a slightly different background has no effect.
    """
    share = coverage[..., None]
    contribution = np.clip(image - (1 - share) * np.asarray(old, dtype=image.dtype), 0, share)
    return contribution + (1 - share) * np.asarray(new, dtype=image.dtype)


def set_background(clip: CaptureClip, background: Sequence[float]) -> CaptureClip:
    """The clip, whose frames all have masks, on another background."""
    colour = np.asarray(background, dtype=np.float64)
    if np.array_equal(colour, clip.background):
        return clip
    parameters = {"background": colour.tolist(), "was": np.asarray(clip.background).tolist()}
    straight = all(files.image is not None and files.mask == files.image for files in clip.files.values())
    if straight and not clip.pixel_steps:
        # Straight-alpha files are composited directly on the new background, without intermediate rounding.
        return clip.derive("set_background", parameters, background=colour)
    old = np.asarray(clip.background, dtype=np.float32)

    def change(key: FrameKey, pixels: FramePixels) -> FramePixels:
        assert pixels.coverage is not None
        image = recomposite(pixels.image, pixels.coverage, old, colour.astype(np.float32))
        return FramePixels(image, pixels.coverage)

    return clip.derive_pixels("set_background", parameters, change, background=colour)


# ------------------------------------------------------------------ below the neck


@dataclass(frozen=True)
class NeckLine:
    """A line across an image, pixels: a point on it, and the unit normal towards the head."""

    point: tuple[float, float]
    normal: tuple[float, float]

    def weights(self, width: int, height: int, deviation: float) -> FloatArray:
        """(H, W) float32: 1 on the head's side, 0 below, a half-plane blurred by a Gaussian (pixels)."""
        x = np.arange(width) + 0.5 - self.point[0]
        y = np.arange(height)[:, None] + 0.5 - self.point[1]
        return ndtr((self.normal[0] * x + self.normal[1] * y) / deviation).astype(np.float32)


def mask_below_neck(clip: CaptureClip) -> CaptureClip:
    """Replace everything below the tracked neck by background, in images and masks, like VHAP's "below line".

    The line goes through the projected front of the neck's lower boundary, parallel to the line through its left
    and right; its edge is Gaussian. Head models end there and do not explain the motion of clothes below it.
    """
    anchors = neck_anchors(clip.head)
    timesteps = sorted({key.timestep for key in clip.files})
    meshes = PosedSubject.of(clip, torch.float32).each(clip, timesteps)
    places = {timestep: mesh[anchors].astype(np.float64) for timestep, mesh in meshes}
    lines = {
        clip.recorded(key): neck_line(clip.cameras[key.camera], places[key.timestep]) for key in clip.files
    }
    ground = np.asarray(clip.background, dtype=np.float32)

    def cut(key: FrameKey, pixels: FramePixels) -> FramePixels:
        line = lines[key]
        if line is None:
            return pixels
        height, width = pixels.image.shape[:2]
        weights = line.weights(width, height, SOFTNESS * width)
        coverage = None if pixels.coverage is None else pixels.coverage * weights
        # a w F + (1 - a w) B equals w (a F + (1 - a) B) + (1 - w) B, which does not need F.
        return FramePixels(composite(pixels.image, weights, ground), coverage)

    return clip.derive_pixels("mask_below_neck", {"softness": SOFTNESS, "anchors": anchors.tolist()}, cut)


def mask_clothes(
    clip: CaptureClip, labels: Mapping[FrameKey, Path], view: Callable[[ByteArray], ByteArray] | None = None
) -> CaptureClip:
    """Replace clothes, and what is no part of the person, by background, in images and masks.

    ``labels``: Image of each frame with the labels of CelebAMask-HQ's 19 classes. ``view``: The part of an image of
    coverage that a frame of the clip shows; None for all of it.
    """
    ground = np.asarray(clip.background, dtype=np.float32)
    files = {clip.recorded(key): labels[key] for key in clip.files}

    def cut(key: FrameKey, pixels: FramePixels) -> FramePixels:
        height, width = pixels.image.shape[:2]
        kept = 255 * np.isin(read_labels(files[key]), (NO_PERSON, CLOTH), invert=True).astype(np.uint8)
        kept = kept if view is None else view(kept)
        weights = cv2.resize(kept, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        coverage = weights if pixels.coverage is None else np.minimum(pixels.coverage, weights)
        return FramePixels(composite(pixels.image, weights, ground), coverage)

    content = digest(*(digest_file(path) for _, path in sorted(files.items())))
    return clip.derive_pixels("mask_clothes", {"labels": content}, cut)


NO_PERSON, CLOTH, CLASSES = 0, 16, 19
"""Labels of CelebAMask-HQ in the order of face-parsing.PyTorch, and their number."""


def read_labels(path: Path) -> ByteArray:
    """(H, W) labels of an image of `CLASSES` labels."""
    pixels = read_pixels(path)
    if pixels.ndim != 2 or pixels.max() >= CLASSES:
        expected = f"a grey 8-bit image of labels from 0 to {CLASSES - 1}, as face-parsing.PyTorch gives them"
        found = f"levels up to {pixels.max()}" if pixels.ndim == 2 else "colours"
        raise InputError(path, "", expected, found, "Pictures of the labels in colours cannot be read.")
    return pixels


def without_torso(
    clip: CaptureClip, cut: str, parsing: str, view: Callable[[ByteArray], ByteArray] | None = None
) -> CaptureClip:
    """The clip without clothes by the labels in the folder ``parsing``, else with the cut of the options of commands.
    Frames without masks are not cut, since the room behind the person remains in them, too."""
    if not parsing:
        masked = all(clip.has_mask(key) for key in clip.files)
        return mask_below_neck(clip) if cut == "bust-line" and masked else clip
    return mask_clothes(clip, label_files(clip, parsing), view)


def label_files(clip: CaptureClip, parsing: str) -> dict[FrameKey, Path]:
    """Label image of each frame in the folder ``parsing``, named as its image."""
    images = {key: files.image for key, files in clip.files.items()}
    labels = {key: Path(parsing) / f"{path.stem}.png" for key, path in images.items() if path is not None}
    for path in labels.values():
        read_labels(path)
    return labels


def neck_anchors(head: HeadAsset) -> IntArray:
    """(4,) vertices: front, left and right of the neck's lower boundary, and the top of the head. The boundary is the
    region of that name, else the lower half of the neck."""
    x, y, z = np.asarray(head.template, np.float64).T
    if len(head.regions.get("boundary", ())):
        rim = np.asarray(head.regions["boundary"])
    elif len(head.regions.get("neck", ())):
        neck = np.asarray(head.regions["neck"])
        rim = neck[y[neck] <= np.median(y[neck])]
    else:
        known = ", ".join(sorted(head.regions)) or "no regions"
        raise InputError(f"head model {head.version}", "regions", "a region 'boundary' or 'neck'", known)
    return np.array([rim[np.argmax(z[rim])], rim[np.argmax(x[rim])], rim[np.argmin(x[rim])], np.argmax(y)])


def neck_line(camera: Camera, anchors: FloatArray) -> NeckLine | None:
    """The line in an image, given the (4, 3) world positions of `neck_anchors`; None where one is behind it. Seen from
    the side, the left and right of the neck coincide; the line is then perpendicular to the head's height."""
    points = anchors @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    if points[:, 2].min() <= 0:
        return None
    front, left, right, top = (points @ np.asarray(camera.K).T)[:, :2] / points[:, 2:]
    up, across = top - front, left - right
    height, breadth = np.linalg.norm(anchors[3] - anchors[0]), np.linalg.norm(anchors[1] - anchors[2])
    if np.hypot(*across) * height < _SIDEWAYS * np.hypot(*up) * breadth:
        normal = up
    else:
        normal = np.array([-across[1], across[0]])
        normal = normal if normal @ up > 0 else -normal
    length = float(np.hypot(*normal))
    if not length > 0:
        return None
    return NeckLine(
        (float(front[0]), float(front[1])), (float(normal[0] / length), float(normal[1] / length))
    )


def check_colour(values: Sequence[float] | FloatArray) -> FloatArray:
    """A colour as (3,) float64; raises `InputError` unless it is three numbers in [0, 1]."""
    colour = np.asarray(values, dtype=np.float64)
    if colour.shape != (3,) or not ((colour >= 0) & (colour <= 1)).all():
        raise InputError("colour", "background", "three numbers in [0, 1]", str(values))
    return colour
