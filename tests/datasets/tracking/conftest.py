"""A capture of the procedural head whose pictures show a pattern that is fixed to its surface."""

from __future__ import annotations

import numpy as np
import pytest

from headbench.datasets.ga.writer import CaptureWriter
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.mesh_pictures import draw_mesh, rasterize_mesh

from ..tiny_capture import TinyCapture, make_plan, posed_vertices, rig


@pytest.fixture(scope="session")
def patterned_capture(tmp_path_factory) -> TinyCapture:
    """Three cameras, five timesteps, no static offset."""
    head = procedural_head("2023")
    plan = make_plan(
        head=head,
        cameras=rig(120, 160, 61.0, 74.0),
        lengths={"FREE": 2, "EMO-1-shout+laugh": 3},
        static_offset=np.zeros(head.template.shape, np.float32),
    )
    writer = CaptureWriter(tmp_path_factory.mktemp("patterned"), plan)
    places = 150 * np.asarray(plan.head.template)
    colors = 0.5 + 0.4 * np.sin(places @ np.array([[1, 0.3, 0.5], [0.2, 1, 0.6], [0.4, 0.5, 1]]))
    for sequence in plan.sequences:
        for timestep, pose in enumerate(sequence.poses):
            mesh = posed_vertices(plan, pose)
            for camera in plan.cameras:
                image = draw_mesh(mesh, plan.head.faces, camera, colors, shading=0.0)
                mask = np.where(rasterize_mesh(mesh, plan.head.faces, camera).face >= 0, 255, 0)
                writer.write_frame(sequence.name, timestep, camera.id, image, mask.astype(np.uint8))
    writer.write_metadata()
    return TinyCapture(writer)
