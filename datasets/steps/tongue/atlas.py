"""The mouth's own picture plane: a map of lips and chin that every frame is brought into.

The map looks at the subject's neutral mesh from straight ahead. Each of its pixels is a point on the surface (a
triangle and barycentric weights), so that a pixel means one place of the skin, whatever the pose and the camera.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from ....bench.contracts import Camera, Clip, FloatArray, HeadAsset, IntArray
from ....bench.errors import InputError
from ...head.arrays import JOINT_NAMES
from ...head.geometry import vertex_normals
from ...head.model import HeadModel
from ...mesh_pictures import rasterize_mesh

PITCH = 0.0015
"""Edge of a pixel of the map, metres: about half the height of what a tongue's tip shows first."""

_SIDE, _ABOVE, _BELOW = 0.75, 0.30, 1.0  # of the mouth's width, from its middle
_REACH = 2.4  # widths of the mouth; what lies farther away cannot hide it from a camera in front
_FRONT = 0.25  # z of the neutral normal from which on a surface counts as facing front
_INNER = ("mouth_socket", "teeth", "gums_and_tongue")  # regions that are behind the lips, seen from outside
_FAR = 50.0  # metres; from there perspective is below a tenth of a millimetre


@dataclass(frozen=True, eq=False)
class MouthAtlas:
    """A frontal map of the surface around a subject's mouth, H x W pixels of `PITCH`, row 0 on top.

    Attributes
    ----------
    inside : (H, W) where the map has surface: the face's outside, facing front.
    corners : (N, 3) vertices of the triangle behind each pixel of ``inside``, in row-major order.
    weights : (N, 3) barycentric weights on them.
    lips : (H, W) pixels of the lips.
    below : (H, W) pixels under the line where the lips meet: lower lip and chin.
    height : (H, W) millimetres above (below: negative) the line where the lips meet.
    occluders : (F', 3) triangles near enough to hide the mouth from a camera in front of it.
    """

    inside: np.ndarray
    corners: IntArray
    weights: FloatArray
    lips: np.ndarray
    below: np.ndarray
    height: FloatArray
    occluders: IntArray

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.inside.shape[0], self.inside.shape[1]

    def points(self, vertices: FloatArray) -> FloatArray:
        """(N, 3) places of the map's pixels on a posed mesh (V, 3), metres."""
        return np.einsum("nk,nkd->nd", self.weights, vertices[self.corners])

    def normals(self, vertices: FloatArray) -> FloatArray:
        """(N, 3) unit normals of the posed triangles behind the map's pixels; 0 where one has no area."""
        a, b, c = np.moveaxis(vertices[self.corners], 1, 0)
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def mouth_atlas(clip: Clip) -> MouthAtlas:
    """Lay the map over a clip's subject.

    Raises `InputError` where the head lacks the regions "lips" or "face", or its lower lip does not follow the jaw.
    """
    head = clip.head
    where = f"head model {head.version!r}"
    for name in ("lips", "face"):
        if not len(head.regions.get(name, ())):
            known = ", ".join(sorted(head.regions)) or "none"
            remedy = "For FLAME, give FLAME_masks.pkl as masks=."
            raise InputError(where, f"regions[{name}]", "the vertices of that region", known, remedy)
    neutral = _neutral(clip)
    lips = np.intersect1d(head.regions["lips"], head.regions["face"])
    lips = lips if len(lips) else np.asarray(head.regions["lips"])
    on_jaw = head.skinning_weights[:, JOINT_NAMES.index("jaw")]
    span = on_jaw[lips]
    if np.ptp(span) < 0.2:
        found = f"jaw weights from {span.min():.2f} to {span.max():.2f}"
        raise InputError(
            where, "skinning_weights", "a lower lip that follows the jaw and an upper that does not", found
        )
    middle = 0.5 * float(span.min() + span.max())
    width = float(np.ptp(neutral[lips, 0]))
    upper, lower = lips[span < middle], lips[span >= middle]
    near = np.abs(neutral[:, 0] - neutral[lips, 0].mean()) < 0.2 * width
    if not near[upper].any() or not near[lower].any():
        raise InputError(where, "regions[lips]", "an upper and a lower lip about the middle", "none of one")
    line = 0.5 * (neutral[upper[near[upper]], 1].min() + neutral[lower[near[lower]], 1].max())
    centre = np.array([neutral[lips, 0].mean(), line, neutral[lips, 2].max()])

    camera = _map_camera(centre, width)
    outer = _outer_faces(head, neutral)
    seen = rasterize_mesh(neutral, head.faces[outer], camera)
    inside = seen.face >= 0
    corners = head.faces[outer][seen.face[inside]]
    weights = seen.weights[inside].astype(np.float64)

    def spread(values: FloatArray) -> FloatArray:
        picture = np.zeros(inside.shape)
        picture[inside] = np.einsum("nk,nk->n", weights, values[corners])
        return picture

    on_lips = np.zeros(len(neutral))
    on_lips[head.regions["lips"]] = 1.0
    lip_map = inside & (spread(on_lips) > 0.5)
    row_line = _lip_line(lip_map, spread(on_jaw) >= middle, camera)
    rows = np.arange(camera.height)[:, None] + 0.5
    height = (row_line[None] - rows) * PITCH * 1e3
    close = np.linalg.norm(neutral[head.faces].mean(axis=1) - centre, axis=1) < _REACH * width
    close &= ~_in_regions(head, _INNER)[head.faces].all(axis=1)
    return MouthAtlas(
        inside, corners, weights, lip_map, inside & (height < 0), height, head.faces[np.flatnonzero(close)]
    )


def _neutral(clip: Clip) -> FloatArray:
    """(V, 3) the subject's mesh without expression or pose."""
    model = HeadModel(clip.head, dtype=torch.float64)
    shape, offset = (torch.from_numpy(np.asarray(a, np.float64)) for a in (clip.shape, clip.static_offset))
    neutral: FloatArray = model.canonical(shape, offset)[0].numpy()
    return neutral


def _map_camera(centre: FloatArray, mouth: float) -> Camera:
    """Look along -z at the middle of the mouth from so far that the picture is parallel."""
    columns = 2 * int(np.ceil(_SIDE * mouth / PITCH))
    above, below = (int(np.ceil(share * mouth / PITCH)) for share in (_ABOVE, _BELOW))
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[:3, 3] = [-centre[0], centre[1], centre[2] + _FAR]
    K = np.array([[_FAR / PITCH, 0, columns / 2], [0, _FAR / PITCH, above], [0, 0, 1.0]])
    return Camera("mouth", columns, above + below, K, world_to_camera)


def _outer_faces(head: HeadAsset, neutral: FloatArray) -> IntArray:
    """Triangles of the face's outside that face front, without the mouth's wall."""
    skin = _in_regions(head, ("face", "lips")) & ~_in_regions(head, _INNER)
    skin &= vertex_normals(neutral, head.faces)[:, 2] > _FRONT
    return np.flatnonzero(skin[head.faces].all(axis=1))


def _in_regions(head: HeadAsset, names: Iterable[str]) -> np.ndarray:
    """(V,) vertices that are in one of the regions; a region that the head does not have is empty."""
    inside = np.zeros(len(head.template), dtype=bool)
    for name in names:
        inside[head.regions.get(name, np.array([], dtype=int))] = True
    return inside


def _lip_line(lips: np.ndarray, lower: np.ndarray, camera: Camera) -> FloatArray:
    """(W,) row of the line between the lips in each column; beyond the corners it goes on level."""
    rows = np.arange(camera.height) + 0.5
    line = np.full(camera.width, np.nan)
    for column in range(camera.width):
        top = rows[lips[:, column] & ~lower[:, column]]
        bottom = rows[lips[:, column] & lower[:, column]]
        if len(top) and len(bottom):
            line[column] = 0.5 * (top.max() + bottom.min())
    known = np.flatnonzero(np.isfinite(line))
    if not len(known):
        return np.full(camera.width, camera.K[1, 2])
    return np.interp(np.arange(camera.width), known, line[known])
