"""A `Clip` over files on disk.

Masks of the parts of the tracked head in a frame: from the posed mesh by a z-buffer, and from the mask.

* ``foreground``: pixels that the mask covers by half or more.
* ``face``: the mesh's face, lips, eyes and the opening of the mouth, where the mesh does not hide them.
* ``mouth``: the convex hull of the visible lips, so that teeth, tongue and the dark between them belong to it.
* ``eyes``: eyeballs and the skin about them.
* ``neck`` and ``ears``: those of the mesh, where it does not hide them.
* ``hair``: the mesh's scalp, and foreground beyond the mesh whose nearest pixel of the mesh is scalp: hair extends
  beyond the head. Hair beside the neck is included.

Mouth and hair are limited to the foreground, if there is a mask. Regions are as accurate as the tracking.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

from ..bench.contracts import (
    BoolArray,
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
    StepRecord,
)
from ..bench.errors import InputError
from ..bench.io.arrays import Member, check_arrays
from ..bench.io.files import digest
from ..bench.io.images import quantise
from .head.arrays import OPTIONAL, STORED, HeadArrays
from .head.model import PosedSubject
from .images import ImageStore, read_image, read_mask
from .mesh_pictures import rasterize_mesh

FOREGROUND = "foreground"
PARTS: Mapping[str, tuple[str, ...]] = {
    "face": ("face", "lips", "eye_region", "left_eyeball", "right_eyeball"),
    "mouth": ("lips",),
    "eyes": ("eye_region", "left_eyeball", "right_eyeball"),
    "hair": ("scalp",),
    "neck": ("neck", "boundary"),
    "ears": ("left_ear", "right_ear"),
}
"""Regions of the head model that form each part; missing ones are skipped."""

_NEEDED = {name: regions[0] for name, regions in PARTS.items()}
_BITS = {name: 1 << bit for bit, name in enumerate((FOREGROUND, *PARTS))}


class HeadRegions:
    """The parts of one subject's head, for masks of frames. Thread-safe."""

    def __init__(self, head: HeadArrays, shape: FloatArray, static_offset: FloatArray) -> None:
        self._head, self._shape, self._offset = head, shape, static_offset

    @property
    def names(self) -> tuple[str, ...]:
        """The parts that the head model has the regions for."""
        return tuple(name for name in PARTS if _NEEDED[name] in self._head.regions)

    def labels(self, camera: Camera, pose: HeadPose, mask: ByteArray | None) -> ByteArray:
        """(H, W) 8-bit, one bit for each region that a pixel is in; see `select`. ``mask`` is the (H, W) 8-bit
        coverage; with None nothing is foreground."""
        front = rasterize_mesh(self._subject.meshes([pose])[0], self._head.faces, camera).face
        covered = front >= 0
        labels = np.where(covered, self._bits_of_faces[np.maximum(front, 0)], 0).astype(np.uint8)
        foreground = np.ones(front.shape, bool) if mask is None else mask >= 128
        mouth = _hull(labels & _BITS["mouth"] != 0) & foreground
        labels[mouth] |= _BITS["mouth"] | _BITS["face"]
        if mask is not None:
            labels[foreground] |= _BITS[FOREGROUND]
            labels[_beyond(covered, labels & _BITS["hair"] != 0) & foreground] |= _BITS["hair"]
        return labels

    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W) distance of the mesh along the camera's axis, metres; infinity beside it."""
        return rasterize_mesh(self._subject.meshes([pose])[0], self._head.faces, camera).depth

    @cached_property
    def _subject(self) -> PosedSubject:
        return PosedSubject(self._head, self._shape, self._offset)

    @cached_property
    def _bits_of_faces(self) -> IntArray:
        """(F,) bits of the parts that contain at least two corners of a triangle, so that seams have no gaps."""
        regions, faces = self._head.regions, self._head.faces
        bits = np.zeros(len(faces), dtype=np.uint8)
        for name in self.names:
            inside = np.zeros(len(self._head.template), dtype=bool)
            for region in regions.keys() & set(PARTS[name]):
                inside[regions[region]] = True
            if name == "hair":
                # The scalp of FLAME's masks runs into face and neck.
                for region in regions.keys() & {"face", "neck"}:
                    inside[regions[region]] = False
            bits[inside[faces].sum(axis=1) >= 2] |= _BITS[name]
        return bits


def select(labels: ByteArray, name: str) -> BoolArray:
    """(H, W) mask of one region from the bits of `HeadRegions.labels`."""
    return (labels & _BITS[name]) != 0


def _hull(seen: BoolArray) -> BoolArray:
    """Fill the convex hull of some pixels."""
    points = cv2.findNonZero(seen.astype(np.uint8))
    if points is None:
        return seen
    filled = np.zeros(seen.shape, np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled != 0


def _beyond(covered: BoolArray, part: BoolArray) -> BoolArray:
    """Pixels that are not covered and whose nearest covered pixel is in a part."""
    if not part.any():
        return part
    _, nearest = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    is_part = np.zeros(int(nearest.max()) + 1, dtype=bool)
    is_part[nearest[part]] = True
    return np.asarray(is_part[nearest] & ~covered)


class FrameFiles(NamedTuple):
    """Files of a frame's pixels, and its recorded key if a step changed the key. A clip of an external reader may have
    no files; its pixels come from `CaptureClip.source`."""

    image: Path | None
    mask: Path | None
    recorded: FrameKey | None = None


class FramePixels(NamedTuple):
    """A frame between pixel steps, not yet rounded to 8 bits."""

    image: FloatArray  # (H, W, 3) float32 in [0, 1], composited on the current background
    coverage: FloatArray | None  # (H, W) float32 in [0, 1]; None without a mask, also after all steps


PixelStep = Callable[[FrameKey, FramePixels], FramePixels]
"""Changes the pixels of a frame, which is given by its recorded key."""


@dataclass(frozen=True, eq=False)
class CaptureClip:
    """A `Clip` whose images are read from disk on request."""

    subject: str
    head: HeadArrays
    shape: FloatArray
    static_offset: FloatArray
    cameras: Mapping[str, Camera]
    poses: Mapping[int, HeadPose]
    splits: Mapping[str, tuple[FrameKey, ...]]
    excluded: Mapping[FrameKey, str]
    background: FloatArray
    steps: Sequence[StepRecord]
    files: Mapping[FrameKey, FrameFiles]
    """Files of every frame, including excluded frames. Pixel steps change these pixels for methods."""
    source_fingerprint: str
    """Digest of the content of all files of the clip, independent of their location."""
    store: ImageStore
    """Decodes images and bounds their memory; shared by clips derived from one another."""
    pixel_steps: tuple[PixelStep, ...] = ()
    """Steps applied in order when a frame is read, with one rounding to 8 bits at the end."""
    read_background: FloatArray | None = None
    """Colour that straight-alpha files are composited on before the pixel steps; None means `background`."""
    source: Clip | None = None
    """The clip that gives the pixels of frames without files, see `as_capture`."""

    @cached_property
    def frame_at(self) -> Mapping[tuple[int, str], FrameKey]:
        """The frame of each timestep and camera, excluded ones among them."""
        return {(key.timestep, key.camera): key for key in self.files}

    def __repr__(self) -> str:
        cameras, frames = len(self.cameras), {name: len(keys) for name, keys in self.splits.items()}
        return f"{type(self).__name__}({self.subject!r}, cameras: {cameras}, frames: {frames})"

    @cached_property
    def fingerprint(self) -> str:
        """Hex digest of the files' content, the steps with their parameters, and the splits."""
        splits = {name: [str(key) for key in keys] for name, keys in self.splits.items()}
        excluded = {str(key): reason for key, reason in self.excluded.items()}
        return digest(self.source_fingerprint, [*self.steps], splits, excluded, self.background)

    def image(self, key: FrameKey) -> ByteArray:
        """(H, W, 3) 8-bit sRGB, composited on `background`; read-only, shared with the store. Raises `InputError` for a
        key the clip does not have."""
        if self.pixel_steps:
            return self._processed(key, "image")
        files = self._files(key)
        if files.image is None:
            return self._source.image(files.recorded or key)
        return self.store.image(files.image, self.background)

    def mask(self, key: FrameKey) -> ByteArray | None:
        """(H, W) 8-bit foreground coverage, read-only; None if the capture has none."""
        if not self.has_mask(key):
            return None
        if self.pixel_steps:
            return self._processed(key, "mask")
        files = self._files(key)
        return self._source.mask(files.recorded or key) if files.mask is None else self.store.mask(files.mask)

    def has_mask(self, key: FrameKey) -> bool:
        """Whether a frame has a mask; files are not decoded."""
        files = self._files(key)
        return files.mask is not None if files.image is not None else self._source_has_masks

    @cached_property
    def region_names(self) -> tuple[str, ...]:
        """Regions of `region_masks` for this clip."""
        masked = all(map(self.has_mask, self.files))
        return ((FOREGROUND,) if masked else ()) + self._head_regions.names

    def region_masks(self, key: FrameKey, names: Sequence[str]) -> dict[str, BoolArray]:
        """(H, W) masks of the pixels in which each region is visible."""
        labels = self.store.find((self.fingerprint, key, "regions"))
        if labels is None:
            camera, pose = self.cameras[key.camera], self.poses[key.timestep]
            labels = self._head_regions.labels(camera, pose, self.mask(key))
            self.store.keep((self.fingerprint, key, "regions"), labels)
        return {name: select(labels, name) for name in names}

    def timesteps(self, split: str) -> list[int]:
        """Distinct timesteps of a split, sorted."""
        return sorted({key.timestep for key in self.splits[split]})

    def derive(self, step: str, parameters: Mapping[str, Any], **changes: Any) -> CaptureClip:
        """Copy with some fields changed and the step recorded."""
        record = StepRecord(step, parameters, self.fingerprint)
        return replace(self, steps=(*self.steps, record), **changes)

    def to_render(
        self,
        step: str,
        parameters: Mapping[str, Any],
        keys: Sequence[FrameKey],
        poses: Mapping[int, HeadPose],
        cameras: Mapping[str, Camera],
    ) -> CaptureClip:
        """Copy with other frames, which are to be rendered and have no pixels; the step is recorded."""
        return self.derive(
            step,
            parameters,
            cameras=cameras,
            poses={timestep: replace(pose, timestep=timestep) for timestep, pose in poses.items()},
            splits={"train": (), "novel_view": (), "self_reenactment": tuple(keys)},
            files=dict.fromkeys(keys, FrameFiles(None, None)),
            excluded={},
        )

    def derive_pixels(
        self, step: str, parameters: Mapping[str, Any], change: PixelStep, **changes: Any
    ) -> CaptureClip:
        """Copy with one more pixel step, which is recorded."""
        ground = self.background if self.read_background is None else self.read_background
        steps = (*self.pixel_steps, change)
        return self.derive(step, parameters, pixel_steps=steps, read_background=ground, **changes)

    def recorded(self, key: FrameKey) -> FrameKey:
        """The recorded key of a frame, which differs if a step renumbered the frames."""
        return self._files(key).recorded or key

    @cached_property
    def _head_regions(self) -> HeadRegions:
        return HeadRegions(self.head, self.shape, self.static_offset)

    def _processed(self, key: FrameKey, part: Literal["image", "mask"]) -> ByteArray:
        """Image or mask of a frame after all pixel steps, read-only; both are cached because they are computed together."""
        cached = self.store.find((self.fingerprint, key, part))
        if cached is not None:
            return cached
        files = self._files(key)
        ground = self.background if self.read_background is None else self.read_background
        if files.image is None:
            recorded = files.recorded or key
            image, mask = self._source.image(recorded), self._source.mask(recorded)
        else:
            image = read_image(files.image, ground)
            mask = None if files.mask is None else read_mask(files.mask, own=files.mask == files.image)
        pixels = FramePixels(_unit_range(image), None if mask is None else _unit_range(mask))
        for change in self.pixel_steps:
            pixels = change(files.recorded or key, pixels)
        parts = {"image": quantise(pixels.image)}
        if pixels.coverage is not None:
            parts["mask"] = quantise(pixels.coverage)
        for name, array in parts.items():
            self.store.keep((self.fingerprint, key, name), array)
        return parts[part]

    @property
    def _source(self) -> Clip:
        assert self.source is not None, "frames without files come from a source"
        return self.source

    @cached_property
    def _source_has_masks(self) -> bool:
        """Checked for one frame, since all or no frames of a clip have a mask."""
        return (
            self._source.mask(next(key for keys in self._source.splits.values() for key in keys)) is not None
        )

    def _files(self, key: FrameKey) -> FrameFiles:
        try:
            return self.files[key]
        except KeyError:
            raise InputError("clip", "frame key", f"a frame of subject {self.subject}", str(key)) from None


def without_images(head: HeadArrays, poses: Mapping[int, HeadPose]) -> dict[str, Any]:
    """Fields of a clip of poses alone: no cameras, no images, no static offset, a white background."""
    return {
        "head": head,
        "static_offset": np.zeros(head.template.shape),
        "poses": poses,
        "cameras": {},
        "excluded": {},
        "background": np.ones(3),
        "steps": (),
        "source_fingerprint": "",
        "store": ImageStore(),
    }


def check_apart(clip: CaptureClip, out: Path) -> None:
    """Raise `InputError` if images of a capture are in the output folder."""
    images = [files.image for files in clip.files.values() if files.image is not None]
    if any(out.resolve() in image.resolve().parents for image in images):
        raise InputError("command line", "--out", "a folder outside the capture", str(out))


def as_capture(clip: Clip) -> CaptureClip:
    """Any clip as a `CaptureClip` for steps and commands; a `CaptureClip` is returned unchanged. Pixels are read from
    ``clip``."""
    if isinstance(clip, CaptureClip):
        return clip
    where = f"clip {clip.subject}"
    if not isinstance(clip.head, HeadAsset):
        raise InputError(where, "head", "a head model in FLAME's layout", type(clip.head).__name__)
    regions = {name: np.asarray(members) for name, members in clip.head.regions.items()}
    arrays: dict[str, Any] = {name: np.asarray(getattr(clip.head, name)) for name in STORED}
    arrays |= {name: getattr(clip.head, name, None) for name in OPTIONAL}
    head = HeadArrays(clip.head.version, **arrays, regions=regions)
    head.validate(where)
    sizes = {"S": head.shape_basis.shape[2], "E": head.expression_basis.shape[2], "V": len(head.template)}
    identity = {"shape": Member("f", ("S",)), "static_offset": Member("f", ("V", 3))}
    check_arrays(where, {name: np.asarray(getattr(clip, name)) for name in identity}, identity, sizes)
    for timestep, pose in clip.poses.items():
        expression = {"expression": np.asarray(pose.expression)}
        check_arrays(f"{where}, timestep {timestep}", expression, {"expression": Member("f", ("E",))}, sizes)
    keys = [key for part in clip.splits.values() for key in part]
    return CaptureClip(
        subject=clip.subject,
        head=head,
        shape=np.asarray(clip.shape),
        static_offset=np.asarray(clip.static_offset),
        cameras=clip.cameras,
        poses=clip.poses,
        splits=clip.splits,
        excluded=clip.excluded,
        background=np.asarray(clip.background, np.float64),
        steps=tuple(clip.steps),
        files=dict.fromkeys([*keys, *clip.excluded], FrameFiles(None, None)),
        source_fingerprint=clip.fingerprint,
        store=ImageStore(),
        source=clip,
    )


def _unit_range(levels: ByteArray) -> FloatArray:
    return levels.astype(np.float32) / np.float32(255)
