"""Renderings of the mean head, coloured by region, from which the landmark embedding is learnt if no capture is given."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadAsset
from ...bench.experiments.viewpoints import look_at
from ..head.arrays import region
from ..mesh_pictures import draw_mesh
from .embedding import PicturedMesh

AZIMUTHS = (-40, -30, -20, -10, 0, 10, 20, 30, 40)
ELEVATIONS = (-10, 5, 20)
"""Directions from which the face is drawn, degrees."""
SIDE, SPAN, DISTANCE = 384, 2.2, 5.0
"""Pixels of a picture; its width and the distance of the camera, relative to the face's height."""
BACKGROUND, SKIN = (0.75, 0.78, 0.80), (0.80, 0.62, 0.52)
PAINT = {
    "lips": (0.66, 0.34, 0.33),
    "left_eyeball": (0.93, 0.93, 0.92),
    "right_eyeball": (0.93, 0.93, 0.92),
    "scalp": (0.25, 0.18, 0.13),
}
IRIS, IRIS_SHARE = (0.20, 0.15, 0.10), 0.15
"""Colour of the front of an eyeball, and the fraction of its vertices with this colour."""


def drawn_head(head: HeadAsset) -> Iterator[PicturedMesh]:
    """Pictures of the mean head from the front and from both sides. Raises `InputError` for a head model without a face."""
    mesh = np.asarray(head.template, np.float64)
    face = mesh[region(head, "face")]
    middle, height = (face.min(axis=0) + face.max(axis=0)) / 2, float(np.ptp(face[:, 1]))
    focal = SIDE * DISTANCE / SPAN
    K = np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    colours = _painted(head, mesh)
    for number, (elevation, azimuth) in enumerate(product(np.radians(ELEVATIONS), np.radians(AZIMUTHS))):
        towards = np.array(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
        )
        motion = look_at(middle + DISTANCE * height * towards, middle, np.array([0.0, 1.0, 0.0]))
        camera = Camera(str(number), SIDE, SIDE, K, motion)
        yield PicturedMesh(draw_mesh(mesh, head.faces, camera, colours, background=BACKGROUND), camera, mesh)


def _painted(head: HeadAsset, mesh: FloatArray) -> FloatArray:
    """(V, 3) colours of the vertices; regions that the head model does not have are skin."""
    colours = np.tile(SKIN, (len(mesh), 1))
    for name, colour in PAINT.items():
        members = np.asarray(head.regions.get(name, ()), np.int64)
        colours[members] = colour
        if name.endswith("eyeball") and len(members):
            forward = mesh[members, 2]
            colours[members[forward > np.quantile(forward, 1 - IRIS_SHARE)]] = IRIS
    return colours
