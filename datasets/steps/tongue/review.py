"""A contact sheet to review decisions by: mouths by score, what looks covered outlined, the decision as a frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ....bench.contracts import ByteArray, Camera, Clip, FloatArray
from ....bench.io.files import atomic_path
from ..exclude import Exclusions
from .evidence import MouthEvidence
from .mouth import PITCH, MouthAtlas, frames_by_timestep, posed_meshes

Colour = tuple[int, int, int]
OUT: Colour = (200, 40, 40)
KEPT: Colour = (60, 140, 80)
NEAR: Colour = (225, 150, 20)
INK: Colour = (30, 30, 30)
PAPER: Colour = (255, 255, 255)
OUTLINE: Colour = (0, 255, 255)

TILE, BORDER, GAP, COLUMNS = 168, 5, 8, 8
_TEXT, _TITLE = 13, 18
_LINES = 2  # of text under a tile


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
    kept, and has an orange bar where the score is near the threshold. Each mouth is as the first of
    ``decided.cameras`` that has the timestep sees it.
    """
    reasons = decided.reasons()
    # Among equal scores, mostly zeros, those next to a frame left out: there the tongue comes and goes.
    away = [min((abs(t - other) for other in reasons), default=0) for t in timesteps]
    order = sorted(range(len(timesteps)), key=lambda row: (-float(evidence.areas[row]), away[row]))
    shown = order[:count] + [row for row in order[count:] if timesteps[row] in decided.overrides]
    frames = frames_by_timestep(clip)
    tiles: dict[int, Image.Image] = {}
    by_timestep = {timesteps[row]: row for row in shown}
    for timestep, vertices in posed_meshes(clip, sorted(by_timestep)):
        row = by_timestep[timestep]
        camera = next(name for name in decided.cameras if name in frames[timestep])
        image = clip.image(frames[timestep][camera])
        mouth = mouth_picture(image, clip.cameras[camera], atlas, vertices, evidence.patches[row])
        frame = decided.frames[timestep]
        near = "near the threshold" in frame.reason and timestep not in decided.overrides
        notes = [f"{timestep}  {frame.score:.0f} mm2", frame.sequence]
        if timestep in decided.overrides:
            notes[0] += f"  by hand: {decided.overrides[timestep]}"
        tiles[row] = _tile(mouth, OUT if timestep in reasons else KEPT, near, notes)
    title = f"{clip.subject}: {len(reasons)} of {len(timesteps)} timesteps left out (red), threshold "
    title += f"{decided.threshold:g} mm2 of lip and chin covered"
    legend = f"The {len(shown)} highest scores, outlined what looks covered; an orange bar marks scores near the threshold."
    with atomic_path(path) as temporary:
        _lay_out([tiles[row] for row in shown], title, legend).save(temporary, optimize=True)


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
    picture = cv2.warpAffine(
        image, matrix, (TILE, TILE), flags=interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=PAPER
    )
    covered = np.zeros((TILE, TILE), np.uint8)
    radius = max(1, round(0.75 * PITCH * camera.K[0, 0] / float(np.median(local[:, 2])) * scale))
    for x, y in np.round(scale * (pixels[patch[atlas.inside]] - corner) - 0.5).astype(int):
        cv2.circle(covered, (int(x), int(y)), radius, 1, -1)
    contours, _ = cv2.findContours(covered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outlined = np.array(picture, np.uint8)
    cv2.drawContours(outlined, contours, -1, OUTLINE, 1)
    return outlined


def _tile(mouth: ByteArray, colour: Colour, near: bool, notes: Sequence[str]) -> Image.Image:
    """A framed mouth with text under it."""
    side = TILE + 2 * BORDER
    tile = Image.new("RGB", (side, side + _LINES * (_TEXT + 4) + 4), PAPER)
    draw = ImageDraw.Draw(tile)
    draw.rectangle((0, 0, side - 1, side - 1), fill=colour)
    tile.paste(Image.fromarray(mouth), (BORDER, BORDER))
    if near:
        draw.rectangle((0, side - BORDER - 4, side - 1, side - 1), fill=NEAR)
    for line, text in enumerate(notes):
        draw.text(
            (2, side + 2 + line * (_TEXT + 4)),
            _fit(text, side - 4),
            fill=INK,
            font=ImageFont.load_default(_TEXT),
        )
    return tile


def _fit(text: str, width: int) -> str:
    """Cut a text to so many pixels."""
    font = ImageFont.load_default(_TEXT)
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"


def _lay_out(tiles: Sequence[Image.Image], title: str, legend: str) -> Image.Image:
    """Tiles in rows under a title."""
    width, height = tiles[0].size
    columns = min(COLUMNS, max(len(tiles), 4))
    rows = -(-len(tiles) // columns)
    top = GAP + _TITLE + 8 + _TEXT + 12
    sheet = Image.new("RGB", (GAP + columns * (width + GAP), top + rows * (height + GAP)), PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((GAP, GAP), title, fill=INK, font=ImageFont.load_default(_TITLE))
    draw.text((GAP, GAP + _TITLE + 8), legend, fill=INK, font=ImageFont.load_default(_TEXT))
    for index, tile in enumerate(tiles):
        row, column = divmod(index, columns)
        sheet.paste(tile, (GAP + column * (width + GAP), top + row * (height + GAP)))
    return sheet
