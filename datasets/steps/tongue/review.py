"""A contact sheet for review: mouths by score, with outlines of covered areas and the decision as a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray
from ....bench.io.figures import pixels
from ...figures import new_figure, shortened, show
from ...images import write_image
from ..exclude import Exclusions
from .evidence import MouthEvidence
from .mouth import PITCH, MouthAtlas, frames_by_timestep, posed_meshes

OUT, KEPT, NEAR = "#c82828", "#3c8c50", "#e19614"
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
    shown = order[:count] + [row for row in order[count:] if timesteps[row] in decided.overrides]
    place = {timesteps[row]: number for number, row in enumerate(shown)}
    frames = frames_by_timestep(clip)
    columns = min(COLUMNS, max(len(shown), 4))
    rows = -(-len(shown) // columns)
    with new_figure(1.9 * columns, 0.8 + 2.4 * rows) as figure:
        figure.suptitle(
            f"{clip.subject}: {len(reasons)} of {len(timesteps)} timesteps left out (red), threshold "
            f"{decided.threshold:g} mm2 of lip and chin covered\n"
            f"The {len(shown)} highest scores, outlined what looks covered; "
            "an orange bar marks scores near the threshold."
        )
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid[len(shown) :]:
            axes.axis("off")
        for timestep, vertices in posed_meshes(clip, sorted(place)):
            axes, row = grid[place[timestep]], shown[place[timestep]]
            name = next(name for name in decided.cameras if name in frames[timestep])
            image, camera = clip.image(frames[timestep][name]), clip.cameras[name]
            show(axes, mouth_picture(image, camera, atlas, vertices, evidence.patches[row]), frame=True)
            axes.spines[:].set(color=OUT if timestep in reasons else KEPT, linewidth=5)
            frame, word = decided.frames[timestep], decided.overrides.get(timestep)
            if "near the threshold" in frame.reason and word is None:
                axes.spines["bottom"].set(color=NEAR, linewidth=9)
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
