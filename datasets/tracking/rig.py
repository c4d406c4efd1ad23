"""Points on a head model and their derivatives by all parameters, for Gauss-Newton steps.

A point is a fixed mixture of up to three vertices. Bases and skinning weights are mixed once, so that a few thousand points
are evaluated instead of the whole mesh. At vertices this is exact; inside a triangle it differs from mixing the posed vertices
by a part of the change of the skinning weights across the triangle.

Timesteps whose fit differs from that of their neighbours.

Cameras as arrays: projection with derivatives, and visibility by a coarse depth buffer. Blurred images of all frames,
sampled with their gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from ...bench.contracts import BoolArray, ByteArray, Camera, FloatArray, HeadAsset, HeadPose, IntArray
from ..head.arrays import JOINT_NAMES
from ..head.geometry import triangle_areas, vertex_normals
from ..head.rotations import matrices_and_derivatives, rotation_of


class FrameStack:
    """Images of N frames as one row of pixels. ``images``: (H, W, 3) 8-bit images; sizes may differ."""

    def __init__(self, images: list[ByteArray]):
        self._images = images
        self.sizes = np.array([[image.shape[1], image.shape[0]] for image in images])
        counts = self.sizes.prod(axis=1)
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        self._pixels = np.zeros((int(self._starts[-1]), 3), np.int16)

    def filter(self, sigma: float, wide: float = 0.0) -> None:
        """Blur the sampled images by ``sigma`` pixels, and subtract their blur by ``wide``; 0 for none. The difference
        contains less of slow changes such as shading, which turns with the head."""
        for start, image in zip(self._starts, self._images):
            levels: FloatArray = np.asarray(image * np.float32(_LEVELS / 255), np.float32)
            if sigma > 0:
                levels = _blurred(levels, sigma)
            if wide > 0:
                levels = levels - _blurred(levels, wide)
            flat = levels.reshape(-1, 3)
            self._pixels[start : start + len(flat)] = np.round(flat)

    def sample(self, frames: IntArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (n, 3), 1 being white, and gradients (n, 3, 2) per pixel at places (n, 2) of frames (n,), bilinear.
        Places outside an image take its border."""
        sizes = self.sizes[frames]
        place = np.clip(pixels - 0.5, 0, sizes - 1.001)
        corner = place.astype(np.int64)
        x, y = (place - corner).astype(np.float32).T[..., None]
        width = sizes[:, 0]
        index = self._starts[frames] + corner[:, 1] * width + corner[:, 0]
        a, b, c, d = (
            self._pixels[at].astype(np.float32) for at in (index, index + 1, index + width, index + width + 1)
        )
        upper, lower = a + x * (b - a), c + x * (d - c)
        value = upper + y * (lower - upper)
        along = (b - a) + y * ((d - c) - (b - a))
        scale = np.float32(1 / _LEVELS)
        return value * scale, np.stack([along, lower - upper], axis=2) * scale


_LEVELS = 16384.0  # of stored values, so that blurred images are not rounded to 8 bits


def _blurred(levels: FloatArray, sigma: float) -> FloatArray:
    import cv2  # not everywhere where methods are trained

    return np.asarray(cv2.GaussianBlur(levels, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))


CELL = 4
"""Side of a cell of the depth buffer, pixels."""
MARGIN = 0.002
"""Depth tolerance, metres, in addition to the slope within a cell: a point is hidden if another surface is nearer by more."""
FACING = 0.25
"""Minimum cosine between the normal of a point and the direction to the camera."""
_SPACING = 0.003  # between the samples of a surface that fill the buffer, metres
_NEAR = 0.05


class Projection(NamedTuple):
    """Points in the images of C cameras."""

    pixels: FloatArray
    """(C, P, 2) in pixels, (0, 0) being the corner of the image."""
    depth: FloatArray
    """(C, P) metres."""
    derivative: FloatArray
    """(C, P, 2, 3) of the pixels by the points in the world."""


class Views:
    """C cameras. ``cameras``: Cameras of any sizes."""

    def __init__(self, cameras: Sequence[Camera]):
        self.cameras = [*cameras]
        self.rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras]).astype(np.float64)
        self.shifts = np.stack([camera.world_to_camera[:3, 3] for camera in cameras]).astype(np.float64)
        self.intrinsics = np.stack([camera.K for camera in cameras]).astype(np.float64)
        self.centers = np.stack([camera.center for camera in cameras])
        self.sizes = np.array([[camera.width, camera.height] for camera in cameras])

    def place(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (C, P, 2) and depth (C, P) of points (P, 3), in float32."""
        matrices = self.intrinsics @ np.concatenate([self.rotations, self.shifts[..., None]], axis=2)
        homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1).astype(np.float32)
        projected = homogeneous @ matrices.astype(np.float32).reshape(-1, 4).T  # (P, 3 C)
        projected = projected.reshape(len(points), -1, 3).transpose(1, 0, 2)
        depth = projected[..., 2]
        return projected[..., :2] / np.maximum(depth, _NEAR)[..., None], depth

    def project(self, points: FloatArray, which: IntArray | None = None) -> Projection:
        """Project points (P, 3), or with ``which`` (P,) each in the camera of that index, then without the axis C."""
        if which is None:
            turn, shift, K = self.rotations[:, None], self.shifts[:, None], self.intrinsics[:, None]
            seen = points @ self.rotations.transpose(0, 2, 1) + shift
        else:
            turn, shift, K = self.rotations[which], self.shifts[which], self.intrinsics[which]
            seen = np.einsum("pij,pj->pi", turn, points) + shift
        depth = np.maximum(seen[..., 2], _NEAR)
        slopes = seen[..., :2] / depth[..., None]
        # The last row of the intrinsics is (0, 0, 1); the first two multiply the slopes.
        linear = K[..., :2, :2]
        pixels = slopes[..., :1] * linear[..., 0] + slopes[..., 1:] * linear[..., 1] + K[..., :2, 2]
        by_point = turn[..., :2, :] - slopes[..., None] * turn[..., 2:, :]
        scaled = linear / depth[..., None, None]
        derivative = scaled[..., :1] * by_point[..., :1, :] + scaled[..., 1:] * by_point[..., 1:, :]
        return Projection(pixels, seen[..., 2], derivative)


class Occlusion:
    """Visibility of mesh points in cameras.

    The surface is sampled every few millimetres and the nearest depth in every cell of `CELL` pixels is kept. This is
    a hundred times faster than drawing the mesh and as exact as robust estimates need.

    ``head``: Head model, for its triangles. ``neutral``: (V, 3) a mesh of the subject's size, metres. ``views``: Cameras.
    """

    def __init__(self, head: HeadAsset, neutral: FloatArray, views: Views):
        self._faces, self._views = np.asarray(head.faces), views
        corners = self._faces
        # A triangle of area a holds 2 a / spacing^2 samples, at the centres of a grid of barycentric coordinates.
        number = np.ceil(np.sqrt(2 * triangle_areas(neutral, corners)) / _SPACING).clip(1, 8).astype(int)
        self._samples: list[tuple[IntArray, FloatArray]] = []
        for steps in np.unique(number):
            first, second = (axis.ravel() for axis in np.mgrid[:steps, :steps])
            kept = first + second < steps
            grid = (np.stack([first[kept], second[kept]], axis=1) + 1 / 3) / steps
            shares = np.concatenate([1 - grid.sum(axis=1, keepdims=True), grid], axis=1)
            self._samples.append((corners[number == steps], shares))

    def surface(self, mesh: FloatArray) -> MeshInViews:
        """A posed mesh (V, 3), metres, in the cameras."""
        points = [mesh] + [
            np.einsum("sk,fki->fsi", shares, mesh[faces]).reshape(-1, 3) for faces, shares in self._samples
        ]
        return MeshInViews(mesh, vertex_normals(mesh, self._faces), self._views, np.concatenate(points))

    def visible(self, mesh: FloatArray, vertices: IntArray) -> FloatArray:
        """`MeshInViews.visible` of a posed mesh (V, 3), metres."""
        return self.surface(mesh).visible(vertices)


class MeshInViews:
    """A posed mesh in the images of C cameras, with the nearest depth in every cell. ``mesh``: (V, 3) metres. ``normals``: (V, 3)
    of its vertices. ``points``: Dense points of its surface."""

    def __init__(self, mesh: FloatArray, normals: FloatArray, views: Views, points: FloatArray):
        self.mesh, self.normals, self._views = mesh, normals, views
        self._rows, self._columns = views.sizes.max(axis=0)[::-1] // CELL + 1
        pixels, depth = views.place(points)
        cells, inside = self._cells(pixels)
        self._nearest = np.full((len(cells), self._rows * self._columns), np.inf, np.float32)
        for camera, (row, kept) in enumerate(zip(cells, inside)):
            np.minimum.at(self._nearest[camera], row[kept], depth[camera, kept])

    def cosines(self, vertices: IntArray) -> FloatArray:
        """(C, n) cosine between normal and direction to the camera at vertices (n,)."""
        toward = self._views.centers[:, None] - self.mesh[vertices]
        cosine = np.einsum("cni,ni->cn", toward, self.normals[vertices])
        return np.asarray(cosine / np.linalg.norm(toward, axis=2))

    def visible(self, vertices: IntArray) -> FloatArray:
        """`cosines` at vertices (n,) that are seen, else 0."""
        cosine = self.cosines(vertices)
        pixels, depth = self._views.place(self.mesh[vertices])
        cells, inside = self._cells(pixels)
        rows = np.arange(len(cosine))[:, None]
        slope = np.sqrt(1 - np.minimum(cosine**2, 1)) / np.maximum(cosine, FACING)
        margin = MARGIN + slope * CELL * depth / self._views.intrinsics[:, None, 0, 0]
        seen = inside & (depth < self._nearest[rows, cells] + margin) & (cosine > FACING)
        return np.where(seen, cosine, 0.0)

    def at_border(self, points: FloatArray) -> BoolArray:
        """(C, n) whether points (n, 3) are in the image and within a cell of the border of the mesh's projection."""
        covered = np.isfinite(self._nearest).reshape(-1, self._rows, self._columns)
        closed = ndimage.binary_closing(covered, np.ones((1, 3, 3)), border_value=0)
        inner = ndimage.binary_erosion(closed, np.ones((1, 3, 3)), border_value=1).reshape(len(covered), -1)
        cells, inside = self._cells(self._views.place(points)[0])
        return inside & ~inner[np.arange(len(inner))[:, None], cells]

    def _cells(self, pixels: FloatArray) -> tuple[IntArray, BoolArray]:
        """Cell of each point, (C, P), and whether it is in the image."""
        sizes = self._views.sizes[:, None]
        inside = (
            (pixels[..., 0] >= 0)
            & (pixels[..., 1] >= 0)
            & (pixels[..., 0] < sizes[..., 0])
            & (pixels[..., 1] < sizes[..., 1])
        )
        at = (pixels * np.float32(1 / CELL)).astype(np.int32)
        x, y = np.clip(at[..., 0], 0, self._columns - 1), np.clip(at[..., 1], 0, self._rows - 1)
        return y * self._columns + x, inside


JOINTS = len(JOINT_NAMES)
ANGLES = 3 * JOINTS


class PoseColumns(NamedTuple):
    """Order of the numbers of a timestep: angles of all joints, translation, expression, eyelids."""

    expression_size: int
    eyelid_size: int

    @classmethod
    def of(cls, head: HeadAsset) -> PoseColumns:
        """The columns of a head model."""
        lids = 0 if head.eyelid_basis is None else head.eyelid_basis.shape[2]
        return cls(head.expression_basis.shape[2], lids)

    @property
    def size(self) -> int:
        """D, the number of columns."""
        return ANGLES + 3 + self.expression_size + self.eyelid_size

    @property
    def translation(self) -> slice:
        """Columns of the translation, metres."""
        return slice(ANGLES, ANGLES + 3)

    def rows(self, poses: Sequence[HeadPose]) -> FloatArray:
        """Poses as rows (T, D)."""
        names = ("rotation", "neck", "jaw", "eyes", "translation", "expression", "eyelids")
        used = names if self.eyelid_size else names[:-1]
        return np.stack([np.concatenate([getattr(pose, name) for name in used]) for pose in poses])

    def poses(
        self, values: FloatArray, head: HeadAsset, subject: str, timesteps: Sequence[int]
    ) -> list[HeadPose]:
        """Rows (T, D) as poses, rounded to float32 as they are stored."""
        result = []
        for timestep, row in zip(timesteps, np.asarray(values, np.float32).astype(np.float64), strict=True):
            angles = row[:ANGLES].reshape(JOINTS, 3)
            lids = row[self.size - self.eyelid_size :]
            fields: dict[str, Any] = {
                "rotation": angles[0],
                "neck": angles[1],
                "jaw": angles[2],
                "eyes": angles[3:].ravel(),
            }
            fields |= {"translation": row[self.translation], "eyelids": lids if self.eyelid_size else None}
            expression = row[ANGLES + 3 : ANGLES + 3 + self.expression_size]
            result.append(HeadPose(head.version, expression, **fields, subject=subject, timestep=timestep))
        return result


class PosedPoints(NamedTuple):
    """Points of one timestep and their derivatives."""

    points: FloatArray
    """(P, 3) in the world, metres."""
    by_pose: FloatArray
    """(P, 3, D) derivatives by the columns of `PoseColumns`."""
    by_shape: FloatArray
    """(P, 3, S) derivatives by the identity coefficients."""


@dataclass(frozen=True, eq=False)
class _Joints:
    """Motions ``R x + o`` of all joints and their derivatives."""

    turns: FloatArray  # (J, 3, 3)
    shifts: FloatArray  # (J, 3)
    turns_by_angle: FloatArray  # (3 J, J, 3, 3)
    shifts_by_angle: FloatArray  # (3 J, J, 3)
    shifts_by_coefficient: FloatArray  # (J, 3, E + S)


class _Posed(NamedTuple):
    points: FloatArray
    unposed: FloatArray  # (P, 3)
    turns: FloatArray  # (P, 3, 3) mixed rotations
    joints: _Joints
    derivatives: FloatArray  # (J, 3, 3, 3) of the local rotations


class PointRig:
    """P points on a head model. ``head``: Head model in FLAME's layout. ``corners``: (P, 3) vertices of each point.
    ``weights``: (P, 3) their shares, rows sum to 1."""

    def __init__(self, head: HeadAsset, corners: IntArray, weights: FloatArray):
        def mixed(values: Any) -> FloatArray:
            array = np.asarray(values, np.float64)
            return np.einsum("pk,pk...->p...", weights, array[corners])

        self.columns = PoseColumns.of(head)
        self._parents = [int(parent) for parent in head.parents]
        self._template = mixed(head.template)
        # Expression, then shape: both move the unposed points and the joints linearly.
        basis = np.concatenate([mixed(head.expression_basis), mixed(head.shape_basis)], axis=2)
        self._basis = basis.astype(np.float32)
        self._correctives = mixed(head.pose_basis).astype(np.float32)
        self._skin = mixed(head.skinning_weights).astype(np.float32)
        self._lids = None if head.eyelid_basis is None else mixed(head.eyelid_basis).astype(np.float32)
        regressor = np.asarray(head.joint_regressor, np.float64)
        self._rest = regressor @ head.template
        bases = np.concatenate([head.expression_basis, head.shape_basis], axis=2)
        self._joint_basis = np.tensordot(regressor, np.asarray(bases, np.float64), 1)

    @classmethod
    def at_vertices(cls, head: HeadAsset, vertices: IntArray) -> PointRig:
        """The points are vertices."""
        weights = np.tile([1.0, 0.0, 0.0], (len(vertices), 1))
        return cls(head, np.repeat(vertices[:, None], 3, axis=1), weights)

    def mixed(self, corners: IntArray, weights: FloatArray) -> PointRig:
        """A rig of n mixtures of k of the points. ``corners``: (n, k). ``weights``: (n, k), rows sum to 1."""
        rig = copy(self)
        for name in ("_template", "_basis", "_correctives", "_skin", "_lids"):
            values = getattr(self, name)
            if values is not None:
                mixture = np.einsum("nk,nk...->n...", weights.astype(values.dtype), values[corners])
                setattr(rig, name, mixture)
        return rig

    def points(self, shape: FloatArray, pose: FloatArray) -> FloatArray:
        """(P, 3) points in the world, metres, of shape (S,) and pose (D,)."""
        return self._posed(shape, pose).points

    def linearised(self, shape: FloatArray, pose: FloatArray) -> PosedPoints:
        """Points and their derivatives for shape (S,) and pose (D,)."""
        columns, expressions = self.columns, self.columns.expression_size
        points, unposed, turns, joints, derivatives = self._posed(shape, pose)
        count = len(points)

        linear = turns @ self._basis
        by_coefficient = joints.shifts_by_coefficient.reshape(JOINTS, -1).astype(np.float32)
        linear += (self._skin @ by_coefficient).reshape(linear.shape)
        by_pose = np.zeros((count, 3, columns.size), np.float32)
        by_pose[:, 0, ANGLES] = by_pose[:, 1, ANGLES + 1] = by_pose[:, 2, ANGLES + 2] = 1
        by_pose[:, :, ANGLES + 3 : ANGLES + 3 + expressions] = linear[:, :, :expressions]
        # Skinning: sum_j w_j (dR_j x + do_j), with x extended by 1 so that both are one product.
        extended = np.concatenate([unposed, np.ones((count, 1), np.float32)], axis=1)
        weighted = (self._skin[:, :, None] * extended[:, None]).reshape(count, -1)  # (P, 4 J)
        motion = np.concatenate(
            [joints.turns_by_angle, joints.shifts_by_angle[..., None]], axis=3
        )  # (3 J, J, 3, 4)
        motion = motion.transpose(1, 3, 2, 0).reshape(4 * JOINTS, -1).astype(np.float32)
        by_pose[:, :, :ANGLES] = (weighted @ motion).reshape(count, 3, ANGLES)
        entries = derivatives[1:].reshape(JOINTS - 1, 9, 3).astype(np.float32)
        for joint in range(1, JOINTS):
            bent = self._correctives[:, :, 9 * joint - 9 : 9 * joint] @ entries[joint - 1]
            by_pose[:, :, 3 * joint : 3 * joint + 3] += turns @ bent
        if self._lids is not None:
            closed = self._lids @ pose[columns.size - columns.eyelid_size :].astype(np.float32)
            by_pose[:, :, columns.size - columns.eyelid_size :] = (
                joints.turns[1].astype(np.float32) @ self._lids
            )
            turned = joints.turns_by_angle[:6, 1].astype(np.float32)  # by root and neck
            by_pose[:, :, :6] += np.einsum("kij,pj->pik", turned, closed)
        return PosedPoints(points, by_pose, linear[:, :, expressions:])

    def _posed(self, shape: FloatArray, pose: FloatArray) -> _Posed:
        start = ANGLES + 3
        coefficients = np.concatenate([pose[start : start + self.columns.expression_size], shape])
        joints, rotations, derivatives = self._motions(coefficients, pose)
        feature = (rotations[1:] - np.eye(3)).ravel().astype(np.float32)
        blend = self._basis @ coefficients.astype(np.float32) + self._correctives @ feature
        unposed = self._template.astype(np.float32) + blend
        turns = (self._skin @ joints.turns.reshape(JOINTS, 9).astype(np.float32)).reshape(-1, 3, 3)
        shifts = self._skin @ joints.shifts.astype(np.float32) + pose[self.columns.translation].astype(
            np.float32
        )
        points = (turns @ unposed[..., None])[..., 0] + shifts
        if self._lids is not None:
            closed = self._lids @ pose[self.columns.size - self.columns.eyelid_size :].astype(np.float32)
            points = points + closed @ joints.turns[1].T.astype(np.float32)
        return _Posed(points, unposed, turns, joints, derivatives)

    def _motions(self, coefficients: FloatArray, pose: FloatArray) -> tuple[_Joints, FloatArray, FloatArray]:
        """Motions of the joints, their local rotations (J, 3, 3) and the derivatives of these (J, 3, 3, 3)."""
        rotations, derivatives = matrices_and_derivatives(
            np.asarray(pose[:ANGLES], np.float64).reshape(JOINTS, 3)
        )
        rest = self._rest + self._joint_basis @ coefficients
        turns, shifts = np.zeros((JOINTS, 3, 3)), np.zeros((JOINTS, 3))
        turns_by, shifts_by = np.zeros((ANGLES, JOINTS, 3, 3)), np.zeros((ANGLES, JOINTS, 3))
        by_coefficient = np.zeros(self._joint_basis.shape)
        for joint, parent in enumerate(self._parents):
            above, shift = (np.eye(3), np.zeros(3)) if parent < 0 else (turns[parent], shifts[parent])
            turns[joint] = above @ rotations[joint]
            columns = slice(3 * joint, 3 * joint + 3)
            turns_by[columns, joint] = above @ derivatives[joint].transpose(2, 0, 1)
            bend_by = -turns_by[:, joint]
            by_coefficient[joint] = (above - turns[joint]) @ self._joint_basis[joint]
            if parent >= 0:
                turns_by[:, joint] += turns_by[:, parent] @ rotations[joint]
                bend_by = turns_by[:, parent] - turns_by[:, joint]
                shifts_by[:, joint] = shifts_by[:, parent]
                by_coefficient[joint] += by_coefficient[parent]
            shifts[joint] = shift + (above - turns[joint]) @ rest[joint]
            shifts_by[:, joint] += bend_by @ rest[joint]
        return _Joints(turns, shifts, turns_by, shifts_by, by_coefficient), rotations, derivatives


WINDOW = 9
"""Timesteps with whose median one in their middle is compared."""
TURN, MOVE = 0.25, 0.08
"""Minimum rotation of the head, radians, and translation, metres, from the median that count as a jump."""
USUAL = 6.0
"""Minimum ratio of a jump to the median difference, for captures with few timesteps or fast motion."""
WORSE = 2.5
"""Minimum ratio of a residual to its median that counts as a fit that failed."""


def outliers(
    poses: FloatArray, residuals: FloatArray, columns: PoseColumns, *, jumps: bool = True
) -> BoolArray:
    """(T,) timesteps without a fit to landmarks, with a much larger residual than their neighbours, or with a jump of the head.

    ``poses``: (T, D) columns of ``columns``. ``residuals``: (T, 2) `TimestepResidual` without the timestep; 0 pixels where
    no landmark was used. ``jumps``: Whether jumps are faults. Several cameras determine a pose without its neighbours, and timesteps
    of a capture may be far apart.
    """
    wrong = (residuals[:, 0] <= 0) | (residuals > WORSE * _median(residuals)).any(axis=1)
    if not jumps:
        return np.asarray(wrong)
    turns = (rotation_of(poses[:, :3]) * rotation_of(poses[:, 3:6])).as_matrix().reshape(-1, 9)
    # The Frobenius norm of the difference of two rotations is about their angle times the root of 2.
    for values, least in ((turns / np.sqrt(2), TURN), (poses[:, columns.translation], MOVE)):
        distances = np.linalg.norm(values - _median(values), axis=1)
        wrong |= distances > max(least, USUAL * float(np.median(distances)))
    return np.asarray(wrong)


def _median(values: FloatArray) -> FloatArray:
    return np.asarray(ndimage.median_filter(values, (WINDOW, 1), mode="nearest"))
