"""The picture of a capture: rig, splits, overlays, motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...bench.contracts import ByteArray, Progress, no_progress
from ..clip import CaptureClip
from .canvas import FINE, HELD_OUT, INK, MUTED, RULE, TRAIN, Canvas, shortened
from .expression_panel import draw_scatter, draw_sequences, draw_space, space_summary
from .overlay_panel import blank, frame_of, overlay, pair, pick_cameras, pick_timesteps
from .rig_panel import draw_rig, head_frame
from .statistics import ExpressionSpace, SequenceRow, SplitRow, posed_meshes

WIDTH, MARGIN = 1600, 36
RIG_HEIGHT, MOTION_HEIGHT = 370, 350
OVERLAY_HEIGHT = 280
"""Most that an overlay is high."""

LABEL = 128


def draw_figure(
    clip: CaptureClip,
    splits: Sequence[SplitRow],
    sequences: Sequence[SequenceRow],
    space: ExpressionSpace,
    *,
    timesteps: int,
    cameras: int,
    progress: Progress = no_progress,
) -> ByteArray:
    """(H, `WIDTH`, 3) picture of a clip; see `InspectSettings` for the counts."""
    columns = pick_cameras(clip, cameras)
    rows = pick_timesteps(clip, space, timesteps)
    cell = (WIDTH - 2 * MARGIN - LABEL) / max(1, len(columns)) - 10
    widest = max((clip.cameras[name].width / clip.cameras[name].height for name in columns), default=1.0)
    height = int(min(OVERLAY_HEIGHT, cell / (2 * widest)))
    overlays_top = 104 + RIG_HEIGHT + 24
    motion_top = overlays_top + 52 + len(rows) * (height + 10) + 26
    canvas = Canvas(WIDTH, motion_top + MOTION_HEIGHT + 30)
    _draw_title(canvas, clip)
    _draw_rigs(canvas, clip)
    _draw_splits(canvas, clip, splits)
    _draw_overlays(canvas, clip, rows, columns, overlays_top, height, cell, progress)
    bottom = motion_top + MOTION_HEIGHT
    draw_sequences(canvas, (MARGIN, motion_top, 760, bottom), sequences)
    draw_space(canvas, (800, motion_top, 1160, bottom - 26), space)
    expressions = np.stack([clip.poses[t].expression for t in space.timesteps])
    draw_scatter(canvas, (1200, motion_top, WIDTH - MARGIN, bottom - 26), expressions, space.held_out)
    canvas.text((800, bottom - 4), space_summary(space), 13, MUTED, "ls")
    return canvas.finish()


def _draw_title(canvas: Canvas, clip: CaptureClip) -> None:
    canvas.text((MARGIN, 28), f"Subject {clip.subject}", 28)
    sizes = sorted({(camera.width, camera.height) for camera in clip.cameras.values()})
    pixels = ", ".join(f"{width}x{height}" for width, height in sizes[:3])
    parts = [
        f"{len(clip.files)} images of {pixels} pixels",
        f"{len(clip.cameras)} cameras",
        f"{len(clip.poses)} timesteps",
        f"head model {clip.head.version}",
        f"{len(clip.head.template)} vertices",
        f"{clip.head.expression_basis.shape[2]} expressions",
    ]
    canvas.text((MARGIN, 66), "   ·   ".join(parts), 15, MUTED)
    right = WIDTH - MARGIN
    for text, colour, x in (("training", TRAIN, right - 130), ("held out", HELD_OUT, right - 40)):
        canvas.dot((x - 52, 44), 5, colour)
        canvas.text((x - 42, 44), text, 14, INK, "lm")
    canvas.line([(MARGIN, 94), (right, 94)], RULE, 1)


def _draw_rigs(canvas: Canvas, clip: CaptureClip) -> None:
    timestep = min(clip.poses, key=lambda t: float(np.linalg.norm(clip.poses[t].expression)))
    vertices = posed_meshes(clip, [timestep])[0]
    members = clip.head.regions.get("face", np.arange(len(vertices)))
    frame = head_frame(vertices, clip.head.template, members)
    held_out = {key.camera for key in clip.splits.get("novel_view", ())}
    for left, above in ((MARGIN, True), (MARGIN + 530, False)):
        box = (left, 110, left + 510, 104 + RIG_HEIGHT)
        draw_rig(canvas, box, clip.cameras, held_out, vertices, clip.head.faces, frame, above=above)


def _draw_splits(canvas: Canvas, clip: CaptureClip, splits: Sequence[SplitRow]) -> None:
    left, right, y = MARGIN + 1080, WIDTH - MARGIN, 110
    canvas.text((left, y), "splits", 15)
    columns = [("images", 206), ("timesteps", 286), ("cameras", 358), ("sequences", 448)]
    for name, x in columns:
        canvas.text((left + x, y + 46), name, 12, MUTED, "rs")
    canvas.line([(left, y + 52), (right, y + 52)], RULE, 1)
    for index, row in enumerate(splits):
        middle = y + 70 + 26 * index
        colour = {"train": TRAIN, "excluded": MUTED}.get(row.split, HELD_OUT)
        canvas.text((left, middle), row.split.replace("_", " "), 14, colour, "lm")
        values = (row.images, row.timesteps, row.cameras, row.sequences)
        for (_, x), value in zip(columns, values):
            canvas.text((left + x, middle), f"{value:,}", 14, INK, "rm")
    y += 82 + 26 * len(splits)
    for name, fact in _facts(clip):
        canvas.text((left, y), name, 13, MUTED)
        canvas.text((left + 130, y), shortened(fact, right - left - 130, 13), 13, INK)
        y += 22


def _facts(clip: CaptureClip) -> list[tuple[str, str]]:
    record = clip.steps[0].parameters
    background = tuple(float(c) for c in clip.background)
    named = "white" if background == (1, 1, 1) else "black" if background == (0, 0, 0) else f"{background}"
    leaks = record.get("leaks") or []
    held_out = sorted({key.camera for key in clip.splits.get("novel_view", ())})
    reasons = sorted(set(clip.excluded.values()))
    masks = sum(frame.mask is not None for frame in clip.files.values())
    return [
        ("novel view", ", ".join(held_out) or "none"),
        ("background", named),
        ("masks", "all frames" if masks == len(clip.files) else f"{masks} of {len(clip.files)} frames"),
        ("principal point", f"cy from the {record.get('cy')}"),
        ("excluded for", ", ".join(reasons) or "nothing"),
        ("leaks", f"{len(leaks)}: {leaks[0]}" if leaks else "none"),
        ("origin", "synthetic" if record.get("synthetic") else "recorded"),
    ]


def _draw_overlays(
    canvas: Canvas,
    clip: CaptureClip,
    rows: Sequence[tuple[int, str]],
    columns: Sequence[str],
    top: float,
    height: int,
    cell: float,
    progress: Progress,
) -> None:
    canvas.text((MARGIN, top), "tracked mesh on images: its outline, and itself", 15)
    held_out = {key.camera for key in clip.splits.get("novel_view", ())}
    for column, name in enumerate(columns):
        x = MARGIN + LABEL + column * (cell + 10)
        suffix = " (held out)" if name in held_out else ""
        colour = HELD_OUT if name in held_out else TRAIN
        canvas.text((x, top + 42), f"camera {name}{suffix}", 13, colour, "ls")
    meshes = posed_meshes(clip, [timestep for timestep, _ in rows])
    tests = {key.timestep for key in clip.splits.get("self_reenactment", ())}
    for row, (timestep, reason) in enumerate(rows):
        y = top + 52 + row * (height + 10)
        sequence = next(key.sequence for key in clip.files if key.timestep == timestep)
        colour = HELD_OUT if timestep in tests else TRAIN
        lines = [(f"timestep {timestep}", INK), (sequence, colour), *_broken(reason)]
        for index, (text, ink) in enumerate(lines):
            canvas.text((MARGIN, y + 4 + 19 * index), shortened(text, LABEL - 12, 13), 13, ink)
        for column, name in enumerate(columns):
            progress(row * len(columns) + column, len(rows) * len(columns), "drawing")
            x = MARGIN + LABEL + column * (cell + 10)
            key = frame_of(clip, timestep, name)
            camera = clip.cameras[name]
            if key is None:
                width = round(camera.width * height * FINE / camera.height)
                canvas.image(x, y, blank(2 * width, height * FINE))
                continue
            pictures = overlay(clip.image(key), meshes[row], clip.head.faces, camera, height * FINE)
            both = pair(*pictures)
            canvas.image(x, y, both)
            # White images need an edge on white paper: one sees what the image cuts off.
            canvas.box(x - 1, y - 1, x + both.shape[1] / FINE, y + both.shape[0] / FINE, None, RULE)


def _broken(text: str) -> list[tuple[str, tuple[int, int, int]]]:
    """A short text over lines of about fifteen characters."""
    lines: list[str] = []
    for word in text.split():
        if lines and len(lines[-1]) + len(word) < 15:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return [(line, MUTED) for line in lines]
