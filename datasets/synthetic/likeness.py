"""One subject, dressed: from a head pose and activations to the meshes a camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ...bench.contracts import FloatArray, HeadAsset, HeadPose, IntArray
from ..head.geometry import vertex_normals
from ..head.model import HeadModel, chain_transforms
from ..head.rotations import axis_angle_to_matrix
from .anatomy import SIDES, Anatomy, measure
from .brows import make_brows_and_lashes
from .controls import Activations
from .eyes import eye_mesh
from .geometry import Geometry
from .hair import ear_share, make_hair
from .mouth import tracked_parts
from .people import Person
from .refine import FineMesh, refine
from .skin import paint_skin
from .wrinkles import make_folds

HEAD_JOINT, EYE_JOINTS = 1, (3, 4)

# Edge lengths of the fine mesh (metres at average size) by distance from the bridge of the nose.
_DETAIL = ((0.085, 0.0018), (0.13, 0.0035), (np.inf, 0.007))


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh as the studio takes it: ``vertices`` (n, 3) and ``albedo`` (n, 3) of one moment."""

    vertices: FloatArray
    albedo: FloatArray | None


@dataclass(frozen=True, eq=False)
class Fixture:
    """What of a mesh does not change: triangles, colours at rest, material."""

    faces: IntArray
    albedo: FloatArray
    material: str


class Likeness:
    """A subject's visible body over a head model; ``shape`` (S,) are the subject's identity coefficients."""

    def __init__(self, person: Person, geometry: Geometry, shape: FloatArray) -> None:
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
        under = paint.albedo + hair.share[:, None] * (0.55 * person.hair - paint.albedo)
        self._folds = make_folds(person, self.anatomy, points, paint.lips, 1.0 - hair.share)
        self._skin_albedo, self._cap = under, hair.cap
        self._hair = hair.strands
        self._rooted = make_brows_and_lashes(person, self.anatomy, points, normals)
        self._rest_points = points
        self._eyes = {side: eye_mesh(person, self.anatomy.eyes[side]) for side in SIDES}
        self._mouth = tuple(geometry.mouth(person, self.anatomy, self.shape))
        self._tracked_parts = tracked_parts(head)
        self._frames = self._fine.frames(self.neutral, self._rooted.root)

    def fixtures(self) -> dict[str, Fixture]:
        """Meshes by name."""
        fixed = {
            "skin": Fixture(self._fine.faces, self._skin_albedo, "skin"),
            "hair": Fixture(self._hair.faces, self._hair.albedo, "hair"),
            "brows": Fixture(self._rooted.strands.faces, self._rooted.strands.albedo, "lash"),
        }
        fixed |= {f"eye_{side}": Fixture(e.faces, e.albedo, "eye") for side, e in self._eyes.items()}
        fixed |= {p.name: Fixture(p.faces, p.albedo, p.material) for p in self._mouth}
        return fixed | {p.name: Fixture(p.faces, p.albedo, p.material) for p in self._tracked_parts}

    def tracked(self, pose: HeadPose) -> FloatArray:
        """(V, 3) vertices of the head model in a pose: the mesh that a tracker would report."""
        arguments = self._model.pose_arguments([pose])
        with torch.no_grad():
            return self._model(shape=torch.from_numpy(self.shape), **arguments)[0].numpy()

    def surfaces(self, pose: HeadPose, activations: Activations) -> dict[str, Surface]:
        """All meshes in a pose; wrinkles and colour follow ``activations``."""
        tracked = self.tracked(pose)
        joints = self._joint_motions(pose)
        points = self._fine.positions(tracked)
        normals = vertex_normals(points, self._fine.faces)
        lift, albedo = self._folds.apply(activations, self._skin_albedo)
        made = {
            "skin": Surface(points + (lift + self._cap)[:, None] * normals, albedo),
            "hair": Surface(_moved(joints[HEAD_JOINT], self._hair.vertices), None),
            "brows": Surface(self._rooted_vertices(tracked, points + lift[:, None] * normals), None),
        }
        for side, joint in zip(SIDES, EYE_JOINTS):
            made[f"eye_{side}"] = Surface(_moved(joints[joint], self._eyes[side].vertices), None)
        for inner in self._tracked_parts:
            made[inner.name] = Surface(tracked[inner.vertices], None)
        for part in self._mouth:
            rest = part.at(activations["tongue_out"])
            blended = np.einsum("nj,jab->nab", part.weights, joints)
            made[part.name] = Surface(np.einsum("nab,nb->na", blended[..., :3], rest) + blended[..., 3], None)
        return made

    def _rooted_vertices(self, tracked: FloatArray, points: FloatArray) -> FloatArray:
        """Brows and lashes turn with the triangle they grow from."""
        root, strand = self._rooted.root, self._rooted.strands.strand
        turn = self._fine.frames(tracked, root) @ self._frames.transpose(0, 2, 1)
        local = self._rooted.strands.vertices - self._rest_points[root][strand]
        return points[root][strand] + np.einsum("nab,nb->na", turn[strand], local)

    def _joint_motions(self, pose: HeadPose) -> FloatArray:
        """(J, 3, 4) motion of what hangs rigidly on each joint, from rest to ``pose``."""
        expression = torch.from_numpy(np.asarray(pose.expression, np.float64))
        joints = self._model.joints(torch.from_numpy(self.shape), expression)
        angles = np.stack([pose.rotation, pose.neck, pose.jaw, pose.eyes[:3], pose.eyes[3:]])
        rotations = axis_angle_to_matrix(torch.from_numpy(np.asarray(angles, np.float64))[None])
        world = chain_transforms(rotations, joints, self._model.parents)[0].numpy()
        # The same motion that skinning gives to a tracked vertex of full weight.
        turned = np.einsum("jab,jb->ja", world[..., :3], joints[0].numpy())
        offset = world[..., 3] - turned + pose.translation
        return np.concatenate([world[..., :3], offset[..., None]], axis=-1)


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
