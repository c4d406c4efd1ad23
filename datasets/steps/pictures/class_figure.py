"""The expression classes by their medoids, image beside mesh, and over time; after the paper's Figure 8."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ....bench.contracts import ByteArray, FrameKey, Progress, no_progress
from ...clip import CaptureClip
from ...inspect.canvas import FINE, INK, MUTED, Canvas, shortened
from ..expression_clusters import ExpressionClusters
from .meshes import draw_meshes, unposed_meshes

_COLUMNS, _HEIGHT, _MARGIN, _GAP = 4, 176, 24, 14
_MESH_WIDTH, _NAME_WIDTH, _LEAST_WIDTH = 134, 150, 640
_TOP, _LABEL, _STRIP, _ROW = 58, 34, 16, 22


def draw_classes(
    clip: CaptureClip, clusters: ExpressionClusters, progress: Progress = no_progress
) -> ByteArray:
    """Draw the figure, (H, W, 3): classes from the largest to the smallest, then who is in which over time."""
    sizes = np.bincount(clusters.labels)
    order = np.argsort(-sizes, kind="stable")
    keys = [frontal_key(clip, timestep) for timestep in clusters.medoids[order].tolist()]
    aspect = max(clip.cameras[key.camera].width / clip.cameras[key.camera].height for key in keys)
    image_width = round(_HEIGHT * min(max(aspect, 0.6), 1.2))
    cell = image_width + _MESH_WIDTH + _GAP
    columns = min(_COLUMNS, len(order))
    rank = np.argsort(order)
    sequences = _by_sequence(clip, clusters)
    strips_top = _TOP + -(-len(order) // columns) * (_HEIGHT + _LABEL) + 34
    width = max(2 * _MARGIN + columns * cell - _GAP, _LEAST_WIDTH)
    canvas = Canvas(width, strips_top + _ROW * len(sequences) + _MARGIN)
    canvas.text((_MARGIN, 16), f"Expression classes, subject {clip.subject}", 19)
    canvas.text((width - _MARGIN, 20), _origin(clusters), 13, MUTED, "ra")
    meshes = unposed_meshes(clip, [clip.poses[key.timestep] for key in keys])
    drawn = draw_meshes(clip, meshes, FINE * _MESH_WIDTH, FINE * _HEIGHT)
    for index, (label, key) in enumerate(zip(order, keys)):
        left = _MARGIN + index % columns * cell
        top = _TOP + index // columns * (_HEIGHT + _LABEL)
        canvas.image(left, top, _fitted(clip.image(key), FINE * image_width, FINE * _HEIGHT))
        canvas.image(left + image_width, top, drawn[index])
        canvas.box(left, top + _HEIGHT + 5, left + 10, top + _HEIGHT + 15, class_colour(index))
        count = "1 timestep" if sizes[label] == 1 else f"{sizes[label]} timesteps"
        text = f"{count} ({100 * sizes[label] / len(clusters.labels):.0f} %), medoid {key.timestep}"
        canvas.text((left + 15, top + _HEIGHT + 3), shortened(text, cell - _GAP - 15, 12), 12)
        progress(index + 1, len(order), str(key))
    canvas.text((_MARGIN, strips_top - 22), "Classes over time, by training sequence", 13)
    ranks = {name: rank[labels].tolist() for name, labels in sequences.items()}
    _draw_strips(canvas, ranks, strips_top, width - _MARGIN)
    return canvas.finish()


def _draw_strips(canvas: Canvas, ranks: Mapping[str, Sequence[int]], top: float, right: float) -> None:
    """Draw a strip for each sequence: its timesteps from left to right in the colours of their classes."""
    left = _MARGIN + _NAME_WIDTH
    step = (right - left) / max(map(len, ranks.values()))
    for row, (name, sequence) in enumerate(ranks.items()):
        upper = top + row * _ROW
        canvas.text((_MARGIN, upper + _STRIP / 2), shortened(name, _NAME_WIDTH - 10, 12), 12, INK, "lm")
        for moment, rank in enumerate(sequence):
            edges = left + moment * step, left + (moment + 1) * step
            canvas.box(edges[0], upper, edges[1], upper + _STRIP, class_colour(rank))


def frontal_key(clip: CaptureClip, timestep: int) -> FrameKey:
    """Training frame of a timestep whose camera the face looks at most directly."""
    pose = clip.poses[timestep]
    facing = Rotation.from_rotvec(np.asarray(pose.rotation, dtype=np.float64)).apply([0.0, 0.0, 1.0])

    def directness(key: FrameKey) -> float:
        towards = clip.cameras[key.camera].center - pose.translation
        return float(facing @ towards / np.linalg.norm(towards))

    return max((key for key in clip.splits["train"] if key.timestep == timestep), key=directness)


def class_colour(rank: int) -> tuple[int, int, int]:
    """Colour of the class of this rank by size: hues a golden section apart, the largest class grey."""
    if rank == 0:
        return (190, 190, 190)
    r, g, b = colorsys.hsv_to_rgb(0.618034 * rank % 1, 0.62, 0.88)
    return round(255 * r), round(255 * g), round(255 * b)


def _origin(clusters: ExpressionClusters) -> str:
    count = len(clusters.timesteps)
    if clusters.variant == "official":
        return f"the published clustering of {count} training timesteps"
    if clusters.landmarks == count:
        return f"all pairs of {count} training timesteps"
    return f"{clusters.landmarks} landmarks for {count} training timesteps, within {1000 * clusters.radius:.2f} mm"


def _by_sequence(clip: CaptureClip, clusters: ExpressionClusters) -> dict[str, list[int]]:
    """Class of each training timestep in order, by sequence."""
    sequence_of = {key.timestep: key.sequence for key in clip.splits["train"]}
    result: dict[str, list[int]] = {}
    for timestep, label in clusters.by_timestep.items():
        result.setdefault(sequence_of[timestep], []).append(label)
    return result


def _fitted(image: ByteArray, width: int, height: int) -> ByteArray:
    """Resize an image to fit a box, centred on white."""
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    sheet = np.full((height, width, 3), 255, dtype=np.uint8)
    top, left = (height - size[1]) // 2, (width - size[0]) // 2
    sheet[top : top + size[1], left : left + size[0]] = small
    return sheet
