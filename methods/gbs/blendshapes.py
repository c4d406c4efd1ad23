"""Neutral splats plus differences, weighted by expression coefficients and moved by a pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from ...bench.contracts import FloatArray, HeadAsset, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...datasets.head.arrays import HeadArrays
from ...datasets.head.geometry import rigid_alignment
from ...datasets.head.model import joint_motions, pose_feature
from ...datasets.head.rotations import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_matrix
from ..ops.planes import coefficient_count, harmonic_colors
from ..ops.splats import TriangleFrames, WorldSplats, points_on, to_world
from ..shared.surface_points import (
    POINT_MEMBERS,
    MeshPoints,
    SubjectMesh,
    SurfacePoints,
    point_tensors,
    take_points,
)
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, write_tensors

LARGEST_SCALE = 0.1
"""Maximum size of a splat, metres: training removes larger neutral splats, and expressions are clamped to it."""
SMALLEST_SCALE = 1e-7


def difference_widths(degree: int) -> dict[str, int]:
    """Columns of the differences by attribute; harmonics above degree 0 up to ``degree``."""
    rest = 3 * (coefficient_count(degree) - 1)
    return {"means": 3, "log_scales": 3, "quats": 4, "opacities": 1, "sh_dc": 3, "sh_rest": rest}


class Entries(NamedTuple):
    """Splat and expression of each row of the differences."""

    starts: Tensor
    """(N + 1,) int64, the first row of each splat, and the number of rows."""
    owners: Tensor
    """(M,) int64, splat of each row, ascending."""
    expressions: Tensor

    weights: Tensor
    """(M,) weights of the rows; 1 if a row holds the difference at coefficient 1."""
    rows: Tensor
    """(M,) int64, 0 to M - 1."""

    @classmethod
    def of(cls, counts: Tensor, expressions: Tensor, weights: Tensor) -> Entries:
        """Construct from the (N,) row counts of the splats."""
        starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        owners = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        return cls(starts, owners, expressions, weights, torch.arange(len(owners), device=counts.device))

    def shares(self, coefficients: Tensor) -> Tensor:
        """(M,) weights of the rows in a pose of (K,) coefficients."""
        return self.weights * coefficients.index_select(0, self.expressions)

    def sum(self, differences: Tensor, coefficients: Tensor) -> Tensor:
        """(N, C) differences of each splat, blended by the (K,) coefficients of a pose."""
        return self.blended(differences, self.shares(coefficients))

    def blended(self, differences: Tensor, shares: Tensor) -> Tensor:
        """(N, C) differences of each splat, blended by the `shares` of a pose."""
        return _SumEntries.apply(differences, shares, self)  # type: ignore[no-untyped-call]


class _SumEntries(torch.autograd.Function):
    """Segment sums of weighted table rows. The backward pass is a single gather, whereas torch's own is a scatter."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, shares: Tensor, entries: Entries) -> Tensor:
        ctx.save_for_backward(shares, entries.owners)
        return embedding_bag(
            entries.rows,
            table,
            entries.starts,
            per_sample_weights=shares,
            mode="sum",
            include_last_offset=True,
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        shares, owners = ctx.saved_tensors
        return grads[0].index_select(0, owners).mul_(shares[:, None]), None, None


class PosedAttributes(NamedTuple):
    """Splats of a pose in the world: geometry, (N,) opacities, harmonics, and the (N, 9) rotation from the world to their axes."""

    world: WorldSplats
    opacities: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    inverse: Tensor

    def colors(self, center: Tensor, degree: int) -> Tensor:
        """(N, 3) as seen from a camera at ``center`` (3,); the harmonics turn with the surface."""
        vectors = self.world.means - center
        along = points_on(vectors, _each(vectors), self.inverse, torch.zeros_like(vectors))
        return harmonic_colors(self.sh_dc, self.sh_rest, along, degree)


def _each(rows: Tensor) -> Tensor:
    """(N,) int64 that bind each of N splats to a row of its own."""
    return torch.arange(len(rows), device=rows.device)


def apply_pose(neutral: Mapping[str, Tensor], differences: Tensor, motions: PointMotions) -> PosedAttributes:
    """Splats of a pose.

    Each attribute is the neutral one plus its differences, initial and learnt (section 3.2 of the paper); positions
    and rotations then follow the joints (section 3.4).

    - ``neutral``: means (N, 3) metres, log_scales (N, 3), quats (N, 4), opacities (N,) logits, sh_dc (N, 3) and sh_rest (N, 3,
      R).
    - ``differences``: (N, C), learnt and blended, in the columns of `difference_widths`.
    """
    rest = neutral["sh_rest"]
    by_rest = differences.shape[1] - sum(difference_widths(0).values())
    moved, scaled, turned, opaque, coloured, rest_change = differences.split([3, 3, 4, 1, 3, by_rest], dim=1)
    local = neutral["means"] + motions.shift + moved
    joints = TriangleFrames(
        motions.linear.view(-1, 3, 3), motions.offset, torch.ones_like(local[:, 0]), motions.quaternion
    )
    turns, log_scales = neutral["quats"] + motions.turn + turned, neutral["log_scales"] + scaled
    world = to_world(joints, _each(local), local, log_scales, turns)
    if by_rest:
        changed = by_rest // 3
        sums = rest[:, :, :changed] + rest_change.view(-1, 3, changed)
        rest = torch.cat([sums, rest[:, :, changed:]], dim=2)
    return PosedAttributes(
        world._replace(scales=world.scales.clamp(SMALLEST_SCALE, LARGEST_SCALE)),
        torch.sigmoid(neutral["opacities"] + opaque[:, 0]),
        neutral["sh_dc"] + coloured,
        rest,
        motions.inverse,
    )


PARTS = {"linear": 9, "offset": 3, "inverse": 9, "quaternion": 4, "turn": 4, "shift": 3}
"""Columns of the effect of a pose on each point."""


class PointMotions(NamedTuple):
    """Effect of a pose on splats."""

    linear: Tensor
    offset: Tensor
    """(N, 9) and (N, 3), blended transforms of the joints with eyelids and translation; x -> A x + b."""
    inverse: Tensor
    """(N, 9), the inverse of the rotation in ``linear``."""
    quaternion: Tensor
    """(N, 4), the rotation in ``linear``."""
    turn: Tensor
    """(N, 4) blended initial differences of rotation, multiplied by the initial quaternion."""
    shift: Tensor
    """(N, 3) initial differences of position, blended, and pose correctives; before the transform, metres."""

    @classmethod
    def of(cls, rows: Tensor) -> PointMotions:
        """Split into the columns of `PARTS`."""
        return cls(*(part.contiguous() for part in rows.split(list(PARTS.values()), dim=1)))


class Rig:
    """Points on the surface of a subject, moved as FLAME moves it, without expressions beyond the first K.

    - ``head``, ``shape``, ``static_offset``: as for `SubjectMesh`.
    - ``points``: points on its neutral mesh.
    - ``expressions``: K, number of leading expressions that splats follow; the joints follow all.
    - ``at_points``: interpolates values of the vertices at the points.
    - ``turns``, ``turned``: (4 F, K) `initial_rotations` of the triangles with points, and (P,) int64 index of each point's
      triangle in them.
    """

    def __init__(
        self,
        head: HeadAsset,
        shape: FloatArray,
        static_offset: FloatArray,
        points: SurfacePoints,
        expressions: int,
        device: str,
    ):
        self.mesh = SubjectMesh(head, shape, static_offset, device)
        model = self.mesh.model
        self.expressions = min(expressions, model.expression_size)
        self.at_points = MeshPoints(points, self.mesh.faces, model.template)
        # Most points follow one joint, or have the weights of another point: transforms are computed once for each.
        self._weights, self._weighted = torch.unique(
            self.at_points(model.skinning_weights), dim=0, return_inverse=True
        )
        self.rest = self.at_points(self.mesh.canonical)
        self._basis = torch.cat([model.expression_matrix[: self.expressions], model.pose_matrix])
        basis = model.expression_matrix[: self.expressions].t().unflatten(0, (-1, 3))
        triangles = self.at_points.triangles
        used = torch.unique(triangles)
        turns = initial_rotations(self.mesh.canonical, basis, self.mesh.faces[used])
        self.turned = torch.searchsorted(used, triangles)
        self.turns = turns.flatten(0, 1)

    def arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Driving signal as tensors."""
        return self.mesh.arguments(poses)

    def coefficients(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(K,) expression coefficients that drive differences."""
        return arguments["expression"][0, : self.expressions]

    @torch.no_grad()
    def motions(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """Effect of one pose on each point, (P, 32) in the columns of `PARTS`."""
        model, expression = self.mesh.model, arguments["expression"]
        coefficients = self.coefficients(arguments)
        angles = model.angles(*(arguments[name] for name in ("rotation", "neck", "jaw", "eyes")))
        rotations = axis_angle_to_matrix(angles)
        joints = model.rest_joints(self.mesh.canonical[None], expression)
        motions = joint_motions(rotations, joints, model.parents)[0]
        blended = (self._weights @ motions.flatten(1)).view(-1, 3, 4)
        linear = blended[:, :, :3].contiguous()
        # Through the quaternion it is a rotation to rounding, however far the blended transforms are from one.
        quaternion = matrix_to_quaternion(nearest_rotation(linear, SKINNING_STEPS))
        inverse = quaternion_to_matrix(quaternion).mT.flatten(1)
        offset = blended[:, :, 3] + arguments["translation"]
        followed = torch.cat([linear.flatten(1), offset, inverse, quaternion], dim=1)[self._weighted]
        feature = pose_feature(rotations)[0]
        shift = self.at_points((torch.cat([coefficients, feature]) @ self._basis).view(-1, 3))
        if "eyelids" in arguments and model.eyelid_matrix is not None:
            lids = (arguments["eyelids"][0] @ model.eyelid_matrix).view(-1, 3)
            followed[:, 9:12] += self.at_points(lids) @ (rotations[0, 0] @ rotations[0, 1]).t()
        turn = (self.turns @ coefficients).view(-1, 4)[self.turned]
        return torch.cat([followed, turn, shift], dim=1)


POLAR_STEPS = 8
"""Steps of `nearest_rotation` for gradients of deformation; an error of 1 becomes 1e-12 in six."""
SKINNING_STEPS = 3
"""Steps for blended joint transforms, which are nearly rotations; as published."""
SMALLEST = 1e-12


def deformation_gradients(rest: Tensor, moved: Tensor) -> Tensor:
    """(..., 3, 3) linear maps from each triangle, with its normal, to its moved position.

    A fourth vertex off the triangle at n / sqrt(|n|), n being the cross product of its edges, makes the map unique
    (Sumner and Popovic, eq. 1 to 3). It takes a point x of the rest triangle's plane to ``Q (x - v0) + v0'``. A
    triangle without area has no such map and gets the identity.

    - ``rest``: (F, 3, 3) corners, metres.
    - ``moved``: (..., F, 3, 3) corners.
    """
    inverse, singular = torch.linalg.inv_ex(_edges(rest))
    maps = _edges(moved) @ inverse
    return torch.where(singular[:, None, None] == 0, maps, torch.eye(3, dtype=maps.dtype, device=maps.device))


def _edges(corners: Tensor) -> Tensor:
    """(..., 3, 3) matrices whose columns are two edges and the direction of the fourth vertex."""
    one, other = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = torch.linalg.cross(one, other)
    length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True).clamp_min(SMALLEST)
    return torch.stack([one, other, normal / length.sqrt()], dim=-1)


def nearest_rotation(matrices: Tensor, steps: int) -> Tensor:
    """Rotation part of (..., 3, 3) matrices of positive determinant: the orthogonal factor of the polar decomposition.

    Newton's iteration R <- (R + R^-T) / 2 (Higham, "Computing the polar decomposition - with applications", SIAM J.
    Sci. Stat. Comput. 1986). Matrices that are singular in working precision stay finite and are not rotations.
    """
    for _ in range(steps):
        a, b, c = matrices.unbind(-2)
        cofactors = torch.stack([torch.linalg.cross(*pair) for pair in ((b, c), (c, a), (a, b))], -2)
        determinant = (a * cofactors[..., 0, :]).sum(-1)[..., None, None]
        safe = torch.where(determinant.abs() < 1e-6, torch.full_like(determinant, 1e-6), determinant)
        matrices = 0.5 * (matrices + cofactors / safe)
    return matrices


def initial_rotations(vertices: Tensor, basis: Tensor, faces: Tensor) -> Tensor:
    """(F, 4, K) quaternions of the rotation of each triangle by each expression at coefficient 1, minus the identity.

    Multiplied by the initial quaternion of a splat they are the published initial differences of rotation; differences
    are summed over expressions, and the sum is normalised.

    - ``vertices``: (V, 3) neutral mesh, metres.
    - ``basis``: (V, 3, K) metres per unit coefficient.
    - ``faces``: (F, 3) int64.
    """
    rest = vertices.to(torch.float64)[faces]
    turns = torch.zeros(len(faces), 4, basis.shape[2], dtype=torch.float64, device=vertices.device)
    for k in range(basis.shape[2]):
        moved = rest + basis[:, :, k].to(torch.float64)[faces]
        rotations = nearest_rotation(deformation_gradients(rest, moved), POLAR_STEPS)
        turns[:, :, k] = matrix_to_quaternion(rotations)
    turns[:, 0] -= 1
    return turns.to(vertices.dtype)


def consistency_mask(
    head: HeadArrays, vertices: FloatArray, expressions: int, floor: float, full: float
) -> FloatArray:
    """(F, K) non-negative weights of the changes of a triangle's splats by an expression.

    max(0, (D - floor) / (full - floor)), not bounded above, where D is the displacement of the triangle's centroid by
    an expression at coefficient 1. Rigid motion in an expression is removed first by aligning the back of the head,
    and the neck never moves.

    - ``vertices``: (V, 3) neutral mesh.
    - ``expressions``: K, number of leading expressions.
    - ``floor``, ``full``: displacements where the mask starts and where it is 1, metres.
    """
    # Teeth have no expressions; the alignment of the scalp would give them some.
    still, neck, teeth = (
        head.regions.get(name, np.empty(0, np.int64)) for name in ("scalp", "neck", "teeth")
    )
    vertices = np.asarray(vertices, np.float64)
    mask = np.empty((len(head.faces), expressions))
    for k in range(expressions):
        moved = vertices + head.expression_basis[:, :, k]
        if len(still) >= 3:
            motion = rigid_alignment(moved[still], vertices[still])
            moved = moved @ motion[:3, :3].T + motion[:3, 3]
        displacement = moved - vertices
        displacement[np.concatenate([neck, teeth])] = 0
        distance = np.linalg.norm(displacement[head.faces].mean(1), axis=1)
        mask[:, k] = np.maximum(0.0, (distance - floor) / (full - floor))
    return mask


def entries_of(mask: FloatArray, triangles: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Non-zero values of the mask at points of the surface: (P,) counts, and (M,) expressions and weights in order."""
    at_points = mask[triangles]
    _, columns = np.nonzero(at_points)
    return (at_points > 0).sum(1), columns, at_points[at_points > 0]


EXPRESSIONS = "expressions"
"""Key of the file's metadata: number of leading expressions that may have differences."""
GEOMETRY = {"means": 3, "log_scales": 3, "quats": 4, "opacities": 1, "sh_dc": 3}
"""First columns of the (N, 14 + 3 R) float32 table of neutral splats; R harmonics above degree 0 by channel follow."""
MEMBERS = {
    "splats": Member("f", ("N", None), MAX_MAGNITUDE, "f4"),
    **POINT_MEMBERS,
    "moved_by": Member("u", ("N", "bytes"), dtype="u1"),
    "differences": Member("f", (None, None), MAX_MAGNITUDE, "f4"),
}


class Stored(NamedTuple):
    """Content of an avatar's file."""

    neutral: dict[str, Tensor]
    """Per-splat tensors by name, see `blendshapes.apply_pose`."""
    points: SurfacePoints
    """Surface point of each splat at the start of training."""
    expressions: int

    entries: Entries
    """Rows of the differences; their weights are 1."""
    differences: Tensor
    """(M, C) difference at coefficient 1, in the columns of `blendshapes.difference_widths`."""


def write_avatar(
    path: Path,
    neutral: Mapping[str, Tensor],
    points: SurfacePoints,
    expressions: int,
    entries: Entries,
    differences: Tensor,
) -> None:
    """Write an avatar as safetensors, exact.

    A splat takes 4 (14 + 3 R) bytes for neutral attributes, 12 for its surface point, a bit for each expression, and 4
    C bytes for each expression that moves it: 12,055 bytes with all harmonics and all of 50 expressions.
    """
    count = len(neutral["means"])
    columns = [neutral[name].reshape(count, -1) for name in (*GEOMETRY, "sh_rest")]
    moved_by = torch.zeros(count, expressions, dtype=torch.bool)
    moved_by[entries.owners.cpu(), entries.expressions.cpu()] = True
    tensors = {
        **point_tensors(points),
        "splats": torch.cat(columns, dim=1),
        "moved_by": torch.from_numpy(np.packbits(moved_by.numpy(), axis=1)),
        "differences": differences,
    }
    write_tensors(path, tensors, {EXPRESSIONS: str(expressions)})


def stored_of(
    path: Path, tensors: dict[str, Tensor], metadata: Mapping[str, str], head: HeadAsset, device: str
) -> Stored:
    """Check the content of a file that `write_avatar` wrote."""
    said, expression_size = metadata.get(EXPRESSIONS, ""), head.expression_basis.shape[2]
    if not said.isdecimal() or len(said) > 9 or int(said) > expression_size:
        raise InputError(path, EXPRESSIONS, f"a number up to {expression_size}", repr(said[:20]))
    expressions = int(said)
    moved_by = _check(path, tensors, expressions)
    owners, moving = np.nonzero(moved_by)
    counts = torch.from_numpy(moved_by.sum(1)).to(device)
    columns = tensors["splats"].to(device).split([*GEOMETRY.values(), _rest(tensors["splats"])], dim=1)
    neutral = {name: column.contiguous() for name, column in zip((*GEOMETRY, "sh_rest"), columns)}
    neutral["opacities"] = neutral["opacities"][:, 0]
    neutral["sh_rest"] = neutral["sh_rest"].reshape(len(counts), 3, -1)
    points = take_points(path, tensors, len(head.faces))
    entries = Entries.of(counts, torch.from_numpy(moving).to(device), torch.ones(len(owners), device=device))
    return Stored(neutral, points, expressions, entries, tensors["differences"].to(device))


def _rest(splats: Tensor) -> int:
    return splats.shape[1] - sum(GEOMETRY.values())


def _check(path: Path, tensors: Mapping[str, Tensor], expressions: int) -> IntArray:
    """(N, K) whether an expression moves a splat."""
    sizes = check_tensors(path, tensors, MEMBERS, {"bytes": -(-expressions // 8)})
    splats = tensors["splats"]

    def require(name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(path, name, expected, f"shape {tuple(tensors[name].shape)}, or other numbers")

    rests = [3 * (coefficient_count(degree) - 1) for degree in range(4)]
    require("splats", sizes["N"] > 0 and _rest(splats) in rests, f"(N, 14 + 3 R), 3 R one of {rests}")
    check_sizes(path, splats[:, GEOMETRY["means"] : GEOMETRY["means"] + GEOMETRY["log_scales"]])
    moved_by = np.unpackbits(tensors["moved_by"].numpy(), axis=1, count=expressions)
    widths = [sum(difference_widths(d).values()) for d in range(4) if rests[d] <= _rest(splats)]
    table = tensors["differences"]
    fits = len(table) == int(moved_by.sum()) and table.shape[1] in widths
    require("differences", fits, f"({int(moved_by.sum())}, C), C one of {widths}")
    return moved_by.astype(np.int64)
