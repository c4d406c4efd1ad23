"""One subject with skin, hair, eyes and mouth: meshes to render for a head pose and activations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from ...bench.contracts import FloatArray, HeadAsset, HeadPose, IntArray
from ..head.arrays import HeadArrays, region
from ..head.geometry import LENGTH_BITS, on_grid, smoothstep, triangle_areas, vertex_normals
from ..head.model import HeadModel, joint_motions
from ..head.rotations import axis_angle_to_matrix
from .anatomy import SIDES, Anatomy, Person, linear, measure, smooth_curve, value_noise
from .fine_mesh import FineMesh, refine
from .hair import (
    STYLES,
    RootedStrands,
    Strands,
    ear_share,
    make_beard,
    make_brows_and_lashes,
    make_hair,
    smoothed,
    without_joints,
)
from .history import FREE_LENGTH, NECK_SHARE, SkinState
from .parts import eye_mesh, tracked_parts
from .performance import EXPRESSION_CONTROLS, Activations, Translation
from .plan import Geometry
from .skin import gloss_at_rest, make_folds, paint_skin, sagging

_SIDES_OF_TUBE = 8
_WRAP = 3.0  # 1/m: how the front bends around the face
_ROOM = 0.002  # metres between skin and frame
_COLORS = {
    "metal": ("#8a8a8c", "#b3975f", "#3a3a3c"),
    "plastic": ("#1c1a19", "#5a3420", "#25324a", "#6b1f24"),
}
_RADIUS = {"metal": 0.0009, "plastic": 0.0014}


@dataclass(frozen=True, eq=False)
class GlassesFrame:
    """(n, 3) vertices at rest, (m, 3) triangles, (n, 3) linear reflectance."""

    vertices: FloatArray
    faces: IntArray
    albedo: FloatArray


def make_glasses(
    person: Person, anatomy: Anatomy, points: FloatArray, normals: FloatArray
) -> GlassesFrame | None:
    """A frame that sits on the neutral skin (N, 3), or none."""
    if not person.glasses:
        return None
    s, rng = anatomy.scale, np.random.default_rng([person.seed, 17])
    radius = _RADIUS[person.glasses] * s
    half = np.array([0.0245, 0.0195]) * s * rng.uniform(0.92, 1.06, 2)
    roundness = rng.uniform(2.2, 3.6)
    color = linear(_COLORS[person.glasses][rng.integers(len(_COLORS[person.glasses]))])
    turn = np.linspace(0.0, 2.0 * np.pi, 56, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ring = half * np.sign(ring) * np.abs(ring) ** (2.0 / roundness)
    level = 0.5 * sum(anatomy.eyes[side].center[1] for side in SIDES) - 0.002 * s
    lens = 0.0345 * s
    outlines = {side: ring + np.array([sign * lens, level]) for side, sign in zip(SIDES, (1.0, -1.0))}
    front = points[normals[:, 2] > 0.2]
    flat = cKDTree(front[:, :2])
    depth = max(
        front[near, 2].max() + _WRAP / s * at[0] ** 2
        for outline in outlines.values()
        for at, near in zip(outline, flat.query_ball_point(outline, 0.003 * s))
        if near
    ) + (_ROOM * s + radius)

    def placed(at: FloatArray) -> FloatArray:
        return np.concatenate([at, (depth - _WRAP / s * at[:, :1] ** 2)], axis=1)

    tubes = [_tube(placed(outline), radius, np.array([0.0, 0.0, 1.0]), True) for outline in outlines.values()]
    inner = lens - half[0]
    x = np.linspace(-inner, inner, 11)
    bridge = placed(np.stack([x, level + 0.004 * s + 0.004 * s * (1.0 - (x / inner) ** 2)], axis=1))
    bridge[:, 2] = np.maximum(bridge[:, 2], anatomy["nose_bridge"][2] + _ROOM * s + radius)
    tubes.append(_tube(bridge, radius, np.array([0.0, 1.0, 0.0]), False))
    skin = cKDTree(points)
    for side, sign in zip(SIDES, (1.0, -1.0)):
        ear = anatomy[f"{side}_ear"]
        hinge = placed(np.array([[sign * (lens + 0.96 * half[0]), level + 0.45 * half[1]]]))[0]
        wide = sign * max(abs(ear[0]) - 0.008 * s, abs(hinge[0]) + 0.004 * s)
        temple = smooth_curve(
            np.stack(
                [
                    hinge,
                    np.array([0.35 * hinge[0] + 0.65 * wide, hinge[1], hinge[2] - 0.016 * s]),
                    np.array([wide, 0.5 * (hinge[1] + ear[1] + 0.026 * s), 0.5 * (hinge[2] + ear[2])]),
                    np.array([wide, ear[1] + 0.026 * s, ear[2] + 0.006 * s]),
                    np.array([wide - sign * 0.006 * s, ear[1] + 0.008 * s, ear[2] - 0.014 * s]),
                ]
            ),
            28,
        )
        _, near = skin.query(temple)
        below = _ROOM * s + radius - ((temple - points[near]) * normals[near]).sum(axis=1)
        temple[1:-4] += (np.maximum(below, 0.0)[:, None] * normals[near])[1:-4]
        tubes.append(_tube(temple, radius, np.array([0.0, 1.0, 0.0]), False))
    first = np.cumsum([0, *(len(vertices) for vertices, _ in tubes)])
    vertices = np.concatenate([vertices for vertices, _ in tubes])
    faces = np.concatenate([faces + start for (_, faces), start in zip(tubes, first)])
    return GlassesFrame(vertices, faces, np.tile(color, (len(vertices), 1)))


def _tube(path: FloatArray, radius: float, up: FloatArray, closed: bool) -> tuple[FloatArray, IntArray]:
    """A tube along (k, 3); ``up`` is never along it."""
    along = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if closed else np.gradient(path, axis=0)
    across = np.cross(along, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upright = np.cross(across, along)
    upright /= np.linalg.norm(upright, axis=1, keepdims=True)
    turn = np.linspace(0.0, 2.0 * np.pi, _SIDES_OF_TUBE, endpoint=False)
    ring = np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * upright[:, None]
    index = np.arange(len(path) * _SIDES_OF_TUBE).reshape(len(path), _SIDES_OF_TUBE)
    a, b = (index, np.roll(index, -1, axis=0)) if closed else (index[:-1], index[1:])
    a1, b1 = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate(
        [np.stack([a, a1, b1], -1).reshape(-1, 3), np.stack([a, b1, b], -1).reshape(-1, 3)]
    )
    return (path[:, None] + radius * ring).reshape(-1, 3), faces


DRIVERS: tuple[tuple[str, str], ...] = (
    *((f"smile_{side}", "jaw_open") for side in SIDES),
    *((f"cheek_raise_{side}", f"smile_{side}") for side in SIDES),
    *((f"nose_sneer_{side}", f"upper_lip_up_{side}") for side in SIDES),
    ("brow_inner_up", "brow_outer_up_left"),
    ("brow_down_left", "brow_down_right"),
    ("mouth_frown", "chin_raise"),
    ("funnel", "jaw_open"),
    ("pucker", "pucker"),
    ("cheek_puff", "cheek_puff"),
)
"""Two controls whose product drives a corrective; the same one twice is its square."""
FACE_MM = 0.75
"""Root mean square displacement of the face by each corrective at level 1, where both of its controls are 1. A choice in the
range of the errors of trackers."""
_BROAD = 0.2
"""Fraction of the largest displacement by its controls at which a corrective has half its strength."""
_PERIOD = 0.04
"""Metres between the lattice points of a field, for a head of average size."""


def strengths(activations: Activations) -> FloatArray:
    """(C,) products of the controls that drive the correctives."""
    return np.array([activations[first] * activations[second] for first, second in DRIVERS])


def make_correctives(
    person: Person, anatomy: Anatomy, head: HeadArrays, neutral: FloatArray, translation: Translation
) -> FloatArray:
    """(C, V, 3) displacements, metres, of a subject's neutral vertices (V, 3) at level 1; joints do not move."""
    skin = np.zeros(len(neutral), bool)
    skin[anatomy.skin_faces] = True
    basis = np.asarray(head.expression_basis, np.float64)
    face = np.intersect1d(region(head, "face"), np.flatnonzero(skin))
    strips = []
    for number, pair in enumerate(DRIVERS):
        rows = [EXPRESSION_CONTROLS.index(name) for name in pair if name in EXPRESSION_CONTROLS]
        moved = np.linalg.norm(basis @ translation.expression[rows].sum(axis=0), axis=1)
        where = neutral / (_PERIOD * anatomy.scale)
        noise = [value_noise(where + 31.7 * axis, person.seed + 120 + number) for axis in range(3)]
        reach = np.where(skin, moved / (moved + _BROAD * moved[skin].max()), 0.0)
        field = _beyond(basis, reach[:, None] * np.stack(noise, axis=1), skin)
        amount = on_grid(1e-3 * FACE_MM / np.sqrt((field[face] ** 2).sum(axis=1).mean()), LENGTH_BITS)
        strips.append(without_joints(head, amount * field))
    return np.stack(strips)


def _beyond(basis: FloatArray, field: FloatArray, skin: FloatArray) -> FloatArray:
    """(V, 3) residual of a field on the ``skin`` (V,) after its least-squares fit by a ``basis`` (V, 3, E)."""
    directions, left = basis[skin].reshape(-1, basis.shape[2]), field.copy()
    wanted = field[skin].ravel()
    found, *_ = np.linalg.lstsq(directions, wanted, rcond=None)
    left[skin] = (wanted - directions @ found).reshape(-1, 3)
    return left


def displacement(correctives: FloatArray, level: float, activations: Activations) -> FloatArray:
    """(V, 3) displacement by all correctives (C, V, 3), on the grid of lengths."""
    driven = level * strengths(activations)
    return on_grid((driven[:, None, None] * correctives).sum(axis=0), LENGTH_BITS)


_STRETCH_GLOSS, _LEAST, _MOST = 3.0, 0.6, 1.25  # exponent of the stretch of area, and the range of the latter
_WET = 1.2  # increase of the lips' gloss by wetness
HEAD_JOINT, EYE_JOINTS = 1, (3, 4)
_NECK_ROUNDS = 6  # of averaging over neighbours

# Edge lengths of the fine mesh (metres at average size) by distance from the bridge of the nose.
_DETAIL = ((0.085, 0.0018), (0.13, 0.0035), (np.inf, 0.007))


@dataclass(frozen=True, eq=False)
class PosedMesh:
    """A mesh to render: ``vertices`` (n, 3), and ``albedo`` (n, 3) and ``gloss`` (n,) if they change."""

    vertices: FloatArray
    albedo: FloatArray | None
    gloss: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class RestMesh:
    """Constant parts of a mesh: triangles, colours at rest, material."""

    faces: IntArray
    albedo: FloatArray
    material: str


@dataclass(frozen=True, eq=False)
class LatePoses:
    """Delayed poses of hair and neck, see `history`."""

    hair: HeadPose
    neck: HeadPose


class RenderedSubject:
    """A subject's visible body over a head model. ``shape``: (S,) identity coefficients. ``correctives``: Level of
    shapes of the skin that the head model lacks, see `correctives`."""

    def __init__(
        self, person: Person, geometry: Geometry, shape: FloatArray, correctives: float = 0.0
    ) -> None:
        head = geometry.head
        self.shape = np.asarray(shape, np.float64)
        self._model = HeadModel(head, dtype=torch.float64)
        self.neutral = self._model.canonical(torch.from_numpy(self.shape))[0].numpy()
        self.anatomy = measure(head, self.neutral)
        self._fine = _fine_mesh(self.anatomy, self.neutral)
        points = self._fine.positions(self.neutral)
        normals = vertex_normals(points, self._fine.faces)
        cavity = _region_share(self._fine, head, ("mouth_socket",))
        paint = paint_skin(person, self.anatomy, points, normals, cavity)
        ears = ear_share(self.anatomy, points, _region_share(self._fine, head, ("left_ear", "right_ear")))
        hair = make_hair(person, self.anatomy, points, normals, self._fine.faces, ears)
        under = paint.albedo + hair.share[:, None] * (0.75 * person.hair - paint.albedo)
        self._folds = make_folds(person, self.anatomy, points, paint.lips, 1.0 - hair.share)
        self._skin_albedo, self._cap = under, hair.cap
        self._hair = hair.strands
        self.hair_share = hair.share
        self.hair_length = STYLES[person.style].length * self.anatomy.scale
        self._swing = swing(hair.strands)
        self._neck = _neck_share(head, self.anatomy)
        self._level, self._correctives = correctives, None
        if correctives:
            self._correctives = make_correctives(
                person, self.anatomy, head, self.neutral, geometry.translation
            )
        self._brows = make_brows_and_lashes(person, self.anatomy, points, normals)
        self._beard = make_beard(person, self.anatomy, points, normals, self._fine.faces, cavity)
        self._glasses = make_glasses(person, self.anatomy, points, normals)
        if person.sag:
            self._cap = self._cap + sagging(person, self.anatomy, points)
        self._rest_points = points
        self._lips = paint.lips
        self._area = np.maximum(_area_around(self.neutral, self.anatomy.skin_faces), 1e-9)
        self._gloss = None
        if person.oil:
            self._gloss = gloss_at_rest(person, self.anatomy, points, paint.lips) * (1.0 - 0.5 * hair.share)
        self._eyes = {side: eye_mesh(person, self.anatomy.eyes[side]) for side in SIDES}
        self._mouth = tuple(geometry.mouth(person, self.anatomy, self.shape))
        self._tracked_parts = tracked_parts(head)
        self._brow_frames = self._fine.frames(self.neutral, self._brows.root)
        self._beard_frames = (
            None if self._beard is None else self._fine.frames(self.neutral, self._beard.root)
        )

    def rest_meshes(self) -> dict[str, RestMesh]:
        """Meshes by name."""
        fixed = {
            "skin": RestMesh(self._fine.faces, self._skin_albedo, "skin"),
            "hair": RestMesh(self._hair.faces, self._hair.albedo, "hair"),
            "brows": RestMesh(self._brows.strands.faces, self._brows.strands.albedo, "lash"),
        }
        if self._beard:
            fixed["beard"] = RestMesh(self._beard.strands.faces, self._beard.strands.albedo, "hair")
        if self._glasses:
            fixed["glasses"] = RestMesh(self._glasses.faces, self._glasses.albedo, "frame")
        fixed |= {f"eye_{side}": RestMesh(e.faces, e.albedo, "eye") for side, e in self._eyes.items()}
        fixed |= {p.name: RestMesh(p.faces, p.albedo, p.material) for p in self._mouth}
        return fixed | {p.name: RestMesh(p.faces, p.albedo, p.material) for p in self._tracked_parts}

    def tracked(self, pose: HeadPose) -> FloatArray:
        """(V, 3) vertices of the head model in a pose: the mesh that a tracker would report."""
        arguments = self._model.pose_arguments([pose])
        with torch.no_grad():
            return self._model(shape=torch.from_numpy(self.shape), **arguments)[0].numpy()

    def _shown(self, pose: HeadPose, activations: Activations) -> FloatArray:
        """(V, 3) vertices as rendered: with the shapes that the head model lacks."""
        if self._correctives is None:
            return self.tracked(pose)
        neutral = self.neutral + displacement(self._correctives, self._level, activations)
        with torch.no_grad():
            arguments = self._model.pose_arguments([pose])
            return self._model(canonical=torch.from_numpy(neutral)[None], **arguments)[0].numpy()

    def posed_meshes(
        self, pose: HeadPose, activations: Activations, state: SkinState, late: LatePoses | None = None
    ) -> dict[str, PosedMesh]:
        """All meshes in a pose, with the tongue of the ``activations``, and wrinkles and colour of a state of skin.
        Hair and the skin of the neck are drawn towards the ``late`` poses."""
        tracked = self._shown(pose, activations)
        joints = self._joint_motions(pose)
        hair = _moved(joints[HEAD_JOINT], self._hair.vertices)
        if late is not None:
            tracked = tracked + NECK_SHARE * self._neck * (self._shown(late.neck, activations) - tracked)
            swung = _moved(self._joint_motions(late.hair)[HEAD_JOINT], self._hair.vertices)
            hair = hair + self._swing * (swung - hair)
        points = self._fine.positions(tracked)
        normals = vertex_normals(points, self._fine.faces)
        lift, albedo = self._folds.apply(state.folds, state.flushes, self._skin_albedo)
        gloss = None if self._gloss is None else self._stretched_gloss(tracked, self._gloss, state.wet)
        outer = points + (lift + self._cap)[:, None] * normals
        bare = points + lift[:, None] * normals
        meshes = {
            "skin": PosedMesh(outer, albedo, gloss),
            "hair": PosedMesh(hair, None),
            "brows": PosedMesh(self._rooted_vertices(self._brows, self._brow_frames, tracked, bare), None),
        }
        if self._beard and self._beard_frames is not None:
            beard = self._rooted_vertices(self._beard, self._beard_frames, tracked, outer)
            meshes["beard"] = PosedMesh(beard, None)
        if self._glasses:
            meshes["glasses"] = PosedMesh(_moved(joints[HEAD_JOINT], self._glasses.vertices), None)
        for side, joint in zip(SIDES, EYE_JOINTS):
            meshes[f"eye_{side}"] = PosedMesh(_moved(joints[joint], self._eyes[side].vertices), None)
        for inner in self._tracked_parts:
            meshes[inner.name] = PosedMesh(tracked[inner.vertices], None)
        for part in self._mouth:
            rest = part.at(activations["tongue_out"])
            blended = np.einsum("nj,jab->nab", part.weights, joints)
            meshes[part.name] = PosedMesh(
                np.einsum("nab,nb->na", blended[..., :3], rest) + blended[..., 3], None
            )
        return meshes

    def _stretched_gloss(self, tracked: FloatArray, rest: FloatArray, wet: float) -> FloatArray:
        """Skin that is stretched loses its fine relief and shines more; so do wet lips."""
        area = _area_around(tracked, self._fine.coarse_faces)
        stretch = self._fine.interpolate(np.clip(area / self._area, _LEAST, _MOST))
        return np.clip(rest * stretch**_STRETCH_GLOSS * (1.0 + _WET * wet * self._lips), 0.1, 4.0)

    def _rooted_vertices(
        self, rooted: RootedStrands, frames: FloatArray, tracked: FloatArray, points: FloatArray
    ) -> FloatArray:
        """Hairs turn with the triangle that they grow from, whose frames at rest are ``frames``."""
        root, strand = rooted.root, rooted.strands.strand
        turn = self._fine.frames(tracked, root) @ frames.transpose(0, 2, 1)
        local = rooted.strands.vertices - self._rest_points[root][strand]
        return points[root][strand] + np.einsum("nab,nb->na", turn[strand], local)

    def _joint_motions(self, pose: HeadPose) -> FloatArray:
        """(J, 3, 4) motion of parts that are rigidly attached to each joint, from rest to ``pose``."""
        expression = torch.from_numpy(np.asarray(pose.expression, np.float64))
        joints = self._model.joints(torch.from_numpy(self.shape), expression)
        angles = np.stack([pose.rotation, pose.neck, pose.jaw, pose.eyes[:3], pose.eyes[3:]])
        rotations = axis_angle_to_matrix(torch.from_numpy(np.asarray(angles, np.float64))[None])
        # The same motion that skinning gives to a tracked vertex of full weight.
        motions = joint_motions(rotations, joints, self._model.parents)[0].numpy()
        motions[..., 3] += pose.translation
        return motions


def swing(strands: Strands) -> FloatArray:
    """(n, 1) share of the hair's lag that vertices of ``strands`` show: 0 at the roots."""
    first = np.unique(strands.strand, return_index=True)[1]
    roots = strands.vertices[first][strands.strand]
    return smoothstep(np.linalg.norm(strands.vertices - roots, axis=1), 0.0, FREE_LENGTH)[:, None]


def _neck_share(head: HeadAsset, anatomy: Anatomy) -> FloatArray:
    """(V, 1) share of the neck's lag by vertex: 0 in the face and at the border of the neck."""
    named = np.zeros((len(head.template), 1))
    named[head.regions.get("neck", [])] = 1.0
    return named * smoothstep(smoothed(named, anatomy.skin_faces, _NECK_ROUNDS), 0.5, 1.0)


def _area_around(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(V,) area of the triangles around each vertex."""
    areas = np.repeat(triangle_areas(vertices, faces), 3)
    return np.asarray(np.bincount(faces.ravel(), areas, len(vertices)), np.float64)


def _moved(motion: FloatArray, points: FloatArray) -> FloatArray:
    return points @ motion[:, :3].T + motion[:, 3]


def _fine_mesh(anatomy: Anatomy, neutral: FloatArray) -> FineMesh:
    distance = np.linalg.norm(neutral - anatomy["nose_bridge"], axis=1) / anatomy.scale
    target = np.full(len(neutral), _DETAIL[-1][1])
    for reach, length in reversed(_DETAIL):
        target = np.where(distance < reach, length, target)
    return refine(neutral, anatomy.skin_faces, target * anatomy.scale)


def _region_share(fine: FineMesh, head: HeadAsset, names: Sequence[str]) -> FloatArray:
    """(N,) share of fine points in tracked regions; regions the head does not name are empty."""
    inside = np.zeros(len(head.template))
    for name in names:
        inside[head.regions.get(name, [])] = 1.0
    return fine.interpolate(inside)
