"""Stands in for the renderer of synthetic captures where a test needs pictures, but not how they look."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pytest

from headbench.datasets.mesh_pictures import draw_mesh, rasterize_mesh
from headbench.datasets.synthetic.plan import SubjectPlan

from .tiny_capture import posed_vertices


class FlatRenderer:
    """`CaptureRenderer` that draws the tracked mesh in milliseconds, with colours that tell its parts apart."""

    def __init__(self, plan: SubjectPlan):
        self._plan = plan
        self._colors = 0.5 + 0.4 * np.sin(60 * plan.writer.plan.head.template)

    def render_frames(self, sequence: str, timestep: int, cameras: Sequence[str]) -> None:
        written = self._plan.writer.plan
        vertices = posed_vertices(written, self._plan.poses[sequence][timestep])
        for name in cameras:
            mesh = vertices, written.head.faces, self._plan.cameras[name]
            image = draw_mesh(*mesh, self._colors, background=written.background, supersampling=1)
            mask = np.where(rasterize_mesh(*mesh).face >= 0, 255, 0).astype(np.uint8)
            self._plan.writer.write_frame(sequence, timestep, name, image, mask)


@contextmanager
def flat_pictures() -> Iterator[None]:
    """Captures that this process synthesises in the block have the pictures of `FlatRenderer`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("headbench.datasets.synthetic.capture.CaptureRenderer", FlatRenderer)
        yield
