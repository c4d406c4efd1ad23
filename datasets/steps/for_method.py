"""Conversion of a clip to the requirements of a method, and of its renders back.

Found by the harness as the entry point of `headbench.adaptation`, see `headbench.bench.engine.adaptation`.

Resolution alignment: resizes a clip to a method's image size, and renders back to the protocol's size. Image
coordinates are measured from the top left corner of the top left pixel, so that coordinates scale without an offset: x'
= x * width' / width. Colours are resampled as stored (display-referred), as in other tools.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from PIL import Image

from ...bench.contracts import Camera, Clip, FloatArray, FrameKey, Progress
from ...bench.engine.adaptation import Adaptation, AdaptedClip, MethodNeeds
from ...bench.errors import InputError
from ...bench.specs import ResolutionRule
from ..clip import CaptureClip, FramePixels, as_capture
from ..ga.tracking import find_head
from ..head.arrays import HeadArrays
from ..head.model import PosedSubject, camera_in_head_frame, pose_in_head_frame
from ..head.procedural.model import procedural_head
from ..head.procedural.versions import VERSIONS
from ..head.refit.refit import refit

Size = tuple[int, int]


@dataclass(frozen=True)
class Resize:
    """Resizing to (width, height) pixels with the same extent."""

    width: int
    height: int


@dataclass(frozen=True)
class PixelBox:
    """A box of an image in whole pixels, padded with background outside the image."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class Alignment:
    """Pixel-exact conversion of images of one size to those of a `ResolutionRule`, and its inverse."""

    source: Size
    """(width, height) of the original images."""
    moves: tuple[Resize | PixelBox, ...]
    """Operations, applied in this order."""

    @classmethod
    def of(cls, source: Size, rule: ResolutionRule) -> Alignment:
        """Apply a rule to an image size. Operations without effect are omitted. A side that is not a multiple of the
        divisor is rounded down, which makes its pixels slightly larger."""
        moves: list[Resize | PixelBox] = []
        width, height = source
        if rule.square and width != height:
            side = max(width, height) if rule.square == "pad" else min(width, height)
            moves.append(PixelBox((width - side) // 2, (height - side) // 2, side, side))
            width = height = side
        if rule.divide > 1:
            width, height = width // rule.divide, height // rule.divide
            if min(width, height) < 1:
                expected = f"images of at least {rule.divide} pixels on each side"
                raise InputError("resolution rule", "divide", expected, f"{source[0]}x{source[1]}")
            moves.append(Resize(width, height))
        wanted = rule.size or (width * rule.multiply, height * rule.multiply)
        if wanted != (width, height):
            moves.append(Resize(*wanted))
        return cls(source, tuple(moves))

    @property
    def aligned_size(self) -> Size:
        """(width, height) of the aligned images."""
        return (self.moves[-1].width, self.moves[-1].height) if self.moves else self.source

    def camera(self, camera: Camera) -> Camera:
        """The camera of the aligned images."""
        for move in self.moves:
            if isinstance(move, Resize):
                camera = camera.resized(move.width, move.height)
            else:
                camera = camera.boxed(move.left, move.top, move.width, move.height)
        return camera

    def image(self, image: FloatArray, background: Sequence[float] | FloatArray) -> FloatArray:
        """Align a composited float32 image (H, W, 3) in [0, 1]; boxes are padded with ``background``. Coverage is
        aligned the same way as (H, W, 1) on background 0."""
        for move in self.moves:
            if isinstance(move, Resize):
                image = _resized(image, move.width, move.height)
            else:
                image = take_box(image, move, background)
        return image

    def restore(self, render: FloatArray, background: Sequence[float] | FloatArray) -> FloatArray:
        """Convert an (H, W, 3) render of the aligned view to the source's size, in one antialiased resizing. Cropped
        parts become ``background``."""
        (width, height), found = self.aligned_size, (render.shape[1], render.shape[0])
        if found != (width, height):
            raise InputError("render", "size", f"{width}x{height}", f"{found[0]}x{found[1]}")
        boxes = [move for move in self.moves if isinstance(move, PixelBox)]
        box = boxes[0] if boxes else PixelBox(0, 0, *self.source)
        whole = _resized(np.asarray(render, np.float32), box.width, box.height)
        return take_box(whole, PixelBox(-box.left, -box.top, *self.source), background)


def take_box(image: FloatArray, box: PixelBox, background: Sequence[float] | FloatArray) -> FloatArray:
    """Crop a box from an image (H, W, C), padded with (C,) ``background``."""
    height, width = image.shape[:2]
    if (box.left, box.top, box.width, box.height) == (0, 0, width, height):
        return image
    result = np.empty((box.height, box.width, image.shape[2]), dtype=image.dtype)
    result[:] = np.asarray(background, dtype=image.dtype)
    left, right = max(box.left, 0), min(box.left + box.width, width)
    top, bottom = max(box.top, 0), min(box.top + box.height, height)
    if left < right and top < bottom:
        inside = (slice(top - box.top, bottom - box.top), slice(left - box.left, right - box.left))
        result[inside] = image[top:bottom, left:right]
    return result


def alignments(cameras: Mapping[str, Camera], rule: ResolutionRule) -> dict[str, Alignment]:
    """Alignment of each camera's images, by camera id."""
    return {name: Alignment.of((c.width, c.height), rule) for name, c in cameras.items()}


def align_clip(clip: CaptureClip, rule: ResolutionRule) -> CaptureClip:
    """The clip at the size of a rule: images and masks resized when they are read, intrinsics with them.

    The composited image is resized instead of straight colours, because colours with zero coverage are arbitrary and
    must not bleed into edges. A clip that a rule does not change is returned unchanged.
    """
    plans = alignments(clip.cameras, rule)
    if not any(plan.moves for plan in plans.values()):
        return clip
    cameras = {name: plans[name].camera(camera) for name, camera in clip.cameras.items()}
    recorded = {clip.recorded(key).camera: key.camera for key in clip.files}
    by_recorded = {name: plans[current] for name, current in recorded.items()}
    ground = np.asarray(clip.background, dtype=np.float32)

    def align(key: FrameKey, pixels: FramePixels) -> FramePixels:
        plan = by_recorded[key.camera]
        coverage = pixels.coverage
        if coverage is not None:
            coverage = plan.image(coverage[..., None], (0.0,))[..., 0]
        return FramePixels(plan.image(pixels.image, ground), coverage)

    pairs = sorted({(plan.source, plan.aligned_size) for plan in plans.values()})
    sizes = [f"{a[0]}x{a[1]} to {b[0]}x{b[1]}" for a, b in pairs]
    parameters = {"rule": asdict(rule), "sizes": sizes}
    return clip.derive_pixels("align_resolution", parameters, align, cameras=cameras)


def _resized(image: FloatArray, width: int, height: int) -> FloatArray:
    if (image.shape[1], image.shape[0]) == (width, height):
        return image
    return np.clip(resize_image(image, width, height), 0, 1)


def resize_image(image: FloatArray, width: int, height: int) -> FloatArray:
    """Resize a float32 image (H, W) or (H, W, C).

    If both sides shrink by whole factors, every pixel is the mean of its block. Otherwise the kernel is
    Keys' cubic (a = -1/2, "Cubic convolution interpolation for digital image processing", 1981), widened by the factor
    when a side shrinks, to avoid aliasing; it reproduces linear ramps and overshoots at edges by up to some per cent,
    so clamp if necessary. Weights outside the image are dropped and the rest renormalised.
    """
    rows, columns = image.shape[:2]
    if (rows, columns) == (height, width):
        return image
    if rows % height == 0 and columns % width == 0:
        means = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(means, dtype=np.float32).reshape(height, width, *image.shape[2:])
    planes = image[..., None] if image.ndim == 2 else image
    resized = [_cubic(planes[..., channel], width, height) for channel in range(planes.shape[2])]
    return resized[0] if image.ndim == 2 else np.stack(resized, axis=-1)


def _cubic(plane: FloatArray, width: int, height: int) -> FloatArray:
    # Pillow's bicubic is Keys' with a = -1/2 and widens when shrinking; OpenCV's (a = -3/4) bends ramps and aliases.
    source = Image.fromarray(np.ascontiguousarray(plane))
    return np.asarray(source.resize((width, height), Image.Resampling.BICUBIC), dtype=np.float32)


def clip_for_method(source: Clip, needs: MethodNeeds, heads: Mapping[str, str]) -> Adaptation:
    """Check that a clip can be converted to the requirements of a method, and return the conversion.

    The order is: tracking refitted to a head model the method accepts, images aligned to its size, views joined
    into one video.

    Parameters
    ----------
    heads : Mapping[str, str]
        Head model files by version, to refit to. The procedural head's versions need none.
    """
    clip = as_capture(source)
    target = None
    if needs.head_models and clip.head.version not in needs.head_models:
        target = _target(clip, needs.head_models, heads)
    alignments(clip.cameras, needs.resolution)
    return partial(_adapt, clip, needs, target)


def _adapt(
    clip: CaptureClip, needs: MethodNeeds, target: HeadArrays | None, folder: Path, progress: Progress
) -> AdaptedClip:
    tracked = clip if target is None else refit(clip, target, folder=folder, progress=progress).clip
    aligned = align_clip(tracked, needs.resolution)
    plans = alignments(tracked.cameras, needs.resolution)
    ground = np.asarray(clip.background, np.float32)

    def restore(key: FrameKey, render: FloatArray) -> FloatArray:
        return plans[key.camera].restore(render, ground)

    if not needs.monocular:
        return AdaptedClip(aligned, restore=restore)
    video = as_single_video(aligned)
    return AdaptedClip(video.clip, video.keys.__getitem__, restore)


def _target(clip: CaptureClip, accepted: tuple[str, ...], heads: Mapping[str, str]) -> HeadArrays:
    """The first available head model that the method accepts."""
    for version in accepted:
        if version in heads:
            head = find_head(Path(heads[version]).parent, None, heads[version])
            if head.version != version:
                raise InputError(heads[version], "version", repr(version), repr(head.version))
            return head
        if version in VERSIONS and clip.head.version in VERSIONS:
            return procedural_head(version)
    raise InputError(
        f"clip {clip.subject}",
        "head_models",
        f"tracking with {' or '.join(accepted)}, or the file of such a head model to refit to",
        f"tracking with {clip.head.version}, head models {', '.join(sorted(heads)) or 'none'}",
        f"Name the file: --set heads.{accepted[0]}=PATH.",
    )


class SingleVideo(NamedTuple):
    """A clip as one video, and the source frame of each of its frames."""

    clip: CaptureClip
    """The video. Its timesteps are frame numbers: first all training frames, then those of the other splits, then
    excluded ones. No two frames share a timestep or a camera."""
    keys: Mapping[FrameKey, FrameKey]
    """Key in the video by key in the source."""


def as_single_video(clip: CaptureClip) -> SingleVideo:
    """Concatenate the views of a clip into one video: all of the first camera, then all of the next.

    This is how the paper gave multi-view captures to GaussianBlendshapes. Training frames come first and are
    numbered without a gap; frames of other splits have later numbers; they are not part of the video, but keep pose
    and camera for rendering. The head's rigid motion moves into the cameras (see `head.model`): every frame has its
    own camera, named after the one that recorded it, and a pose without rotation, neck and translation.
    """
    order = _order(clip)
    width = len(str(len(order) - 1))
    keys = {
        key: key._replace(timestep=number, camera=f"{key.camera}-{number:0{width}d}")
        for number, key in enumerate(order)
    }
    timesteps = sorted({key.timestep for key in order})
    poses, cameras = {}, {}
    motions = dict(zip(timesteps, PosedSubject.of(clip).motions([clip.poses[t] for t in timesteps])))
    for key, new in keys.items():
        # A separate pose, so that refinement by a method affects only this frame.
        still = pose_in_head_frame(clip.poses[key.timestep])
        poses[new.timestep] = replace(still, timestep=new.timestep)
        camera = camera_in_head_frame(clip.cameras[key.camera], motions[key.timestep])
        cameras[new.camera] = replace(camera, id=new.camera)
    video = clip.derive(
        "as_single_video",
        {"order": "camera, then timestep; training frames first", "head_frame": True},
        cameras=cameras,
        poses=poses,
        splits={
            name: tuple(sorted((keys[key] for key in part), key=lambda key: key.timestep))
            for name, part in clip.splits.items()
        },
        excluded={keys[key]: reason for key, reason in clip.excluded.items()},
        files={keys[key]: clip.files[key]._replace(recorded=clip.recorded(key)) for key in order},
    )
    return SingleVideo(video, keys)


def _order(clip: CaptureClip) -> list[FrameKey]:
    """Frames by split, camera and timestep; each once."""
    parts = [clip.splits["train"], *(part for name, part in clip.splits.items() if name != "train")]
    ordered = [key for part in parts for key in sorted(part, key=lambda key: (key.camera, key.timestep))]
    rest = sorted(set(clip.files) - set(ordered), key=lambda key: (key.camera, key.timestep))
    return [*dict.fromkeys([*ordered, *rest])]
