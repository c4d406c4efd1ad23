"""The camera rig and the head, from above and from the side, to scale."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np

from ...bench.contracts import Camera, FloatArray, IntArray
from ..head.geometry import rigid_alignment
from ..mesh_pictures import draw_mesh
from .canvas import FINE, HELD_OUT, INK, MUTED, TRAIN, Canvas, Point, nice_ticks

FRUSTUM_M = 0.10
"""How far a drawn frustum reaches."""

_FAR_M = 100.0
"""From so far the head's picture is orthographic to a thousandth."""


def head_frame(vertices: FloatArray, template: FloatArray, members: IntArray) -> FloatArray:
    """(4, 4) world to head: origin at the mean of the vertices, axes those of the template."""
    rotation = rigid_alignment(vertices[members], template[members])[:3, :3]
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, -rotation @ vertices.mean(axis=0)
    return frame


def draw_rig(
    canvas: Canvas,
    box: tuple[float, float, float, float],
    cameras: Mapping[str, Camera],
    held_out: Collection[str],
    vertices: FloatArray,
    faces: IntArray,
    frame: FloatArray,
    *,
    above: bool,
) -> None:
    """Draw the rig into ``box`` (left, top, right, bottom).

    From above, with the face looking down the page, or from the head's right, with the face looking right.
    """
    left, top, right, bottom = box
    # Rows: head axes along the page's right and down, and away from the viewer.
    view = np.array(
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]] if above else [[0, 0, 1], [0, -1, 0], [1, 0, 0]], float
    )
    turn = view @ frame[:3, :3]
    centres = {name: turn @ c.center + view @ frame[:3, 3] for name, c in cameras.items()}
    head = vertices @ turn.T + view @ frame[:3, 3]
    everything = np.concatenate([[*centres.values()], head])[:, :2]
    low, high = everything.min(axis=0) - 0.05, everything.max(axis=0) + 0.05
    room = np.array([right - left - 50, bottom - top - 62])
    scale = float((room / (high - low)).min())
    middle = (low + high) / 2
    origin = np.array([(left + right) / 2, (top + 30 + bottom - 24) / 2])

    def place(point: FloatArray) -> Point:
        x, y = origin + scale * (point[:2] - middle)
        return float(x), float(y)

    canvas.text((left, top), "rig from above" if above else "rig from the side", 15, INK)
    _draw_head(canvas, head, faces, scale, place)
    _draw_scale(canvas, (left + 8, bottom - 10), scale, float(high[0] - low[0]))
    names = _short_names(list(cameras))
    for name in sorted(cameras, key=lambda n: (n in held_out, -centres[n][2])):
        colour = HELD_OUT if name in held_out else TRAIN
        camera, centre = cameras[name], centres[name]
        rays = turn @ camera.world_to_camera[:3, :3].T @ _corner_rays(camera)
        corners = [place(centre + FRUSTUM_M * ray) for ray in rays.T]
        apex = place(centre)
        for one, other in zip(corners, [*corners[1:], corners[0]]):
            canvas.line([one, other], colour, 1.2)
            canvas.line([apex, one], colour, 0.8)
        canvas.dot(apex, 3.2, colour)
        outward = centre[:2] / max(float(np.linalg.norm(centre[:2])), 1e-6)
        canvas.text(
            (apex[0] + 13 * float(outward[0]), apex[1] + 11 * float(outward[1])),
            names[name],
            11,
            colour if name in held_out else MUTED,
            "mm",
        )


def _corner_rays(camera: Camera) -> FloatArray:
    """(3, 4) rays through the image's corners in the camera's axes, depth 1."""
    width, height = camera.width, camera.height
    corners = np.array([[0, width, width, 0], [0, 0, height, height], [1, 1, 1, 1]], dtype=np.float64)
    return np.linalg.solve(camera.K, corners)


def _draw_head(
    canvas: Canvas, head: FloatArray, faces: IntArray, scale: float, place: Callable[[FloatArray], Point]
) -> None:
    low, high = head[:, :2].min(axis=0), head[:, :2].max(axis=0)
    width, height = (np.ceil(FINE * scale * (high - low)).astype(int) + 2).tolist()
    focal = FINE * scale * _FAR_M
    intrinsics = np.array(
        [[focal, 0, 1 - FINE * scale * low[0]], [0, focal, 1 - FINE * scale * low[1]], [0, 0, 1.0]]
    )
    away = np.eye(4)
    away[2, 3] = _FAR_M
    picture = draw_mesh(head, faces, Camera("panel", width, height, intrinsics, away))
    x, y = place(low)
    canvas.image(x - 1 / FINE, y - 1 / FINE, picture)


def _draw_scale(canvas: Canvas, at: Point, scale: float, span: float) -> None:
    """A bar of a round length, about a quarter of the panel."""
    length = next((tick for tick in nice_ticks(0.0, span, 5) if tick > 0), span)
    x, y = at
    canvas.line([(x, y), (x + scale * length, y)], INK, 1.5)
    for end in (x, x + scale * length):
        canvas.line([(end, y - 4), (end, y + 4)], INK, 1.5)
    canvas.text((x + scale * length + 8, y), f"{100 * length:g} cm", 12, INK, "lm")


def _short_names(names: list[str]) -> dict[str, str]:
    """The shortest ends of the names, of at least two characters, that tell them apart."""
    longest = max(map(len, names), default=0)
    for length in range(2, longest + 1):
        short = {name: name[-length:] for name in names}
        if len(set(short.values())) == len(names):
            return short
    return {name: name for name in names}
