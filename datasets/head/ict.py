"""ICT-FaceKit Light as a head in FLAME's layout: its scan-derived shapes on a fitted jaw, neck and eye rig.

Li et al., "Learning Formation of Physically-Based Face Attributes", CVPR 2020. The kit has blendshapes and no
skeleton, so the skeleton is fitted here:

* jaw: the hinge that best explains how ``jawOpen`` moves the lower teeth; every vertex follows it by the
  share of its displacement that the hinge explains, and the rest becomes a pose corrective;
* eyes: centres of the spheres through the back of the eyeballs;
* neck and root: centres of the neck's cross-section half-way and at its base, blended along the neck.

Formats read:

- ICT-FaceKit Light (the folder `FaceXModel` of OBJ files). Written by ICT-VGL/ICT-FaceKit. Checked on
  ICT-VGL/ICT-FaceKit@da5f95a6 `FaceXModel`, all 158 meshes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from skimage.measure import points_in_poly

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, Member, check_arrays, read_npz
from ...bench.io.documents import read_json, read_text
from ...bench.io.files import read_bytes, reading
from .arrays import HeadArrays
from .geometry import (
    LENGTH_BITS,
    REGRESSOR_BITS,
    SHARE_BITS,
    border_edges,
    connected_pieces,
    even_weights,
    fit_sphere,
    mesh_edges,
    on_grid,
    smoothstep,
)

VERSION = "ict-facekit"
LANDMARKS = tuple(f"ibug_{index:02d}" for index in range(68))
"""Names of the landmarks, in iBUG's order."""

JAW_SHAPE = "jawOpen"
DROPPED_SHAPES = (JAW_SHAPE, "mouthClose")
"""Shapes excluded from the expression basis: the jaw joint replaces the first; the second only corrects the first."""

_METRES = 0.01
_SOFTNESS = 0.004  # metres; see hinge_weights
_EACH_SIDE = 60  # vertices around the axis of the jaw
_LARGEST = MAX_MAGNITUDE / _METRES  # centimetres
_KEYS = {
    "v_neutral": Member("f", ("V", 3), _LARGEST),
    "tri_v": Member("iu", ("F", 3)),
    "tri_material": Member("iu", ("F",)),
    "material_names": Member("U", ("M",)),
    "expr_names": Member("U", ("E",)),
    "expr_deltas": Member("f", ("E", "V", 3), _LARGEST),
    "id_deltas": Member("f", ("S", "V", 3), _LARGEST),
    "idx_to_landmark_verts": Member("iu", (len(LANDMARKS),)),
}


NEUTRAL, INDICES = "generic_neutral_mesh.obj", "vertex_indices.json"


def is_ict(content: Mapping[str, np.ndarray]) -> bool:
    """Whether the members of an npz look like ICT-FaceKit's."""
    return {"v_neutral", "expr_deltas", "id_deltas"} <= set(content)


def read_ict(path: Path) -> dict[str, np.ndarray]:
    """Arrays of the kit by name: those of an npz, or of its folder ``FaceXModel`` (or the folder above) of OBJ files.

    ``v_neutral`` (V, 3) and the deltas (K, V, 3) in centimetres, ``tri_v`` (F, 3) with ``tri_material`` (F,), names, and
    ``idx_to_landmark_verts`` (68,).
    """
    if not path.is_dir():
        return read_npz(path)
    folder = next((place for place in (path, path / "FaceXModel") if (place / NEUTRAL).is_file()), None)
    if folder is None:
        raise InputError(path, NEUTRAL, "the folder FaceXModel of ICT-FaceKit", "no such file")
    neutral, triangles, materials = _mesh(folder / NEUTRAL)
    shapes = sorted(file.stem for file in folder.glob("*.obj") if file.name != NEUTRAL)
    deltas = {}
    for name in shapes:
        vertices = _vertices(folder / f"{name}.obj")
        if vertices.shape != neutral.shape:
            expected = f"{len(neutral)} vertices, as in {NEUTRAL}"
            raise InputError(folder / f"{name}.obj", "v", expected, str(len(vertices)))
        deltas[name] = vertices - neutral
    expressions = [name for name in shapes if not name.startswith("identity")]
    indices = read_json(folder / INDICES)
    with reading(folder / INDICES, "lists of vertices by name"):
        landmarks = np.array(indices["idx_to_landmark_verts"], np.int64)
    identities = [name for name in shapes if name.startswith("identity")]
    names, numbers = np.unique(np.array(materials, dtype=np.str_), return_inverse=True)
    return {
        "v_neutral": neutral,
        "tri_v": triangles,
        "tri_material": numbers,
        "material_names": names,
        "expr_names": np.array(expressions),
        "expr_deltas": np.array([deltas[name] for name in expressions]).reshape(-1, *neutral.shape),
        "id_deltas": np.array([deltas[name] for name in identities]).reshape(-1, *neutral.shape),
        "idx_to_landmark_verts": landmarks,
    }


def _vertices(path: Path) -> FloatArray:
    """(V, 3) vertices of an OBJ file."""
    content = read_bytes(path, "an OBJ mesh")
    with reading(path, "an OBJ mesh"):
        rows = re.findall(rb"^v (.*)$", content, re.MULTILINE)
        return np.fromstring(b" ".join(rows), np.float32, sep=" ").reshape(len(rows), 3)


def _mesh(path: Path) -> tuple[FloatArray, IntArray, list[str]]:
    """Vertices (V, 3), triangles (F, 3), quads split, and the name of each triangle's material."""
    triangles, materials, material = [], [], ""
    with reading(path, "an OBJ mesh with materials"):
        for line in read_text(path, "an OBJ mesh").splitlines():
            word, _, rest = line.partition(" ")
            if word == "usemtl":
                material = rest.strip()
            elif word == "f":
                corners = [int(corner.partition("/")[0]) - 1 for corner in rest.split()]
                triangles += [[corners[0], *corners[k : k + 2]] for k in range(1, len(corners) - 1)]
                materials += [material] * (len(corners) - 2)
        return _vertices(path), np.array(triangles, np.int64).reshape(-1, 3), materials


def expression_names(content: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of the columns of the expression basis, in order."""
    return tuple(str(name) for name in content["expr_names"] if str(name) not in DROPPED_SHAPES)


def ict_head(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> HeadArrays:
    """Rig the kit: metres, +y up, +z front, origin amid the head.

    ``file``: Named in errors. ``content``: Members of the npz: ``v_neutral`` and deltas in centimetres, triangles with
    materials, names, landmark vertices.

    Returns
    -------
    HeadArrays
        Head with one identity direction per mode (metres per standard deviation), one expression
        direction for each shape except `DROPPED_SHAPES` (coefficients in [0, 1]), and 68 named
        landmarks.
    """
    _check(file, content)
    with reading(file, "the mesh of ICT-FaceKit, whose parts can be told apart"):
        return _rigged(file, content).validate(file)


def _rigged(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> HeadArrays:
    faces = content["tri_v"].astype(np.int64)
    landmarks = content["idx_to_landmark_verts"].astype(np.int64)
    names = [str(name) for name in content["expr_names"]]
    jaw_open = content["expr_deltas"][names.index(JAW_SHAPE)].astype(np.float64) * _METRES
    materials = {
        str(name): np.unique(faces[content["tri_material"] == index])
        for index, name in enumerate(content["material_names"])
    }
    neutral = content["v_neutral"].astype(np.float64) * _METRES
    template = neutral - _middle_of_head(neutral, landmarks)
    parts = mesh_parts(file, template, faces, materials, jaw_open)
    profile = Profile.of(template, landmarks)

    hinge = fit_hinge(
        template[parts["teeth_lower"]], template[parts["teeth_lower"]] + jaw_open[parts["teeth_lower"]]
    )
    weights = on_grid(_weights(template, jaw_open, hinge, parts, profile), SHARE_BITS)
    correctives = np.zeros((len(template), 3, 36))
    # The block of the second joint; the root has none, the neck the first.
    correctives[:, :, 9:18] = hinge_correctives(hinge, template, jaw_open, weights[:, 2])
    kept = [index for index, name in enumerate(names) if name not in DROPPED_SHAPES]
    return HeadArrays(
        version=VERSION,
        template=template,
        faces=faces,
        shape_basis=_basis(content["id_deltas"]),
        expression_basis=_basis(content["expr_deltas"][kept]),
        pose_basis=on_grid(correctives, LENGTH_BITS).astype(np.float32),
        joint_regressor=on_grid(_regressor(template, hinge, parts, profile), REGRESSOR_BITS),
        skinning_weights=weights,
        parents=np.array([-1, 0, 1, 1, 1]),
        regions=regions_of(template, faces, parts, profile, landmarks),
        landmarks=dict(zip(LANDMARKS, landmarks.tolist())),
        expression_names=expression_names(content),
    )


def _check(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> None:
    sizes = check_arrays(file, content, _KEYS)
    for key, bound in (
        ("tri_v", sizes["V"]),
        ("tri_material", sizes["M"]),
        ("idx_to_landmark_verts", sizes["V"]),
    ):
        if content[key].size == 0 or not 0 <= content[key].min() <= content[key].max() < bound:
            raise InputError(file, key, f"indices from 0 to {bound - 1}", "others, or none")
    if JAW_SHAPE not in content["expr_names"]:
        found = ", ".join(map(str, content["expr_names"]))[:400]
        raise InputError(file, "expr_names", f"a shape {JAW_SHAPE}", found)


def _middle_of_head(vertices: FloatArray, landmarks: IntArray) -> FloatArray:
    """Middle of the bounding box of the vertices above the chin."""
    above = vertices[vertices[:, 1] > vertices[landmarks[8], 1]]
    return 0.5 * (above.min(0) + above.max(0))


def _basis(deltas: FloatArray) -> FloatArray:
    """(K, V, 3) centimetres to (V, 3, K) float32 metres."""
    return np.ascontiguousarray(np.moveaxis(deltas.astype(np.float32) * np.float32(_METRES), 0, 2))


def _weights(
    template: FloatArray, jaw_open: FloatArray, hinge: Hinge, parts: Parts, profile: Profile
) -> FloatArray:
    """(V, 5) skinning weights, rows sum to 1."""
    jaw = hinge_weights(hinge, template, jaw_open, _SOFTNESS)
    jaw[parts["teeth_lower"]], jaw[parts["teeth_upper"]] = 1, 0
    on_neck = smoothstep(profile.height(template), profile.neck_base, profile.neck_top)
    inside = np.concatenate([parts["teeth"], parts["gums_and_tongue"], parts["mouth_socket"]])
    on_neck[inside] = 1  # parts in the mouth follow the head, even if they are low
    still = np.zeros_like(jaw)
    weights = np.stack([1 - on_neck, on_neck * (1 - jaw), on_neck * jaw, still, still], axis=1)
    weights[parts["left_eyeball"]] = [0, 0, 0, 1, 0]
    weights[parts["right_eyeball"]] = [0, 0, 0, 0, 1]
    return weights


def _regressor(template: FloatArray, hinge: Hinge, parts: Parts, profile: Profile) -> FloatArray:
    """(5, V) joint regressor from the vertices around each joint."""
    skin = np.concatenate([parts["face_material"], parts["outer_back"]])
    height = profile.height(template[skin])
    joints: list[tuple[IntArray, FloatArray]] = []  # vertices around each joint, and its position
    for level in (profile.neck_base, 0.5 * (profile.neck_base + profile.neck_top)):
        ring = np.unique(skin[np.abs(height - level) < 0.05 * profile.length])
        joints.append((ring, 0.5 * (template[ring].min(0) + template[ring].max(0))))
    joints.append((_around_axis(template, skin, hinge), hinge.center))
    for eyeball in (parts["left_sclera"], parts["right_sclera"]):
        center, _ = fit_sphere(template[eyeball])
        back = eyeball[template[eyeball, 2] < center[2]]  # without the bulge of the cornea
        joints.append((back, fit_sphere(template[back])[0]))
    regressor = np.zeros((len(joints), len(template)))
    for row, (support, center) in zip(regressor, joints):
        row[support] = even_weights(template[support], center)
    return regressor


def _around_axis(template: FloatArray, skin: IntArray, hinge: Hinge) -> IntArray:
    """The skin vertices nearest to the hinge's axis, equally many on either side."""
    distance = np.linalg.norm(template[skin, 1:] - hinge.center[1:], axis=1)
    sides = [skin[template[skin, 0] > 0], skin[template[skin, 0] < 0]]
    distances = [distance[template[skin, 0] > 0], distance[template[skin, 0] < 0]]
    nearest = [side[np.argsort(away)[:_EACH_SIDE]] for side, away in zip(sides, distances)]
    return np.unique(np.concatenate(nearest))


_CONTOUR, _BROWS, _NOSE, _OUTER_LIPS = range(17), range(17, 27), range(27, 36), range(48, 60)
_NASION, _CHIN = 27, 8
_MATERIALS = (
    *("M_Face", "M_BackHead", "M_GumsTongue", "M_Teeth", "M_EyeLashes", "M_LacrimalFluid"),
    *("M_EyeOcclusion", "M_EyeBlend", "M_ScleraLeft", "M_ScleraRight", "M_IrisLeft", "M_IrisRight"),
)
_EYES = {"right": range(36, 42), "left": range(42, 48)}
Parts = Mapping[str, IntArray]


@dataclass(frozen=True)
class Profile:
    """The head from the side: proportions that place the neck. Metres."""

    length: float
    """Distance from nasion to chin."""
    neck_top: float
    neck_base: float
    """Heights along the neck at which the head and the shoulders begin."""

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
) -> Parts:
    """Split the mesh: sorted vertex indices by part. ``materials``: Vertices of each material's triangles.
    ``jaw_open``: (V, 3) displacement of ``jawOpen``, which separates lower teeth from upper teeth."""
    for name in _MATERIALS:
        if name not in materials or not len(materials[name]):
            raise InputError(file, "material_names", f"triangles of {name}", ", ".join(sorted(materials)))
    # Behind the face material are the outer head and, as separate pieces, the mouth and eye sockets.
    back = np.setdiff1d(materials["M_BackHead"], materials["M_Face"])
    outer, *inner = sorted(
        connected_pieces(back, mesh_edges(faces)), key=lambda piece: -template[piece, 1].max()
    )
    sides = [len(np.unique(template[piece, 0] > 0)) for piece in inner]
    teeth = materials["M_Teeth"]
    motion = np.linalg.norm(jaw_open[teeth], axis=1)
    lower = motion > 0.25 * motion.max()
    return {
        "face_material": materials["M_Face"],
        "outer_back": outer,  # scalp, back of the neck, shoulders
        "mouth_socket": _together([piece for piece, count in zip(inner, sides) if count == 2]),
        "eye_sockets": _together([piece for piece, count in zip(inner, sides) if count == 1]),
        "gums_and_tongue": materials["M_GumsTongue"],
        "teeth": teeth,
        "teeth_upper": teeth[~lower],
        "teeth_lower": teeth[lower],
        "left_eyeball": np.union1d(materials["M_ScleraLeft"], materials["M_IrisLeft"]),
        "right_eyeball": np.union1d(materials["M_ScleraRight"], materials["M_IrisRight"]),
        "left_sclera": materials["M_ScleraLeft"],
        "right_sclera": materials["M_ScleraRight"],
        "eyelashes": materials["M_EyeLashes"],
        "lacrimal_fluid": materials["M_LacrimalFluid"],
        "eye_occlusion": materials["M_EyeOcclusion"],
        "eye_blend": materials["M_EyeBlend"],
    }


def regions_of(
    template: FloatArray, faces: IntArray, parts: Parts, profile: Profile, landmarks: IntArray
) -> dict[str, IntArray]:
    """Regions by name: FLAME's, and the kit's own pieces."""
    points = template[landmarks]
    length = profile.length
    everything = np.arange(len(template))
    skin = np.zeros(len(template), dtype=bool)
    skin[parts["face_material"]] = True
    x, y, z = template.T

    # Seen from the side, the contour runs from the ear to the chin with the face in front of it. The landmarks are in
    # front of the ear, so the line is moved back, less towards the chin; above the ear the face extends as far back as
    # its material.
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
    outer[parts["outer_back"]] = True
    neck = (skin | outer) & ~face & ~ear & (height < profile.neck_top) & (height > profile.neck_base)

    brow = points[list(_BROWS), 1].max()
    nose = points[list(_NOSE)]
    masks = {
        "face": face,
        "forehead": face & (y > brow),
        "nose": face & _near(template, nose, 0.12 * length) & (y > nose[:, 1].min() - 0.02 * length),
        "lips": skin
        & points_in_poly(template[:, :2], _widened(points[list(_OUTER_LIPS), :2], 0.02 * length))
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
    pieces = {name: piece for name, piece in parts.items() if name not in ("face_material", "outer_back")}
    return regions | pieces | {"boundary": np.intersect1d(border_edges(faces), everything[skin | outer])}


def _together(pieces: list[IntArray]) -> IntArray:
    return np.sort(np.concatenate([np.empty(0, np.int64), *pieces]))


def _near(template: FloatArray, points: FloatArray, radius: float) -> np.ndarray:
    """Whether each vertex is within the radius of one of the points."""
    distance = np.linalg.norm(template[:, None] - points[None], axis=2)
    return distance.min(1) < radius


def _widened(polygon: FloatArray, margin: float) -> FloatArray:
    """The polygon (n, 2) with its corners moved away from its middle."""
    away = polygon - polygon.mean(0)
    return polygon + margin * away / np.linalg.norm(away, axis=1, keepdims=True)


class Hinge(NamedTuple):
    """A rotation about an axis parallel to x: the motion of a jaw that opens."""

    angle: float  # radians, positive opens (from +y towards +z)
    center: FloatArray  # (3,) a point of the axis, with x = 0

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) rotation."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])

    def displacement(self, points: FloatArray) -> FloatArray:
        """Displacement of points (n, 3) by the full motion."""
        return (points - self.center) @ (self.matrix - np.eye(3)).T


def fit_hinge(points: FloatArray, moved: FloatArray) -> Hinge:
    """Least-squares hinge that takes points to moved points, both (n, 3). Planar case of the orthogonal Procrustes
    problem (Schoenemann 1966); the centre is the fixed point of the fitted rigid motion of the y-z plane."""
    plane, target = points[:, 1:], moved[:, 1:]
    middle, target_middle = plane.mean(0), target.mean(0)
    a, b = plane - middle, target - target_middle
    angle = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    if abs(angle) < 1e-3:
        raise ValueError(f"a motion of {angle:.2g} radians has no centre of rotation")
    turn = Hinge(angle, np.zeros(3)).matrix[1:, 1:]
    center = np.linalg.solve(np.eye(2) - turn, target_middle - turn @ middle)
    return Hinge(angle, np.array([0.0, *center]))


def hinge_weights(hinge: Hinge, points: FloatArray, displacement: FloatArray, softness: float) -> FloatArray:
    """Fraction of the hinge's motion that each point follows, in [0, 1].

    The least-squares factor of the rigid motion that explains the displacement; ``softness`` (metres) damps it near
    the axis, where the rigid motion is small and the quotient unreliable.
    """
    rigid = hinge.displacement(points)
    share = (rigid * displacement).sum(1) / ((rigid**2).sum(1) + softness**2)
    return np.clip(share, 0.0, 1.0)


def hinge_correctives(
    hinge: Hinge, points: FloatArray, displacement: FloatArray, weights: FloatArray
) -> FloatArray:
    """(n, 3, 9) pose basis of the hinge's joint: the displacement not explained by skinning.

    Added to the points before skinning, it gives exactly ``points + displacement`` at the full angle. It is
    proportional to the sine of the angle, with one half in each off-diagonal element of R - I about x.
    """
    blended = weights[:, None, None] * (hinge.matrix - np.eye(3)) + np.eye(3)
    shift = weights[:, None] * (hinge.center - hinge.matrix @ hinge.center)
    wanted = np.linalg.solve(blended, (points + displacement - shift)[..., None])[..., 0] - points
    basis = np.zeros((len(points), 3, 9))
    basis[:, :, 7] = wanted / (2 * np.sin(hinge.angle))  # element (2, 1), +sine
    basis[:, :, 5] = -basis[:, :, 7]  # element (1, 2), -sine
    return basis
