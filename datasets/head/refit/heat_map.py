"""A picture of where a refit leaves distances: the subject's neutral head, coloured by mean residual."""

from __future__ import annotations

import cv2
import numpy as np

from ....bench.contracts import ByteArray, FloatArray
from ...inspect.canvas import FINE, MUTED, Canvas, nice_ticks
from ...mesh_pictures import CLAY, draw_mesh, portrait_camera
from ..subject import PosedSubject
from .refit import Refitted

_YAWS = (-0.75, 0.0, 0.75)
_VIEW = (280, 360)
_MARGIN, _HEAD, _FOOT = 20, 66, 58
_BAR = 420
_SHOWN = 99  # percentile of the residuals at the upper end of the scale


def draw_heat_map(refitted: Refitted) -> ByteArray:
    """(H, W, 3) picture of the head from three sides with a scale; vertices that were not fitted are grey."""
    clip, report = refitted.clip, refitted.report
    neutral = PosedSubject(clip.head, clip.shape, clip.static_offset).neutral
    fitted = np.isfinite(report.vertex_mm)
    top = max(float(np.percentile(report.vertex_mm[fitted], _SHOWN)), 1e-3)
    colours = np.tile(np.array(CLAY), (len(neutral), 1))
    colours[fitted] = colour_scale(report.vertex_mm[fitted] / top)

    canvas = Canvas(2 * _MARGIN + len(_YAWS) * _VIEW[0], _HEAD + _VIEW[1] + _FOOT)
    summary = report.summary()
    title = f"Refit of {clip.subject}: {summary['source']} to {summary['target']}"
    canvas.text((_MARGIN, 16), title, size=17)
    line = (
        f"mean over {summary['timesteps']} timesteps; face: mean {summary['mean_mm']:.3f} mm, "
        f"95th percentile {summary['p95_mm']:.3f} mm"
    )
    canvas.text((_MARGIN, 41), line, size=13, colour=MUTED)
    width, height = FINE * _VIEW[0], FINE * _VIEW[1]
    for index, yaw in enumerate(_YAWS):
        camera = portrait_camera(neutral, width, height, yaw=yaw)
        picture = draw_mesh(neutral, clip.head.faces, camera, colours, shading=0.35, supersampling=1)
        canvas.image(_MARGIN + index * _VIEW[0], _HEAD, picture)
    _draw_scale(canvas, _HEAD + _VIEW[1] + 12, top)
    return canvas.finish()


def colour_scale(values: FloatArray) -> FloatArray:
    """(n, 3) colours in [0, 1] of values from 0 (dark blue) to 1 (yellow): the perceptually even viridis."""
    levels = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
    mapped = cv2.applyColorMap(levels.reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    return np.asarray(mapped[:, 0, ::-1] / 255)


def _draw_scale(canvas: Canvas, top: float, most: float) -> None:
    left = (canvas.width - _BAR) / 2
    bar = colour_scale(np.linspace(0, 1, FINE * _BAR))
    canvas.image(left, top, np.tile(np.round(255 * bar).astype(np.uint8), (FINE * 10, 1, 1)))
    for tick in nice_ticks(0.0, most, 5):
        x = left + _BAR * tick / most
        canvas.line([(x, top + 10), (x, top + 14)], MUTED)
        canvas.text((x, top + 16), f"{tick:g}", size=12, colour=MUTED, anchor="ma")
    canvas.text((left + _BAR + 26, top + 5), "mm", size=12, colour=MUTED, anchor="lm")
