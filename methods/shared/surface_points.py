"""The posed mesh of a subject, and points spread evenly over a triangle mesh, given by triangle and barycentric coordinates."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.contracts import BoolArray, Camera, Clip, FloatArray, HeadAsset, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...bench.native.dispatch import on_host
from ...datasets.head.arrays import check_size
from ...datasets.head.geometry import project, triangle_areas
from ...datasets.head.model import HeadModel
from ...datasets.head.rotations import matrices_and_derivatives
from ..ops.splats import TriangleFrames, triangle_frames
from .schedule import numpy_generator
from .tensor_files import MAX_MAGNITUDE, check_tensors

Value = TypeVar("Value")


DRIVING = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")


class _Rig(NamedTuple):
    """A head model with one identity: (3 V,) neutral mesh, (J, 3) its joints, (J, V) skinning weights."""

    model: HeadModel
    neutral: Tensor
    joints: FloatArray
    weights: Tensor


class _PosedMesh(torch.autograd.Function):
    """`HeadModel.forward` of one timestep in host memory, in a few passes over the vertices.

    Rotations and joints are computed by numpy in float64: torch's functions take longer for a few numbers than for the mesh.
    """

    @staticmethod
    def forward(ctx: Any, rig: _Rig, *values: Any) -> Tensor:
        *tracked, lids = values
        model = rig.model
        expression, *angles, translation = (value.detach()[0] for value in tracked)
        rotations, ctx.derivatives = matrices_and_derivatives(
            torch.cat(angles).double().numpy().reshape(-1, 3)
        )
        joints = rig.joints + (expression @ model.joint_matrix).numpy().reshape(-1, 3).astype(np.float64)
        turns, shifts = [rotations[0]], [joints[0] - rotations[0] @ joints[0]]
        for joint, parent in enumerate(model.parents[1:], start=1):
            turns.append(turns[parent] @ rotations[joint])
            shifts.append(shifts[parent] + (turns[parent] - turns[joint]) @ joints[joint])
        motions = np.concatenate([np.array(turns), np.array(shifts)[:, :, None]], axis=2)
        feature = torch.from_numpy((rotations[1:] - np.eye(3)).ravel()).to(expression)
        shaped = torch.addmv(rig.neutral, model.expression_matrix.t(), expression)
        shaped = torch.addmv(shaped, model.pose_matrix.t(), feature).view(-1, 3).t().contiguous()
        blended = torch.from_numpy(motions.reshape(-1, 12).T).to(shaped) @ rig.weights
        blended = blended.view(3, 4, -1)
        vertices = blended[:, 3] + translation[:, None]
        for axis in range(3):
            vertices.addcmul_(blended[:, axis], shaped[axis])
        raised = None
        if lids is not None and model.eyelid_matrix is not None:
            raised = (lids.detach()[0] @ model.eyelid_matrix).view(-1, 3).t()
            vertices.addmm_(torch.from_numpy(turns[1]).to(shaped), raised)
        ctx.rig, ctx.small = rig, (rotations, joints, turns)
        ctx.save_for_backward(shaped, blended, raised)
        return vertices.t().contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_vertices: Tensor) -> tuple[Tensor | None, ...]:
        shaped, blended, raised = ctx.saved_tensors
        model, weights = ctx.rig.model, ctx.rig.weights
        rotations, joints, turns = ctx.small
        gradient = by_vertices.t().contiguous()
        by_shaped = blended[0, :3] * gradient[0]
        for row in (1, 2):
            by_shaped.addcmul_(blended[row, :3], gradient[row])
        by_blended = torch.cat([gradient[:, None] * shaped, gradient[:, None]], dim=1)
        by_motions = (by_blended.view(12, -1) @ weights.t()).t().double().numpy().reshape(-1, 3, 4)
        by_turns, by_shifts = by_motions[:, :, :3].copy(), by_motions[:, :, 3].copy()
        by_flat = by_shaped.t().reshape(-1)
        by_rotations, by_joints = np.zeros_like(rotations), np.zeros_like(joints)
        by_rotations[1:] = (model.pose_matrix @ by_flat).double().numpy().reshape(-1, 3, 3)
        by_lids = None
        if raised is not None:
            by_turns[1] += (gradient @ raised.t()).double().numpy()
            lifted = torch.from_numpy(turns[1].T).to(shaped) @ gradient
            by_lids = (model.eyelid_matrix @ lifted.t().reshape(-1))[None]
        for joint, parent in reversed([*enumerate(model.parents)][1:]):
            bend = np.outer(by_shifts[joint], joints[joint])
            by_joints[joint] = (turns[parent] - turns[joint]).T @ by_shifts[joint]
            by_shifts[parent] += by_shifts[joint]
            by_turns[joint] -= bend
            by_turns[parent] += bend + by_turns[joint] @ rotations[joint].T
            by_rotations[joint] += turns[parent].T @ by_turns[joint]
        by_joints[0] = by_shifts[0] - rotations[0].T @ by_shifts[0]
        by_rotations[0] = by_turns[0] - np.outer(by_shifts[0], joints[0])
        by_angles = np.einsum("jrck,jrc->jk", ctx.derivatives, by_rotations).ravel()
        of_joints, of_angles = (torch.from_numpy(each).to(shaped) for each in (by_joints.ravel(), by_angles))
        by_expression = torch.addmv(model.expression_matrix @ by_flat, model.joint_matrix, of_joints)
        parts = by_expression, *of_angles.split([3, 3, 3, 6]), gradient.sum(1)
        return None, *(part[None] for part in parts), by_lids


class SubjectMesh:
    """A head model with fixed identity, driven by expression, pose and translation.

    - ``shape``: (S,) identity coefficients.
    - ``static_offset``: (V, 3) metres, added to the shaped template.
    """

    def __init__(self, head: HeadAsset, shape: FloatArray, static_offset: FloatArray, device: str):
        self.model = HeadModel(head, device=device)
        self.faces = self.model.faces
        like = self.model.template
        # Copies: a clip's arrays are read-only and shared by all methods.
        identity, offset = (torch.tensor(np.asarray(each)).to(like) for each in (shape, static_offset))
        self._canonical = self.model.canonical(identity, offset)
        self._rig = _Rig(
            self.model,
            self.canonical.reshape(-1),
            (self.model.joint_regressor @ self.canonical).cpu().numpy(),
            self.model.skinning_weights.t().contiguous(),
        )
        check_size(
            "subject", "shape, static_offset", self._canonical[0].cpu().numpy(), np.asarray(head.faces)
        )

    @property
    def version(self) -> str:
        """Head model version; poses must carry the same."""
        return self.model.version

    @property
    def canonical(self) -> Tensor:
        """(V, 3) subject with zero expression, pose and translation."""
        return self._canonical[0]

    def arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Driving signal as tensors with a batch axis."""
        return self.model.pose_arguments(poses)

    def posed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(V, 3) vertices in the world for one timestep's arguments; differentiable in them."""
        if on_host(self._canonical):
            values = (arguments.get(name) for name in DRIVING)
            return _PosedMesh.apply(self._rig, *values)  # type: ignore[no-untyped-call, no-any-return]
        return self.model(canonical=self._canonical, **arguments)[0]

    def unposed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(V, 3) with only expression, jaw and eyes (and eyelids), without rotation, neck and translation."""
        still = {name: torch.zeros_like(arguments[name]) for name in ("rotation", "neck", "translation")}
        return self.posed({**arguments, **still})

    def frames(self, vertices: Tensor) -> TriangleFrames:
        """Triangle frames of a mesh; differentiable in its vertices."""
        return triangle_frames(vertices, self.faces)

    @torch.no_grad()
    def drive(self, pose: HeadPose) -> TriangleFrames:
        """Triangle frames of a pose in the world."""
        return self.frames(self.model.driven(self.canonical, self._rig.joints, pose))


class TrainingPoses:
    """Tracked values of the training timesteps of a clip, as arguments of its subject's mesh.

    - ``row``: row of each timestep, in rising order.
    - ``arguments``: (T, n) values by name, as `SubjectMesh.arguments` gives them.
    """

    def __init__(self, clip: Clip, mesh: SubjectMesh):
        timesteps = sorted({key.timestep for key in clip.splits["train"]})
        self.row = {timestep: row for row, timestep in enumerate(timesteps)}
        self.arguments = mesh.arguments([clip.poses[timestep] for timestep in timesteps])

    def at(self, row: int) -> dict[str, Tensor]:
        """The arguments of one timestep, with a batch axis."""
        return {name: values[row : row + 1] for name, values in self.arguments.items()}


def centroid_displacements(one: Tensor, other: Tensor, faces: Tensor) -> Tensor:
    """(F,) metres between the centroids of the triangles of two (V, 3) meshes."""
    moved = (one - other).index_select(0, faces.reshape(-1)).view(-1, 3, 3).mean(1)
    return torch.linalg.vector_norm(moved, dim=1)


class BoundedCache(Generic[Value]):
    """LRU cache: values by key, computed on request, with a maximum number of entries."""

    def __init__(self, compute: Callable[[int], Value], entries: int):
        self._compute, self._entries = compute, max(entries, 1)
        self._values: OrderedDict[int, Value] = OrderedDict()

    def __call__(self, key: int) -> Value:
        if key not in self._values:
            self._values[key] = self._compute(key)
            if len(self._values) > self._entries:
                self._values.popitem(last=False)
        self._values.move_to_end(key)
        return self._values[key]

    def __len__(self) -> int:
        return len(self._values)


def pose_key(pose: HeadPose) -> bytes:
    """All values of a pose as a key."""
    parts = [pose.head_model.encode()]
    for name in DRIVING:
        values = getattr(pose, name)
        parts.append(b"-" if values is None else np.asarray(values, np.float64).tobytes())
    return b"|".join(parts)


def mouth_mask(camera: Camera, mouth: FloatArray, middle: FloatArray) -> BoolArray:
    """(H, W) mask of the pixels within the convex hull of the (M, 3) projected points of the mouth.

    Empty if the mouth faces away, seen from the ``middle`` (3,) of the head, or is not in front of the camera.
    """
    mask, center = np.zeros((camera.height, camera.width), np.uint8), mouth.mean(0)
    depths = mouth @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    if depths.min() > 0 and (center - middle) @ (camera.center - center) > 0:
        import cv2  # not everywhere where methods are trained

        # cv2 counts from the centre of the first pixel, cameras from its corner.
        corners = np.round(project(mouth, camera) - 0.5).clip(-(2**15), 2**15).astype(np.int32)
        cv2.fillConvexPoly(mask, cv2.convexHull(corners), 1)
    return mask.astype(bool)


CANDIDATES = 20
"""Number of random candidates per accepted point."""
RADIUS = 0.77
"""Distance between Poisson-disk samples that fill a surface, relative to the square root of the area per sample;
measured between 1,000 and 50,000 samples of a head."""
NEIGHBOURS = 3
SMALLEST_SQUARE = 1e-7
"""Square metres; the minimum mean squared distance to neighbours, as published."""
POINT_MEMBERS = {
    "triangles": Member("i", ("N",), dtype="i4"),
    "barycentric": Member("f", ("N", 2), MAX_MAGNITUDE, "f4"),
}
"""Tensors of N points in an avatar's file: triangles, and the last two barycentric coordinates."""


class SurfacePoints(NamedTuple):
    """Points on a mesh: (P,) int64 triangles and (P, 3) barycentric coordinates, which add up to 1.

    The last two coordinates are float32 numbers, which is how they are stored.
    """

    triangles: IntArray
    barycentric: FloatArray

    def rows(self, chosen: IntArray) -> SurfacePoints:
        """Some of the points, by index or by a mask."""
        return SurfacePoints(self.triangles[chosen], self.barycentric[chosen])

    def positions(self, vertices: FloatArray, faces: IntArray) -> FloatArray:
        """(P, 3) positions on a mesh of (V, 3) vertices."""
        return (self.barycentric[:, :, None] * vertices[faces[self.triangles]]).sum(1)


class MeshPoints:
    """Values of the vertices of a mesh, interpolated at points on it.

    - ``points``, ``faces``, ``like``: the points, the (F, 3) int64 triangles of the mesh, and a tensor of the type of the
      values.
    - ``triangles``: (P,) int64 triangle of each point.
    """

    def __init__(self, points: SurfacePoints, faces: Tensor, like: Tensor):
        self.triangles = torch.from_numpy(points.triangles).to(like.device)
        # Corner by corner: adding separate corners is faster than rows of three.
        self._corners = faces[self.triangles].t().reshape(-1)
        self._weights = torch.from_numpy(points.barycentric).to(like).t()[:, :, None]

    def __call__(self, values: Tensor) -> Tensor:
        """(P, C) of (V, C) values of the vertices."""
        corners = values.index_select(0, self._corners).view(3, -1, values.shape[1])
        return (corners * self._weights).sum(0)


def poisson_disk(
    vertices: FloatArray, faces: IntArray, triangles: IntArray, count: int, seed: int
) -> SurfacePoints:
    """About ``count`` points on some triangles of a mesh, no two of them close: blue noise.

    Dart throwing over random candidates: a candidate is rejected if an accepted one is nearer than the radius (Cook,
    "Stochastic Sampling in Computer Graphics", TOG 1986, section 4). The number found is within a few per cent of
    ``count``. Equal arguments give equal points, unlike MeshLab's sampling, which uses a generator shared by the
    process.

    - ``vertices``, ``faces``: (V, 3) metres, (F, 3).
    - ``triangles``: indices of the faces to sample.
    """
    corners = np.asarray(vertices, np.float64)[faces[triangles]]
    areas = triangle_areas(vertices, faces[triangles])
    random = numpy_generator(seed, "surface", count)
    chosen = random.choice(len(areas), size=CANDIDATES * count, p=areas / areas.sum())
    root, along = np.sqrt(random.random(len(chosen))), random.random(len(chosen))
    barycentric = full_barycentric(np.column_stack([root * (1 - along), root * along]).astype(np.float32))
    points = (barycentric[:, :, None] * corners[chosen]).sum(1)

    radius, tree = RADIUS * float(np.sqrt(areas.sum() / count)), cKDTree(points)
    left, rows = np.ones(len(points), bool), []
    for row in range(len(points)):
        if left[row]:
            rows.append(row)
            left[tree.query_ball_point(points[row], radius)] = False
    return SurfacePoints(np.asarray(triangles, np.int64)[chosen[rows]], barycentric[rows])


def spread_points(
    head: HeadAsset,
    vertices: FloatArray,
    count: int,
    seed: int,
    *,
    chart: bool = True,
    chart_without: IntArray | None = None,
) -> SurfacePoints:
    """About ``count`` points on a head: one for each texel of its chart, or blue noise if it has none.

    - ``vertices``: (V, 3) metres.
    - ``chart``: whether to use the head's chart, if it has one.
    - ``chart_without``: vertices whose triangles get no texel of the chart.
    """
    faces, uv = np.asarray(head.faces), getattr(head, "uv", None)
    if uv is None or not chart:
        return poisson_disk(vertices, faces, np.arange(len(faces)), count, seed)
    left = ~np.isin(faces, [] if chart_without is None else chart_without).any(1)
    return texel_points(np.asarray(uv, np.float64), np.flatnonzero(left), count)


def chart_resolution(uv: FloatArray, count: int) -> int:
    """Side R of a chart with about ``count`` texels in triangles with (F, 3, 2) texture coordinates; 0 if R is too large."""
    a, b, c = np.moveaxis(uv, 1, 0)
    area = 0.5 * float(np.abs(_cross(b - a, c - a)).sum())
    return round(np.sqrt(count / area)) if area * _MOST_ACROSS**2 > count else 0


def texel_points(uv: FloatArray, triangles: IntArray, count: int) -> SurfacePoints:
    """The centres of the texels of a chart, by triangle: R x R texels, with R chosen to give about ``count``.

    A triangle without area in the chart has no texel. Triangles that overlap in the chart have separate texels.

    - ``uv``: (F, 3, 2) texture coordinates of the corners.
    - ``triangles``: indices of the triangles with texels.
    """
    a, b, c = np.moveaxis(uv[triangles], 1, 0)
    doubled = _cross(b - a, c - a)
    area, resolution = 0.5 * float(np.abs(doubled).sum()), chart_resolution(uv[triangles], count)
    expected = f"triangles that cover a part of the square, for {count} texels"
    found = f"an area of {area:.3g} in {len(triangles)} triangles"
    refused = InputError("head model", "uv", expected, found)
    # Texels whose centres lie in the box around a triangle. The offset puts a centre on an edge into one triangle.
    first = np.ceil(uv[triangles].min(1) * resolution - 0.5 - _OFFSET).astype(np.int64)
    last = np.floor(uv[triangles].max(1) * resolution - 0.5 - _OFFSET).astype(np.int64)
    sides = np.where((doubled != 0)[:, None], np.maximum(last - first + 1, 0), 0)
    candidates = sides.prod(1)
    if not resolution or not 0 < candidates.sum(dtype=float) <= _MOST_CANDIDATES * count:
        raise refused
    rows = np.repeat(np.arange(len(triangles)), candidates)
    within = np.arange(len(rows)) - np.repeat(np.cumsum(candidates) - candidates, candidates)
    texels = first[rows] + np.column_stack([within % sides[rows, 0], within // sides[rows, 0]])

    def coordinates(points: FloatArray) -> FloatArray:
        """(n, 2) last two barycentric coordinates."""
        away = points - a[rows]
        to_b, to_c = (b - a)[rows], (c - a)[rows]
        return np.column_stack([_cross(away, to_c), _cross(to_b, away)]) / doubled[rows, None]

    inside = coordinates((texels + 0.5 + _OFFSET) / resolution)
    kept = (inside >= 0).all(1) & (inside.sum(1) <= 1)
    if not kept.any():
        raise refused
    exact = coordinates((texels + 0.5) / resolution)[kept].clip(0, 1).astype(np.float32)
    return SurfacePoints(np.asarray(triangles, np.int64)[rows[kept]], full_barycentric(exact))


_OFFSET = np.array([1.0e-7, 1.7e-7])
"""Texels."""
_MOST_CANDIDATES = 100
_MOST_ACROSS = 2**16
"""Texels; the candidates of a triangle are then counted in an int64, at coordinates up to 10,000."""


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    """(n,) third coordinate of the cross products of (n, 2) vectors."""
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]


def point_tensors(points: SurfacePoints) -> dict[str, Tensor]:
    """Points as the tensors of `POINT_MEMBERS`."""
    return {
        "triangles": torch.from_numpy(points.triangles.astype(np.int32)),
        "barycentric": torch.from_numpy(points.barycentric[:, 1:].astype(np.float32)),
    }


def take_points(path: Path, tensors: dict[str, Tensor], face_count: int) -> SurfacePoints:
    """Remove the tensors of `POINT_MEMBERS` from others and return their points."""
    check_tensors(path, tensors, POINT_MEMBERS)
    triangles, barycentric = (tensors.pop(name) for name in POINT_MEMBERS)
    if not len(triangles) or not (0 <= int(triangles.min()) and int(triangles.max()) < face_count):
        expected = f"at least one, each from 0 to {face_count - 1}"
        raise InputError(path, "triangles", expected, f"{len(triangles)}, or others")
    return SurfacePoints(triangles.numpy().astype(np.int64), full_barycentric(barycentric.numpy()))


def full_barycentric(last_two: FloatArray) -> FloatArray:
    """(P, 3) float64 barycentric coordinates from the last two of them."""
    last_two = last_two.astype(np.float64)
    return np.column_stack([1 - last_two.sum(1), last_two])


def spacing(points: FloatArray) -> FloatArray:
    """(P,) root mean squared distance of (P, 3) points to their three nearest neighbours, metres."""
    distances = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))[0].reshape(len(points), -1)
    squares = (distances[:, 1:] ** 2).mean(1) if distances.shape[1] > 1 else np.zeros(len(points))
    return np.sqrt(np.maximum(squares, SMALLEST_SQUARE))
