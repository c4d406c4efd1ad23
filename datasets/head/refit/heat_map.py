"""Heat map of a refit: the subject's neutral head, coloured by mean residual."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from ....bench.contracts import ByteArray
from ....bench.io.figures import pixels
from ...figures import new_figure, show
from ...mesh_pictures import CLAY, draw_mesh, portrait_camera
from ..subject import PosedSubject
from .refit import Refitted

_YAWS = (-0.75, 0.0, 0.75)
_VIEW = (560, 720)
_SHOWN = 99  # percentile of the residuals at the upper end of the scale


def draw_heat_map(refitted: Refitted) -> ByteArray:
    """(H, W, 3) image of the head from three sides with a scale; vertices that were not fitted are grey."""
    clip, report = refitted.clip, refitted.report
    neutral = PosedSubject.of(clip).neutral
    fitted = np.isfinite(report.vertex_mm)
    top = max(float(np.percentile(report.vertex_mm[fitted], _SHOWN)), 1e-3)
    colours = np.tile(np.array(CLAY), (len(neutral), 1))
    colours[fitted] = matplotlib.colormaps["viridis"](np.clip(report.vertex_mm[fitted] / top, 0, 1))[:, :3]
    summary = report.summary()
    with new_figure(8.8, 5) as figure:
        figure.suptitle(
            f"Refit of {clip.subject}: {summary['source']} to {summary['target']}\n"
            f"mean over {summary['timesteps']} timesteps; face: mean {summary['mean_mm']:.3f} mm, "
            f"95th percentile {summary['p95_mm']:.3f} mm"
        )
        grid = figure.subplots(1, len(_YAWS))
        for axes, yaw in zip(grid, _YAWS):
            camera = portrait_camera(neutral, *_VIEW, yaw=yaw)
            picture = draw_mesh(neutral, clip.head.faces, camera, colours, shading=0.35, supersampling=1)
            show(axes, picture)
        scale = ScalarMappable(Normalize(0, top), "viridis")
        figure.colorbar(scale, ax=grid, location="bottom", shrink=0.5, aspect=40, label="mm")
        return pixels(figure)
