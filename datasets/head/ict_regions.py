"""Parts and regions of ICT-FaceKit's mesh, from its materials, its connectivity and its 68 landmarks.

The kit has no masks like FLAME's. Materials and connected pieces are exact; regions of the skin are drawn by
the landmarks (numbered as in iBUG-68) and by proportions of the face, in units of the distance from nasion to
chin. They follow FLAME's names and meaning, not its outlines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from .geometry import border_edges, mesh_edges

_CONTOUR, _BROWS, _NOSE, _OUTER_LIPS = range(17), range(17, 27), range(27, 36), range(48, 60)
_NASION, _CHIN = 27, 8
_MATERIALS = (
    *("M_Face", "M_BackHead", "M_GumsTongue", "M_Teeth", "M_EyeLashes", "M_LacrimalFluid"),
    *("M_EyeOcclusion", "M_EyeBlend", "M_ScleraLeft", "M_ScleraRight", "M_IrisLeft", "M_IrisRight"),
)
_EYES = {"right": range(36, 42), "left": range(42, 48)}


def landmark_names() -> tuple[str, ...]:
    """Names of the 68 landmarks in iBUG's order: ``ibug_00`` to ``ibug_67``."""
    return tuple(f"ibug_{index:02d}" for index in range(68))


@dataclass(frozen=True, eq=False)
class MeshParts:
    """Sorted vertex indices of what the kit is put together from."""

    face_material: IntArray
    outer_back: IntArray  # scalp, back of the neck, shoulders
    mouth_socket: IntArray
    eye_sockets: IntArray
    gums_and_tongue: IntArray
    teeth: IntArray
    teeth_upper: IntArray
    teeth_lower: IntArray
    left_eyeball: IntArray
    right_eyeball: IntArray
    left_sclera: IntArray
    right_sclera: IntArray
    eyelashes: IntArray
    lacrimal_fluid: IntArray
    eye_occlusion: IntArray
    eye_blend: IntArray


@dataclass(frozen=True)
class Profile:
    """The head from the side: proportions that place the neck. Metres.

    Attributes
    ----------
    length : from nasion to chin.
    neck_top, neck_base : heights along the neck where the head begins and the shoulders begin.
    """

    length: float
    neck_top: float
    neck_base: float

    # The neck leans forward by about 25 degrees: the throat begins lower than the nape.
    _UP = np.array([0.0, np.cos(0.43), np.sin(0.43)])

    @classmethod
    def of(cls, template: FloatArray, landmarks: IntArray) -> Profile:
        """Profile of a head with 68 landmarks."""
        length = float(np.linalg.norm(template[landmarks[_NASION]] - template[landmarks[_CHIN]]))
        chin = float(template[landmarks[_CHIN]] @ cls._UP)
        return cls(length, chin - 0.24 * length, chin - 0.87 * length)

    def height(self, points: FloatArray) -> FloatArray:
        """Height of points (n, 3) along the neck."""
        return points @ self._UP


def mesh_parts(
    file: str | PathLike[str],
    template: FloatArray,
    faces: IntArray,
    materials: Mapping[str, IntArray],
    jaw_open: FloatArray,
) -> MeshParts:
    """Take the mesh apart.

    Parameters
    ----------
    materials : vertices of each material's triangles.
    jaw_open : (V, 3) displacement of ``jawOpen``, which tells lower teeth from upper ones.
    """
    for name in _MATERIALS:
        if name not in materials or not len(materials[name]):
            raise InputError(file, "material_names", f"triangles of {name}", ", ".join(sorted(materials)))
    # Behind the face material lie the outer head and, each a piece of its own, the mouth and eye sockets.
    back = np.setdiff1d(materials["M_BackHead"], materials["M_Face"])
    pieces = sorted(_pieces(back, faces), key=lambda piece: -template[piece, 1].max())
    outer, inner = pieces[0], pieces[1:]
    sockets = [piece for piece in inner if len(np.unique(template[piece, 0] > 0)) == 1]
    mouth = [piece for piece in inner if len(np.unique(template[piece, 0] > 0)) == 2]
    motion = np.linalg.norm(jaw_open[materials["M_Teeth"]], axis=1)
    lower = motion > 0.25 * motion.max()
    return MeshParts(
        face_material=materials["M_Face"],
        outer_back=outer,
        mouth_socket=_together(mouth),
        eye_sockets=_together(sockets),
        gums_and_tongue=materials["M_GumsTongue"],
        teeth=materials["M_Teeth"],
        teeth_upper=materials["M_Teeth"][~lower],
        teeth_lower=materials["M_Teeth"][lower],
        left_eyeball=np.union1d(materials["M_ScleraLeft"], materials["M_IrisLeft"]),
        right_eyeball=np.union1d(materials["M_ScleraRight"], materials["M_IrisRight"]),
        left_sclera=materials["M_ScleraLeft"],
        right_sclera=materials["M_ScleraRight"],
        eyelashes=materials["M_EyeLashes"],
        lacrimal_fluid=materials["M_LacrimalFluid"],
        eye_occlusion=materials["M_EyeOcclusion"],
        eye_blend=materials["M_EyeBlend"],
    )


def regions_of(
    template: FloatArray, faces: IntArray, parts: MeshParts, profile: Profile, landmarks: IntArray
) -> dict[str, IntArray]:
    """Regions by name: FLAME's, and the kit's own pieces."""
    points = template[landmarks]
    length = profile.length
    everything = np.arange(len(template))
    skin = np.zeros(len(template), dtype=bool)
    skin[parts.face_material] = True
    x, y, z = template.T

    # From the side the contour runs from the ear down to the chin; the face lies in front of it. The
    # landmarks sit before the ear, so the line is moved back to it, less and less towards the chin; above
    # the ear the face reaches as far back as its material.
    ear_line, ear_top = points[0, 1], points[0, 1] + 0.05 * length
    contour = points[list(_CONTOUR)[: _CHIN + 1]]
    order = np.argsort(contour[:, 1])
    along = np.interp(y, contour[order, 1], contour[order, 2])
    rise = np.clip((y - points[_CHIN, 1]) / (ear_line - points[_CHIN, 1]), 0, 1)
    in_front = (z > along - (0.01 + 0.17 * rise) * length) | (y > ear_top)
    face = skin & in_front & (y > contour[:, 1].min() - 0.02 * length)
    ear = skin & ~face & (y <= ear_top) & (y > ear_line - 0.58 * length)
    ear &= np.abs(x) > 0.93 * np.abs(points[0, 0])
    height = profile.height(template)
    outer = np.zeros_like(skin)
    outer[parts.outer_back] = True
    neck = (skin | outer) & ~face & ~ear & (height < profile.neck_top) & (height > profile.neck_base)

    brow = points[list(_BROWS), 1].max()
    nose = points[list(_NOSE)]
    masks = {
        "face": face,
        "forehead": face & (y > brow),
        "nose": face & _near(template, nose, 0.12 * length) & (y > nose[:, 1].min() - 0.02 * length),
        "lips": skin
        & _inside(template[:, :2], points[list(_OUTER_LIPS), :2], 0.02 * length)
        & (z > points[list(_OUTER_LIPS), 2].min() - 0.06 * length),
        "left_ear": ear & (x > 0),
        "right_ear": ear & (x < 0),
        "neck": neck,
        "scalp": outer & (height >= profile.neck_top),
        "shoulders": (skin | outer) & (height <= profile.neck_base),
    }
    for side, corners in _EYES.items():
        eye = points[list(corners)]
        width = np.ptp(eye[:, 0])
        masks[f"{side}_eye_region"] = face & (np.linalg.norm(template - eye.mean(0), axis=1) < 0.85 * width)
    masks["eye_region"] = masks["left_eye_region"] | masks["right_eye_region"]
    regions = {name: everything[mask] for name, mask in masks.items()}
    pieces = {name: getattr(parts, name) for name in MeshParts.__dataclass_fields__}
    del pieces["face_material"], pieces["outer_back"]
    return regions | pieces | {"boundary": np.intersect1d(border_edges(faces), everything[skin | outer])}


def _pieces(vertices: IntArray, faces: IntArray) -> list[IntArray]:
    """Connected pieces of the mesh restricted to the vertices."""
    renumbered = np.full(int(faces.max()) + 1, -1)
    renumbered[vertices] = np.arange(len(vertices))
    edges = renumbered[mesh_edges(faces)]
    edges = edges[(edges >= 0).all(1)]
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
    count, labels = connected_components(graph, directed=False)
    return [vertices[labels == label] for label in range(count)]


def _together(pieces: list[IntArray]) -> IntArray:
    return np.sort(np.concatenate([np.empty(0, np.int64), *pieces]))


def _near(template: FloatArray, points: FloatArray, radius: float) -> np.ndarray:
    """Whether each vertex is within the radius of one of the points."""
    distance = np.linalg.norm(template[:, None] - points[None], axis=2)
    return distance.min(1) < radius


def _inside(points: FloatArray, polygon: FloatArray, margin: float) -> np.ndarray:
    """Whether each 2D point is inside the polygon widened from its middle by about the margin (even-odd rule)."""
    middle = polygon.mean(0)
    away = polygon - middle
    polygon = polygon + margin * away / np.linalg.norm(away, axis=1, keepdims=True)
    inside = np.zeros(len(points), dtype=bool)
    for start, end in zip(polygon, np.roll(polygon, -1, axis=0)):
        crosses = (start[1] > points[:, 1]) != (end[1] > points[:, 1])
        slope = (end[0] - start[0]) / (end[1] - start[1]) if end[1] != start[1] else 0.0
        inside ^= crosses & (points[:, 0] < start[0] + slope * (points[:, 1] - start[1]))
    return inside
