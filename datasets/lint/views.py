"""Facts on decoded frames (colours, mask, and where the tracked mesh lies), and search for near-duplicate images.

Frames of one camera are similar, so a perceptual hash alone gives false positives. The hash is a difference hash
(signs of horizontal steps of brightness); a candidate pair counts if the thumbnails differ by less than re-saving an
image changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.io.images import ImageInfo
from ..ga.transforms import FrameEntry
from ..head.geometry import project, rigid_alignment
from ..mesh_pictures import rasterize_mesh
from .capture import INNER, Capture, TrackedSubject

BACKGROUND_LEVELS = 12
"""Maximum difference of any channel of background pixels; JPEG changes flat areas by less."""

FLAT_LEVELS, ROOM = 3, 0.02
"""Maximum difference from the median in corners of one colour, and maximum fraction of other pixels in them."""

BLANK_LEVELS = 2.0
"""Images with less `structure` have a single colour."""

SENSOR_NOISE = 20.0
"""Levels; larger variation from pixel to pixel is texture."""

FAR = 0.02
"""Minimum distance of background pixels from the foreground, as a fraction of the image's height."""

SOFT = (0.25, 0.75)
"""Range of coverage of soft pixels, which show how a mask was composited."""

MIN_FRINGE_PIXELS = 12

BLANK_COVERAGE = 0.001

MASK_LEVELS = (12, 240)
"""Maximum level of what is outside a mask, and minimum level of what is inside."""

FACE = ("face", "forehead", "nose")
"""Regions that neither hair nor cloth should cover, whose mesh must be inside the foreground."""

NOT_SKIN = ("lips", "eye_region", *INNER)

SLACK = 0.04
"""Distance outside the foreground that a vertex of the face may have, relative to the mesh's height in the
image."""

WORKING_HEIGHT = 400
"""Maximum height of filled meshes in pixels, since only coarse values are needed."""

MIN_SKIN_PIXELS = 12
MESH_FAR = 0.2
"""Distance from the mesh relative to its height in the image: about 6 cm, more than most hair."""


@dataclass(frozen=True, eq=False)
class MeshFacts:
    """The posed mesh of one frame relative to its camera."""

    vertices: FloatArray
    """(V, 3) in the world of the frame's sequence, metres."""
    camera: Camera
    """Camera of the frame, at the image's size."""
    distance: float
    """Distance from the camera to the mesh's centre, metres."""
    depth: float
    """Depth of that centre along the viewing direction; negative behind the camera."""
    upright: float
    """Cosine of the angle between the upward directions of image and head."""
    facing: float
    """Cosine of the angle between the face's direction and the direction from head to camera."""
    face_outside: float | None = None
    """Fraction of the face's vertices outside of the foreground; this and the next three are None without a mask."""
    overlap: float | None = None
    """Intersection over union of mesh and foreground."""
    size: float | None = None
    """Area of the mesh divided by that of the foreground."""
    far: float | None = None
    """Fraction of the foreground that is farther from the mesh than `MESH_FAR`."""
    skin: FloatArray | None = None
    """Median colour (3,) of the face's visible skin, 8-bit levels; None if little of it is visible."""


def compare_mesh(
    subject: TrackedSubject, pose: HeadPose, camera: Camera, image: ByteArray, mask: ByteArray | None
) -> MeshFacts:
    """Pose the subject's mesh and compare it with an image, (H, W, 3) RGB, and its mask, (H, W)."""
    vertices = subject.meshes([pose])[0]
    turn = camera.world_to_camera[:3, :3]
    centre = vertices.mean(axis=0)
    towards = camera.center - centre
    # Axes of the template for the posed mesh, estimated from the face, in rows.
    face = _members(subject, FACE)
    head = rigid_alignment(vertices[face], subject.head.template[face])[:3, :3]
    distance = float(np.linalg.norm(towards))
    plain = MeshFacts(
        vertices=vertices,
        camera=camera,
        distance=distance,
        depth=float((turn @ centre + camera.world_to_camera[:3, 3])[2]),
        upright=float(-turn[1] @ head[1]),
        facing=float(head[2] @ towards / max(distance, 1e-9)),
    )
    if plain.depth <= 0:
        return plain
    return _compare_mask(plain, subject, image, mask)


def _members(subject: TrackedSubject, names: tuple[str, ...]) -> IntArray:
    """Vertices of the regions with these names; all vertices if the head has none of them."""
    regions = [subject.head.regions[name] for name in names if name in subject.head.regions]
    return np.unique(np.concatenate(regions)) if regions else np.arange(len(subject.head.template))


def _compare_mask(
    plain: MeshFacts, subject: TrackedSubject, image: ByteArray, mask: ByteArray | None
) -> MeshFacts:
    camera, vertices = plain.camera, plain.vertices
    scale = min(1.0, WORKING_HEIGHT / camera.height)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    small = camera.resized(width, height)
    front = rasterize_mesh(vertices, subject.head.faces, small).face
    filled = front >= 0
    size = (width, height)
    foreground = None
    if mask is not None:
        foreground = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 127
    picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    skin = _skin(subject, front, picture, foreground)
    if foreground is None or not foreground.any():
        return replace(plain, skin=skin)
    return replace(
        plain,
        skin=skin,
        overlap=float((filled & foreground).sum() / (filled | foreground).sum()),
        size=float(filled.sum() / foreground.sum()),
        far=_far(filled, foreground),
        face_outside=_face_outside(subject, vertices, small, filled, foreground),
    )


def _skin(
    subject: TrackedSubject, front: IntArray, image: ByteArray, foreground: np.ndarray | None
) -> FloatArray | None:
    member = np.zeros(len(subject.head.template), dtype=bool)
    member[_members(subject, FACE)] = True
    for name in NOT_SKIN:
        member[subject.head.regions.get(name, [])] = False
    shows = (front >= 0) & member[subject.head.faces[np.maximum(front, 0)]].all(axis=2)
    if foreground is not None:
        shows &= foreground
    return np.median(image[shows], axis=0) if shows.sum() >= MIN_SKIN_PIXELS else None


def _far(filled: np.ndarray, foreground: np.ndarray) -> float:
    rows = np.flatnonzero(filled.any(axis=1))
    if not len(rows):
        return 1.0
    distance = cv2.distanceTransform((~filled).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float((distance[foreground] > MESH_FAR * (rows[-1] - rows[0] + 1)).mean())


def _face_outside(
    subject: TrackedSubject, vertices: FloatArray, camera: Camera, filled: np.ndarray, foreground: np.ndarray
) -> float:
    pixels = project(vertices[_members(subject, FACE)], camera)
    column, row = np.floor(np.clip(pixels, -1, 2**20)).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    if not inside.any():
        return 1.0
    distance = cv2.distanceTransform((~foreground).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    rows = np.flatnonzero(filled.any(axis=1))
    slack = SLACK * (rows[-1] - rows[0] + 1) if len(rows) else 0.0
    return float((distance[row[inside], column[inside]] > slack).mean())


@dataclass(frozen=True, eq=False)
class MaskFacts:
    """Facts on a frame's mask, and on the image outside of the subject."""

    low: int
    high: int
    coverage: float
    outside: FloatArray | None
    """Median colour (3,) far from the foreground, 8-bit levels; None if there are no such pixels."""
    outside_off: float
    """Fraction of those pixels that differ from the declared background."""
    inside_empty: float
    """Fraction of the foreground that has the background's colour."""
    fringe: float | None
    """Median over soft pixels of (I - (1-a) B) / (a F), the subject's measured contribution to the image over the
    expected one, with F the mean colour of the covered pixels nearby; 1 for a clean straight-alpha composite, a (0.5) for
    one premultiplied twice. None with too few soft pixels."""

    @property
    def other_levels(self) -> bool:
        """Whether nothing is covered fully, or everything a little."""
        return 0 < self.high < MASK_LEVELS[1] or MASK_LEVELS[0] < self.low <= 127

    @property
    def empty(self) -> bool:
        """Whether nothing is covered."""
        return self.coverage < BLANK_COVERAGE and not self.other_levels

    @property
    def full(self) -> bool:
        """Whether everything is covered."""
        return self.low > 127

    @property
    def inverted(self) -> bool:
        """Whether the background is covered."""
        return not self.full and self.inside_empty > 0.5 and self.outside_off > 0.3

    @property
    def sound(self) -> bool:
        """Whether it has none of these faults."""
        return not (self.other_levels or self.empty or self.full or self.inverted)


@dataclass(frozen=True, eq=False)
class ViewFacts:
    """Facts on one decoded frame."""

    entry: FrameEntry
    low: int = 0
    high: int = 0
    """Minimum and maximum level of any pixel's channels."""
    subject_low: int = 0
    subject_high: int = 0
    """Minimum and maximum over pixels fully covered by the subject."""
    grey: bool = False
    corners: FloatArray | None = None
    """Median colour (3,) of the upper corners."""
    corners_off: float = 0.0
    """Fraction of their pixels that differ from the declared background."""
    room: bool = False
    """Whether these pixels have several colours, as if a room is shown and no background was set."""
    blank: bool = False
    """Whether its pixels (the subject's if there is a mask) have no more contrast than noise."""
    has_alpha: bool = False
    """Whether the image has an alpha channel, which then is its mask."""
    mask: MaskFacts | None = None
    """None without a mask, or if it cannot be decoded or has another size."""
    mesh: MeshFacts | None = None
    """None if the frame has no pose or no head."""
    error: InputError | None = None
    """Why the image cannot be decoded; all other fields are then empty."""

    @property
    def has_sound_mask(self) -> bool:
        """Whether it has a mask that the geometry can be compared with."""
        return self.mask is not None and self.mask.sound


def pick_views(entries: Sequence[FrameEntry], count: int) -> list[FrameEntry]:
    """Up to ``count`` frames, evenly spaced over timesteps, with alternating cameras."""
    groups: dict[int, list[FrameEntry]] = {}
    for entry in sorted(entries, key=lambda e: (e.timestep, e.camera_index)):
        groups.setdefault(entry.timestep, []).append(entry)
    if not groups or count < 1:
        return []
    timesteps = sorted(groups)
    where = np.linspace(0, len(timesteps) - 1, count).round().astype(int)
    spread = (groups[timesteps[t]] for t in where)
    chosen = [group[i % len(group)] for i, group in enumerate(spread)]
    return list({id(entry): entry for entry in chosen}.values())


def inspect_views(capture: Capture, entries: Sequence[FrameEntry]) -> list[ViewFacts]:
    """Decode frames and keep the facts needed by the checks, without the pixels."""
    views = []
    for done, entry in enumerate(entries, start=1):
        capture.progress(done, len(entries), "looking at frames")
        try:
            image, mask = capture.pixels.image(entry), capture.pixels.mask(entry)
        except InputError as error:
            views.append(ViewFacts(entry, error=error))
            continue
        subject, pose = capture.subject, capture.pose(entry.timestep)
        mesh = None
        if subject is not None and pose is not None:
            mesh = compare_mesh(subject, pose, capture.camera(entry), image, mask)
        info = capture.headers[entry.image]
        views.append(_facts(entry, info, image, mask, mesh, capture.background))
    return views


def facing_camera(views: Sequence[ViewFacts]) -> str | None:
    """The most frontal camera."""
    facing: dict[str, list[float]] = {}
    for view in views:
        if view.mesh is not None and view.mesh.depth > 0:
            facing.setdefault(view.entry.camera_id, []).append(view.mesh.facing)
    return max(facing, key=lambda name: float(np.median(facing[name]))) if facing else None


def _facts(
    entry: FrameEntry,
    info: ImageInfo,
    image: ByteArray,
    mask: ByteArray | None,
    mesh: MeshFacts | None,
    background: Sequence[float],
) -> ViewFacts:
    ground = np.round(np.asarray(background) * 255).astype(np.int16)
    off = np.abs(image.astype(np.int16) - ground).max(axis=2) > BACKGROUND_LEVELS
    foreground = mask > 250 if mask is not None else off  # no mixture with the background
    pixels = image[foreground] if foreground.any() else image.reshape(-1, 3)
    width = max(1, info.width // 10)
    corners = np.zeros(off.shape, dtype=bool)
    corners[:width, :width] = corners[:width, -width:] = True
    colour = np.median(image[corners], axis=0)
    return ViewFacts(
        entry=entry,
        low=int(image.min()),
        high=int(image.max()),
        subject_low=int(pixels.min()),
        subject_high=int(pixels.max()),
        grey=bool((image == image[..., :1]).all()),
        corners=colour,
        room=float((np.abs(image[corners] - colour).max(axis=1) > FLAT_LEVELS).mean()) > ROOM,
        corners_off=float(off[corners].mean()),
        blank=_blank(image, foreground, off),
        has_alpha=info.has_alpha,
        mask=None if mask is None else _mask_facts(image, mask, off, ground),
        mesh=mesh,
    )


def _blank(image: ByteArray, foreground: np.ndarray, off: np.ndarray) -> bool:
    """Whether the subject's pixels have a single colour other than the background's (which indicates a wrong mask)."""
    grey = image.astype(np.float32).mean(axis=2)
    if structure(grey, np.ones_like(foreground)) < BLANK_LEVELS:
        return True
    return bool(
        foreground.any() and off[foreground].mean() > 0.5 and structure(grey, foreground) < BLANK_LEVELS
    )


def _mask_facts(image: ByteArray, mask: ByteArray, off: np.ndarray, ground: np.ndarray) -> MaskFacts:
    covered = mask > 127
    distance = cv2.distanceTransform((mask == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    far = (mask == 0) & (distance > FAR * len(mask)) if (mask > 0).any() else mask == 0
    return MaskFacts(
        low=int(mask.min()),
        high=int(mask.max()),
        coverage=float(covered.mean()),
        outside=np.median(image[far], axis=0) if far.any() else None,
        outside_off=float(off[far].mean()) if far.any() else 0.0,
        inside_empty=float((~off)[covered].mean()) if covered.any() else 0.0,
        fringe=_fringe(image, mask, ground),
    )


def _fringe(image: ByteArray, mask: ByteArray, ground: np.ndarray) -> float | None:
    """See `MaskFacts.fringe`."""
    alpha = mask.astype(np.float32) / 255
    inner = (alpha > 0.98).astype(np.float32)
    size = 2 * max(2, round(0.01 * len(mask))) + 1
    weight = cv2.blur(inner, (size, size))
    colours = image.astype(np.float32)
    nearby = cv2.blur(colours * inner[..., None], (size, size)) / np.maximum(weight, 1e-6)[..., None]
    expected = alpha * nearby.mean(axis=2)
    added = (colours - (1 - alpha)[..., None] * ground.astype(np.float32)).mean(axis=2)
    # A dark subject adds almost nothing to soft pixels.
    telling = (alpha > SOFT[0]) & (alpha < SOFT[1]) & (weight > 0.05) & (expected > 0.1 * 255 * alpha)
    if telling.sum() < MIN_FRINGE_PIXELS:
        return None
    return float(np.median(added[telling] / expected[telling]))


SIDE = 32
"""Thumbnails are square with this many pixels a side."""

HASH_DISTANCE = 0.1
"""Maximum fraction of different hash bits of near-duplicates."""

LEVELS = 2.0
"""Largest `difference` between two thumbnails of near-duplicates, 8-bit levels."""

SUBJECT_LEVELS = 4.0
"""Minimum difference of a thumbnail's pixel from the upper corners for the subject."""

_BLOCK = 2048


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """Thumbnail of a frame."""

    split: str
    entry: FrameEntry
    grey: FloatArray
    """(SIDE, SIDE) float32 levels."""
    bits: FloatArray
    """(SIDE * (SIDE - 1),) float32, +1 where brightness increases to the right by more than a level, else -1."""
    foreground: np.ndarray
    """(SIDE, SIDE) bool, whether it differs from the upper corners."""


def make_thumbnails(capture: Capture, limit: int) -> list[Thumbnail]:
    """Thumbnails of up to ``limit`` frames, an equal share of every split, evenly spaced in each."""
    imaged = {
        name: [e for e in entries if e.image in capture.headers] for name, entries in capture.splits.items()
    }
    splits = {name: entries for name, entries in imaged.items() if entries}
    chosen: list[tuple[str, FrameEntry]] = []
    for left, name in zip(range(len(splits), 0, -1), sorted(splits, key=lambda name: len(splits[name]))):
        entries = splits[name]
        count = min(len(entries), max(0, limit - len(chosen)) // left)
        chosen += [(name, entries[i]) for i in np.unique(np.linspace(0, len(entries) - 1, count).astype(int))]
    thumbnails = []
    for done, (name, entry) in enumerate(chosen, start=1):
        capture.progress(done, len(chosen), "comparing images")
        try:
            image = capture.pixels.image(entry)
        except InputError:
            continue  # damaged images are reported by other checks
        thumbnails.append(_shrink(name, entry, image))
    return thumbnails


def _shrink(split: str, entry: FrameEntry, image: np.ndarray) -> Thumbnail:
    small = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    grey = small.mean(axis=2)
    # The declared background may be wrong, so the corners are used.
    ground = np.median([small[0, 0], small[0, -1], small[1, 0], small[1, -1]], axis=0)
    bits = np.where(np.diff(grey, axis=1) > 1, 1.0, -1.0).astype(np.float32).ravel()
    return Thumbnail(split, entry, grey, bits, np.abs(small - ground).max(axis=2) > SUBJECT_LEVELS)


def near_duplicates(
    one: Sequence[Thumbnail], other: Sequence[Thumbnail]
) -> Iterator[tuple[Thumbnail, Thumbnail]]:
    """Pairs of near-duplicates, one from each list."""
    if not one or not other:
        return
    bits = np.stack([thumbnail.bits for thumbnail in other])
    for start in range(0, len(one), _BLOCK):
        block = one[start : start + _BLOCK]
        agreement = np.stack([thumbnail.bits for thumbnail in block]) @ bits.T / bits.shape[1]
        for i, j in np.argwhere(agreement >= 1 - 2 * HASH_DISTANCE):
            if difference(block[i], other[j]) <= LEVELS:
                yield block[i], other[j]


def difference(one: Thumbnail, other: Thumbnail) -> float:
    """95th percentile of the absolute difference, in levels, over the pixels that show the subject in either.

    A moving face differs strongly in few places, a re-saved image slightly everywhere. Infinite if both frames are
    empty, since these are no capture.
    """
    foreground = one.foreground | other.foreground
    if not foreground.any():
        return float("inf")
    return float(np.percentile(np.abs(one.grey - other.grey)[foreground], 95))


def structure(grey: FloatArray, mask: np.ndarray) -> float:
    """Standard deviation in levels of a smoothed image (H, W) over the pixels ``mask``, minus that expected from
    white noise: about 0 for pure noise."""
    if not mask.any():
        mask = np.ones_like(mask)
    size = max(3, len(grey) // 24)
    weight = cv2.blur(mask.astype(np.float32), (size, size))
    smooth = cv2.blur(grey * mask, (size, size)) / np.maximum(weight, 1e-6)
    noise = min(float(np.var((grey - smooth)[mask])), SENSOR_NOISE**2) / (size * size)
    return float(np.sqrt(max(0.0, float(np.var(smooth[mask])) - 2 * noise)))
