"""What avatars compute of a frame before its splats are drawn, on a GPU: in few operations and without waiting for it.

What is small is computed on the host in float64 and sent as one vector: a small operation on a GPU costs as much time as one
on all splats. The rest is few operations on all triangles or splats. Products of many small matrices are sums over columns
here, for the libraries of GPUs give a block of threads to each matrix.

Definitions are in `binding`, `networks`, `HeadModel` and the methods. Training on a GPU uses `triangles` and `shade`, which have
gradients, and else the definitions.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import embedding_bag, normalize, pad

from ...bench.contracts import FloatArray, HeadPose
from ...datasets.head.model import HeadModel, joint_motions
from .binding import NORM_FLOOR, Frames, WorldSplats, left_products
from .networks import C0, FREQUENCIES, sh_basis


def usable(like: Tensor) -> bool:
    """Tell whether frames are computed as here where this tensor is: on any device but the CPU, without gradients."""
    return like.device.type != "cpu" and not torch.is_grad_enabled()


def to_device(numbers: FloatArray, device: torch.device | str) -> Tensor:
    """Float32 copy of an array on a device, see `sent`."""
    return sent(torch.from_numpy(np.ascontiguousarray(numbers, np.float32)), device)


def sent(values: Tensor, device: torch.device | str) -> Tensor:
    """Host memory on a device; the host does not wait for the copy."""
    return pinned(values, device).to(device, non_blocking=True)


def pinned(values: Tensor, device: torch.device | str) -> Tensor:
    """Host memory that a device copies by itself: from other memory the host would copy it first."""
    return values.pin_memory() if torch.device(device).type == "cuda" else values


class PoseNumbers:
    """What the numbers of a pose come to before they meet vertices.

    Parameters
    ----------
    model : the head.
    canonical : (1, V, 3), what `HeadModel.canonical` gave for the identity.

    Attributes
    ----------
    coefficients : K, expressions and pose correctives.
    motions : R, motions that `rows` weighs: of each joint, of all vertices together, and of the eyelids, if any.
    """

    def __init__(self, model: HeadModel, canonical: Tensor):
        self._model = model
        regressor = model.joint_regressor.cpu().double()
        expressions = model.expression_matrix.cpu().double().unflatten(1, (-1, 3))
        self._joints = (regressor @ canonical.cpu().double()).numpy()
        self._by_expression = torch.einsum("jv,evc->ejc", regressor, expressions).flatten(1).numpy()
        self._lids = 0 if model.eyelid_matrix is None else len(model.eyelid_matrix)
        self.coefficients = len(model.expression_matrix) + len(model.pose_matrix)
        self.motions = len(model.parents) + 1 + 3 * self._lids

    @property
    def size(self) -> int:
        """Numbers of a pose."""
        return self.coefficients + 12 * self.motions

    def rows(self) -> Tensor:
        """(V, R) weights of the motions."""
        model = self._model
        weights = model.skinning_weights
        parts = [weights, torch.ones_like(weights[:, :1])]
        if model.eyelid_matrix is not None:
            parts.append(model.eyelid_matrix.unflatten(1, (-1, 3)).transpose(0, 1).flatten(1))
        return torch.cat(parts, dim=1)

    def __call__(self, pose: HeadPose) -> FloatArray:
        """(size,) coefficients, then (R, 4, 3) motions: the columns of A and b, which take a point x to ``A x + b``.

        Raises `InputError` for another head model's pose.
        """
        columns = {name: values[0] for name, values in self._model.pose_columns([pose]).items()}
        angles = np.concatenate([columns[name] for name in ("rotation", "neck", "jaw", "eyes")])
        local = Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix()
        joints = self._joints + (columns["expression"] @ self._by_expression).reshape(-1, 3)
        turns, shifts = joint_motions(local[None], joints, self._model.parents)
        motions = np.zeros((self.motions, 4, 3))
        count = len(self._model.parents)
        motions[:count, :3], motions[:count, 3] = turns[0].transpose(0, 2, 1), shifts[0]
        motions[count, 3] = columns["translation"]
        if self._lids:
            lids = columns["eyelids"][:, None, None] * (local[0] @ local[1]).T
            motions[count + 1 :, 3] = lids.reshape(-1, 3)
        feature = (local[1:] - np.eye(3)).reshape(-1)
        return np.concatenate([columns["expression"], feature, motions.reshape(-1)])

    def split(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """(K,) coefficients and (R, 12) motions in what was sent; more numbers may follow."""
        motions = numbers[self.coefficients : self.size].view(-1, 12)
        return numbers[: self.coefficients], motions


class PosedVertices:
    """Vertices of a subject's head in the world: `HeadModel.forward` of one pose.

    Parameters
    ----------
    model, canonical : as those of `PoseNumbers`.
    """

    def __init__(self, model: HeadModel, canonical: Tensor):
        self.numbers = PoseNumbers(model, canonical)
        directions = torch.cat([model.expression_matrix, model.pose_matrix]).unflatten(1, (-1, 3))
        # A fourth coordinate of 1, with which one product does both turn and shift.
        self._directions = pad(directions, (0, 1)).flatten(1)
        self._neutral = pad(canonical[0], (0, 1), value=1.0).flatten()
        self._rows = self.numbers.rows()

    def __call__(self, numbers: Tensor) -> Tensor:
        """(V, 3) metres, from what `PoseNumbers` gave."""
        coefficients, motions = self.numbers.split(numbers)
        unposed = torch.addmv(self._neutral, self._directions.t(), coefficients).view(-1, 4, 1)
        return ((self._rows @ motions).view(-1, 4, 3) * unposed).sum(1)


def corners_of(faces: Tensor) -> Tensor:
    """(3 F,) int64 of (F, 3) faces: all first corners, all second ones, all third ones."""
    return faces.t().reshape(-1)


def triangles(vertices: Tensor, corners: Tensor) -> Frames:
    """`binding.triangle_frames` of (V, 3) vertices, with the `corners_of` the faces. Quaternions have any sign."""
    points = vertices.index_select(0, corners).view(3, -1, 3)
    base, side = (points[1:] - points[:1]).unbind(0)
    length = _length(base)
    along = base / length
    perpendicular = torch.linalg.cross(along, side)
    height = _length(perpendicular)
    normal = perpendicular / height
    columns = torch.stack([along, normal, torch.linalg.cross(along, normal)], dim=1)
    size = torch.lerp(length, height, 0.5)[:, 0]
    return Frames(columns.transpose(1, 2), points.mean(0), size, quaternions(columns.flatten(1)))


def quaternions(columns: Tensor, squarings: int = 0) -> Tensor:
    """(N, 4) unit quaternions, real part first, of any sign, nearest to matrices whose columns (N, 9) has one by one.

    Of the symmetric matrix whose eigenvector of the largest eigenvalue is the quaternion of the nearest rotation (Davenport
    1968, in Keat, "Analysis of Least-Squares Attitude Determination Routine DOAOP", 1977), with its eigenvalues moved up
    by 1. Of a rotation it is 4 q q^T, of which the row with the largest diagonal is taken. Each of the ``squarings`` squares
    the ratio of the other eigenvalues to the largest; two are enough for blended rotations that differ by 60 degrees.
    """
    constants = _constants(columns.dtype, columns.device)
    matrices = torch.addmm(constants.identity, columns, constants.products).view(-1, 4, 4)
    for _ in range(squarings):
        matrices = (matrices[:, :, :, None] * matrices[:, None]).sum(2)
    largest = matrices.diagonal(dim1=1, dim2=2).argmax(1)
    row = matrices.gather(1, largest[:, None, None].expand(-1, 1, 4))[:, 0]
    return row / torch.linalg.vector_norm(row, dim=1, keepdim=True)


def quaternion_products(units: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 9) rotations, row by row, and (N, 16) `left_products` of (N, 4) unit quaternions."""
    constants = _constants(units.dtype, units.device)
    squares = (units[:, :, None] * units[:, None]).flatten(1)
    return squares @ constants.rotations, units @ constants.left


def turns_between(to: Tensor, origin: Tensor) -> Tensor:
    """(F, 3, 3) rotations ``to`` times the transposes of ``origin``."""
    return (to[:, :, None] * origin[:, None]).sum(3)


def splats_to_world(
    frames: Frames, binding: Tensor, means: Tensor, quats: Tensor, scales: Tensor
) -> WorldSplats:
    """`binding.to_world` of unit quaternions and scales.

    Parameters
    ----------
    binding : (N,) int64, the triangle of each splat.
    means : (N, 4), in units of the triangle's size; the fourth number is 1.
    quats, scales : (N, 4) unit quaternions wxyz, and (N, 3) in the same unit.
    """
    columns = frames.size[:, None, None] * frames.rotation.transpose(1, 2)
    left = frames.quaternion @ _constants(means.dtype, means.device).left
    packed = torch.cat([columns.reshape(-1, 9), frames.center, left, frames.size[:, None]], dim=1)
    linear, turn, size = packed.index_select(0, binding).split([12, 16, 1], dim=1)
    return WorldSplats(
        (linear.unflatten(1, (4, 3)) * means[:, :, None]).sum(1),
        (turn.unflatten(1, (4, 4)) * quats[:, None]).sum(2),
        size * scales,
    )


def directions_from(
    means: Tensor, center: Tensor, turns: Tensor | None = None, binding: Tensor | None = None
) -> Tensor:
    """(N, 3) unit vectors from the camera to the splats, turned by ``turns`` (F, 3, 3) of the splats' triangles."""
    vectors = means - center
    if turns is not None and binding is not None:
        rows = turns.flatten(1).index_select(0, binding).unflatten(1, (3, 3))
        vectors = (rows * vectors[:, None]).sum(2)
    return normalize(vectors, dim=1)


def coefficients_of(dc: Tensor, rest: Tensor) -> Tensor:
    """(N, 3, K) coefficients for `shade`, of (N, 3) and (N, 3, K - 1)."""
    return torch.cat([(dc + 0.5 / C0)[:, :, None], rest], dim=2)


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    """`networks.sh_to_rgb`: colours (N, 3) >= 0 along (N, 3) unit vectors, of `coefficients_of` degree 0 to 3."""
    degree = round(coefficients.shape[2] ** 0.5) - 1
    basis = basis_matrix(degree, directions.dtype, directions.device)
    if degree == 0:
        return torch.relu(coefficients[:, :, 0] * basis)
    ones = pad(directions, (0, 1), value=1.0)
    products = ones
    for _ in range(degree - 1):
        products = (products[:, :, None] * ones[:, None]).flatten(1)
    return torch.relu((coefficients * (products @ basis)[:, None]).sum(2))


@functools.cache
def basis_matrix(degree: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """(4^degree, K) matrix that makes spherical harmonics of all products of ``degree`` of the numbers x, y, z and 1."""
    points = torch.rand(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    ones = pad(points, (0, 1), value=1.0)
    products = torch.ones(len(points), 1, dtype=torch.float64)
    for _ in range(degree):
        products = (products[:, :, None] * ones[:, None]).flatten(1)
    # Equal products share a coefficient: least squares of rank less than full, as exact as float64.
    solved = torch.linalg.pinv(products, rtol=1e-10) @ sh_basis(points, degree)
    return solved.to(dtype).to(device)  # not every device has float64


class DirectionLayer:
    """What `networks.encode` of a direction adds to a layer, in two products and one sine: cos a = sin(a + pi / 2).

    Parameters
    ----------
    weights : (27, H) of the layer, by `encode` of directions from the splats to the camera.
    """

    def __init__(self, weights: Tensor):
        # Of the directions' negatives; each wave reads one coordinate.
        columns = [-frequency * np.eye(3) for frequency in FREQUENCIES for _ in range(2)]
        phases = np.tile(np.repeat([0.0, np.pi / 2], 3), len(FREQUENCIES))
        self._linear = (-weights[:3]).contiguous()
        self._waves = weights[3:].contiguous()
        self._frequencies, self._phases = (
            torch.from_numpy(values).to(weights.dtype).to(weights.device)
            for values in (np.concatenate(columns, axis=1), phases)
        )

    def __call__(self, hidden: Tensor, directions: Tensor) -> Tensor:
        """(N, H): ``hidden`` plus what (N, 3) unit vectors from the camera to the splats add."""
        waves = torch.addmm(self._phases, directions, self._frequencies).sin_()
        return torch.addmm(torch.addmm(hidden, directions, self._linear), waves, self._waves)


class WeightedRows:
    """`networks.sum_rows` with rows and weights that stay: one operation.

    Parameters
    ----------
    rows, weights : (N, K) int64, and of the table's dtype.
    """

    def __init__(self, rows: Tensor, weights: Tensor):
        self._rows, self._weights = rows.reshape(-1).contiguous(), weights.reshape(-1).contiguous()
        self._starts = torch.arange(len(rows), device=rows.device) * rows.shape[1]

    def __call__(self, table: Tensor) -> Tensor:
        """(N, C) of a (T, C) table."""
        return embedding_bag(self._rows, table, self._starts, per_sample_weights=self._weights, mode="sum")


def _length(vectors: Tensor) -> Tensor:
    """(N, 1) lengths of (N, 3) vectors, `NORM_FLOOR` at least."""
    return torch.linalg.vector_norm(vectors, dim=1, keepdim=True).clamp_min(NORM_FLOOR)


class _Constants:
    """Matrices with which products of quaternions are linear in their numbers."""

    def __init__(self, dtype: torch.dtype, device: torch.device):
        symmetric = np.zeros((9, 4, 4))
        for at, entries in enumerate(_SYMMETRIC):
            for row, column, sign in entries:
                symmetric[at, row, column] = symmetric[at, column, row] = sign
        # 4 q q^T = 1 + sum over n of R_n S_n, and R_n = <S_n, q q^T>.
        products = torch.from_numpy(symmetric.reshape(3, 3, 16))
        by_columns, rotations = products.transpose(0, 1).flatten(0, 1), products.flatten(0, 1).t()
        found = (torch.eye(4).flatten(), by_columns, rotations, left_products(torch.eye(4)).flatten(1))
        self.identity, self.products, self.rotations, self.left = (
            value.to(dtype).contiguous().to(device) for value in found
        )


_DIAGONALS = ((1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1))
_SYMMETRIC: tuple[tuple[tuple[int, int, float], ...], ...] = (
    tuple((n, n, s) for n, s in enumerate(_DIAGONALS[0])),
    ((0, 3, -1.0), (1, 2, 1.0)),
    ((0, 2, 1.0), (1, 3, 1.0)),
    ((0, 3, 1.0), (1, 2, 1.0)),
    tuple((n, n, s) for n, s in enumerate(_DIAGONALS[1])),
    ((0, 1, -1.0), (2, 3, 1.0)),
    ((0, 2, -1.0), (1, 3, 1.0)),
    ((0, 1, 1.0), (2, 3, 1.0)),
    tuple((n, n, s) for n, s in enumerate(_DIAGONALS[2])),
)
"""For each entry of a rotation matrix, row by row: row, column and sign of where 4 q q^T has it."""


@functools.cache
def _constants(dtype: torch.dtype, device: torch.device) -> _Constants:
    return _Constants(dtype, device)
