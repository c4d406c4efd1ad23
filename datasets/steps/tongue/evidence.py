"""Evidence of objects in front of lips and chin, in every pixel of the mouth's map.

The cue is pigment. Melanin, which colours skin and (less) lips, absorbs more blue than green; blood absorbs both
equally. The tongue has blood and no melanin, so its green to blue ratio is below that of the surrounding skin, whereas
blush, pallor, wrinkles, shadows and an open mouth do not change that ratio of skin and lips. (Absorption: S. Jacques,
"Optical properties of biological tissues: a review", Physics in Medicine and Biology 58, 2013, section 3.)

Every comparison is with the subject's canonical map (the median over timesteps), camera by camera, and tolerates
tracking errors: a pixel counts only if no pixel within `FORGIVEN` of its position looks similar.

A contact sheet for review: mouths by score, with outlines of covered areas and the decision as a frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray
from ....bench.io.figures import pixels
from ...images import srgb_to_linear, write_image
from ...inspect.figure import new_figure, shortened, show
from ..exclude import Exclusions, FrameDecision
from .mouth import PITCH, MouthAtlas, MouthColours, frames_by_timestep, posed_meshes

FORGIVEN = 0.003
"""Metres within which the canonical map is searched for a pixel's colour: three times a tracker's usual error."""

LOOKS = 3.0
"""Minimum standard deviations of covered pixels."""

CONNECTED = 8.0
"""Maximum distance below the line between the lips at which an object from the mouth must start, millimetres. The
first three are blind because `FORGIVEN` matches them with the dark of the closed mouth."""

PIGMENT_LOST = 0.35
"""Minimum position of a pixel between the skin's green to blue ratio (0) and that of tissue without melanin (1):
flushed, shaded lips reach a quarter, a tongue more than half."""

_LEAST_PIGMENT = 0.1  # log units; for paler skin, noise would dominate
_DARK = 0.001  # linear light added to every channel: below it ratios are noise
_DARKER, _PALER = 1.0, 0.25  # log units that a tongue may be darker, or less red, than what is nearby
_FLOORS = {"pink": 0.02, "red": 0.05, "light": 0.10}  # least spread, log units: quantisation and image noise
_LEAST_SEEN = 0.2  # minimum fraction of timesteps in which a pixel with a canonical colour is visible
_LIMIT = 6.0  # upper limit of standard deviations


@dataclass(frozen=True, eq=False)
class MouthEvidence:
    """Evidence in T timesteps."""

    areas: FloatArray
    """(T,) mm² of the largest covered patch that begins at the mouth; 0 without one."""
    patches: np.ndarray
    """(T, H, W) pixels of that patch."""
    strength: FloatArray
    """(T, H, W) float16 standard deviations by which each pixel looks covered; 0 if not seen."""
    seen: FloatArray
    """(T,) fraction of the lower lip visible to some camera."""


def find_evidence(colours: MouthColours, atlas: MouthAtlas) -> MouthEvidence:
    """Search for objects in front of the mouth, camera by camera, and combine the results."""
    count, cameras = colours.seen.shape[:2]
    total = np.zeros((count, *atlas.inside.shape), np.float32)
    looks = np.zeros((count, *atlas.inside.shape), np.uint8)
    for camera in range(cameras):
        strength, known = _camera_strength(colours.colours[:, camera], colours.seen[:, camera], atlas)
        total += strength
        looks += known
    # The mean of bounded values: an object that only one camera sees in front of the skin is not on it.
    strength = total / np.maximum(looks, 1)
    patches = np.stack([mouth_patch(part, atlas) for part in strength])
    areas = patches.sum(axis=(1, 2)) * (PITCH * 1e3) ** 2
    lip = atlas.lips & atlas.below
    seen = (looks[:, lip] > 0).mean(axis=1)
    return MouthEvidence(areas, patches, strength.astype(np.float16), seen)


def mouth_patch(strength: FloatArray, atlas: MouthAtlas) -> np.ndarray:
    """(H, W) the largest connected patch of covered pixels that begins at the mouth's opening. The region between the
    patch and the opening belongs to it, since a tongue comes out of the mouth."""
    labels, count = ndimage.label((strength > LOOKS) & atlas.below, np.ones((3, 3)))
    opening = atlas.below & (atlas.height > -CONNECTED) & (atlas.lips & atlas.below).any(axis=0)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[~np.isin(np.arange(count + 1), labels[opening])] = 0
    sizes[0] = 0
    if not sizes.any():
        return np.zeros(atlas.inside.shape, bool)
    patch = labels == sizes.argmax()
    above = np.cumsum(patch[::-1], axis=0)[::-1] > 0  # at or above the patch's lowest pixel in its column
    return atlas.below & above


def _camera_strength(
    colours: ByteArray, seen: np.ndarray, atlas: MouthAtlas
) -> tuple[FloatArray, np.ndarray]:
    """(T, H, W) standard deviations by which each pixel looks covered to one camera, and whether it is visible."""
    measured = seen & (seen.mean(axis=0) > _LEAST_SEEN)
    rows = measured.any(axis=(1, 2))
    strength = np.zeros(measured.shape, np.float32)
    if rows.any():
        strength[rows] = _strength(_features(colours[rows], seen[rows]), measured[rows])
    return strength, measured


def _strength(values: dict[str, FloatArray], known: np.ndarray) -> FloatArray:
    """(T, H, W) strength from features; every timestep has something known."""
    size = 2 * round(FORGIVEN / PITCH) + 1
    enough = known.any(axis=0)
    spread, lowest = {}, {}
    for name, value in values.items():
        value[~known] = np.nan
        canonical = np.zeros(enough.shape, np.float32)
        canonical[enough] = np.nanmedian(value[:, enough], axis=0)
        # Compensates light and white balance, or a flush of the whole face.
        value -= np.nanmedian((value - canonical)[:, enough], axis=1)[:, None, None]
        deviation = np.zeros_like(canonical)
        deviation[enough] = 1.4826 * np.nanmedian(np.abs(value - canonical)[:, enough], axis=0)
        spread[name] = np.maximum(cv2.blur(deviation, (5, 5)), _FLOORS[name])
        nearby = cv2.erode(np.where(enough, canonical, np.inf).astype(np.float32), np.ones((size, size)))
        lowest[name] = np.where(enough, nearby, 0.0)
    strength = np.clip((lowest["pink"] - values["pink"]) / spread["pink"], -_LIMIT, _LIMIT)
    not_pale = values["red"] > lowest["red"] - _PALER
    not_dark = values["light"] > lowest["light"] - _DARKER
    lost = lowest["pink"] - values["pink"] > PIGMENT_LOST * np.maximum(lowest["pink"], _LEAST_PIGMENT)
    strength = np.where(lost & not_pale & not_dark, strength, np.minimum(strength, 0))
    covered: FloatArray = np.where(known, strength, 0).astype(np.float32)
    return covered


def _features(colours: ByteArray, seen: np.ndarray) -> dict[str, FloatArray]:
    """(T, H, W) float32 log ratios of smoothed linear colours: ``pink`` (green to blue), ``red`` (red to green),
    and ``light`` (brightness)."""
    linear = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
    weight = seen.astype(np.float32)
    total = ndimage.uniform_filter(weight, (0, 3, 3))
    sums = [ndimage.uniform_filter(linear[colours[..., i]] * weight, (0, 3, 3)) for i in range(3)]
    red, green, blue = (np.log(channel / np.maximum(total, 0.1) + _DARK) for channel in sums)
    return {"pink": green - blue, "red": red - green, "light": np.logaddexp(red, green)}


NEVER, ALWAYS = 20.0, 60.0
"""mm². Covered areas up to the first are attributed to tracking errors: an error of one pixel of the map along a
quarter of a lip of 50 mm gives as much. The second is a third of the lower lip."""

NEAR = 1.5
"""Factor around the threshold within which a decision should be reviewed."""

TONGUE = "tongue out"
_SEEN = 0.25  # minimum visible fraction of the lower lip


def choose_threshold(areas: FloatArray) -> tuple[float, str]:
    """Threshold in mm² for a subject's areas (T,), and how it was found.

    Between `NEVER` and `ALWAYS` it is the middle (of logarithms) of the widest gap between neighbouring areas:
    where another choice would change the fewest decisions.
    """
    inside = np.sort(areas[(areas > NEVER) & (areas < ALWAYS)])
    edges = np.log(np.concatenate([[NEVER], inside, [ALWAYS]]))
    widest = int(np.argmax(np.diff(edges)))
    threshold = float(np.exp(0.5 * (edges[widest] + edges[widest + 1])))
    between = f"{np.exp(edges[widest]):.0f} and {np.exp(edges[widest + 1]):.0f} mm2"
    basis = f"middle of the widest gap, {between}; {len(inside)} frames between {NEVER:g} and {ALWAYS:g} mm2"
    return round(threshold, 1), basis


def decide(
    timesteps: Mapping[int, str],
    evidence: MouthEvidence,
    cameras: tuple[str, ...],
    threshold: float | None,
    overrides: Mapping[int, str],
) -> Exclusions:
    """Decide every timestep. ``timesteps``: Sequence by timestep, in the order of the evidence. ``threshold``: mm²;
    None chooses one automatically. ``overrides``: Manual decisions, see `Exclusions`."""
    basis = "given"
    if threshold is None:
        threshold, basis = choose_threshold(evidence.areas)
    frames = {}
    for (timestep, sequence), area, seen in zip(timesteps.items(), evidence.areas.tolist(), evidence.seen):
        excluded = area >= threshold
        reason = _reason(area, threshold, float(seen))
        frames[timestep] = FrameDecision(sequence, round(area, 1), excluded, reason)
    return Exclusions(threshold, basis, cameras, frames, dict(overrides))


def _reason(area: float, threshold: float, seen: float) -> str:
    if area >= threshold:
        near = ", near the threshold" if area < NEAR * threshold else ""
        return f"{TONGUE}: {area:.0f} mm2 of lip and chin covered{near}"
    if seen < _SEEN:
        return f"mouth not seen: {100 * seen:.0f} % of the lower lip"
    return "near the threshold" if area * NEAR >= threshold else ""


EXCLUDED_COLOUR, KEPT_COLOUR, REVIEWED_COLOUR = "#c82828", "#3c8c50", "#e19614"
OUTLINE = (0, 255, 255)
TILE, COLUMNS = 168, 8


def write_sheet(
    path: Path,
    clip: Clip,
    atlas: MouthAtlas,
    evidence: MouthEvidence,
    timesteps: Sequence[int],
    decided: Exclusions,
    count: int,
) -> None:
    """Write a PNG of the ``count`` timesteps with the highest scores, atomically, highest first.

    ``timesteps`` are those of the evidence, in its order.

    Overrides are shown however low their score. A frame is red where the timestep is left out, green where it is
    kept, and has an orange bar where the score is near the threshold. Each mouth is shown by the first of
    ``decided.cameras`` that has the timestep.
    """
    reasons = decided.reasons()
    # Among equal scores, mostly zeros, prefer those next to an excluded frame, where the tongue appears and disappears.
    away = [min((abs(t - other) for other in reasons), default=0) for t in timesteps]
    order = sorted(range(len(timesteps)), key=lambda row: (-float(evidence.areas[row]), away[row]))
    displayed = order[:count] + [row for row in order[count:] if timesteps[row] in decided.overrides]
    place = {timesteps[row]: number for number, row in enumerate(displayed)}
    frames = frames_by_timestep(clip)
    columns = min(COLUMNS, max(len(displayed), 4))
    rows = -(-len(displayed) // columns)
    with new_figure(1.9 * columns, 0.8 + 2.4 * rows) as figure:
        figure.suptitle(
            f"{clip.subject}: {len(reasons)} of {len(timesteps)} timesteps left out (red), threshold "
            f"{decided.threshold:g} mm2 of lip and chin covered\n"
            f"The {len(displayed)} highest scores, outlined what looks covered; "
            "an orange bar marks scores near the threshold."
        )
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid[len(displayed) :]:
            axes.axis("off")
        for timestep, vertices in posed_meshes(clip, sorted(place)):
            axes, row = grid[place[timestep]], displayed[place[timestep]]
            name = next(name for name in decided.cameras if name in frames[timestep])
            image, camera = clip.image(frames[timestep][name]), clip.cameras[name]
            show(axes, mouth_picture(image, camera, atlas, vertices, evidence.patches[row]), frame=True)
            axes.spines[:].set(color=EXCLUDED_COLOUR if timestep in reasons else KEPT_COLOUR, linewidth=5)
            frame, word = decided.frames[timestep], decided.overrides.get(timestep)
            if "near the threshold" in frame.reason and word is None:
                axes.spines["bottom"].set(color=REVIEWED_COLOUR, linewidth=9)
            score = f"{timestep}  {frame.score:.0f} mm2" + (f"  by hand: {word}" if word else "")
            axes.set_xlabel(
                f"{shortened(score, 28)}\n{shortened(frame.sequence, 28)}", fontsize=8, loc="left"
            )
        write_image(path, pixels(figure))


def mouth_picture(
    image: ByteArray, camera: Camera, atlas: MouthAtlas, vertices: FloatArray, patch: np.ndarray
) -> ByteArray:
    """(TILE, TILE, 3) enlarged mouth in an image, the map's pixels of ``patch`` (H, W) outlined."""
    local = atlas.points(vertices) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    scale = TILE / float((high - low).max() * 1.1)
    corner = 0.5 * (low + high) - 0.5 * TILE / scale
    # Pixel i of the image has its centre at i + 0.5, which comes to scale (i + 0.5 - corner) - 0.5 as an index.
    shift = scale * (0.5 - corner) - 0.5
    matrix = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    interpolation = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    constant, white = cv2.BORDER_CONSTANT, (255, 255, 255)
    picture = cv2.warpAffine(
        image, matrix, (TILE, TILE), flags=interpolation, borderMode=constant, borderValue=white
    )
    covered = np.zeros((TILE, TILE), np.uint8)
    radius = max(1, round(0.75 * PITCH * camera.K[0, 0] / float(np.median(local[:, 2])) * scale))
    for x, y in np.round(scale * (pixels[patch[atlas.inside]] - corner) - 0.5).astype(int):
        cv2.circle(covered, (int(x), int(y)), radius, 1, -1)
    contours, _ = cv2.findContours(covered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlined = np.array(picture, np.uint8)
    cv2.drawContours(outlined, contours, -1, OUTLINE, 1)
    return outlined
