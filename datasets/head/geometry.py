"""Geometry of points and triangle meshes in numpy.

Rounding to a grid of powers of two, so that all x86-64 machines give the same values. The last digits of exp, sin,
decompositions and long sums depend on instruction set, BLAS and threads. Values of a synthetic capture are rounded when
computed, at least a thousand times coarser than those digits; products and sums of such numbers within the 53 bits of a
float64 are then exact in any order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ...bench.contracts import Camera, FloatArray, IntArray

LENGTH_BITS = 27
"""Grid of positions and displacements: 2**-27 m, or 7 nm."""
SHARE_BITS = 24
"""Grid of skinning weights, 6e-8; float32 holds no finer one at 1."""
REGRESSOR_BITS = 30
"""Grid of a joint regressor, whose rows have hundreds of entries of about 0.01."""
COEFFICIENT_BITS = 20
"""Grid of coefficients, of activations in [0, 1] or of standard deviations: 1e-6."""
ANGLE_BITS = 30
"""Grid of rotation matrices and of angles in radians: 1e-9, which moves no pixel by 1e-5."""


def share_left(seconds: FloatArray | float, constant: float) -> FloatArray:
    """Fraction of a difference that remains after ``seconds``, 1/e after ``constant``; rounded to the grid of coefficients."""
    return on_grid(np.exp(-np.asarray(seconds) / constant), COEFFICIENT_BITS)


def on_grid(values: FloatArray | float, bits: int) -> FloatArray:
    """Round to the nearest multiples of 2**-bits, ties to even; zeros come out positive."""
    scale = 2.0**bits
    rounded: FloatArray = np.round(np.asarray(values, np.float64) * scale) / scale + 0.0
    return rounded


def smoothstep(values: FloatArray, low: float | FloatArray, high: float | FloatArray) -> FloatArray:
    """Smoothstep: 0 at ``low``, 1 at ``high`` (which may be smaller), with a cubic of zero slope at both ends between."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mesh_edges(faces: IntArray) -> IntArray:
    """(3 F, 2) directed edges: those from corner 0 to 1 of all triangles, then 1 to 2, then 2 to 0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def unique_pairs(pairs: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Unique rows of an (n, 2) array of indices, sorted, (m, 2); inverse indices (n,); counts (m,). Ten times faster
    than `numpy.unique` along an axis because pairs are compared as single numbers."""
    base = int(pairs.max(initial=0)) + 1
    codes, inverse, count = np.unique(
        pairs[:, 0].astype(np.int64) * base + pairs[:, 1], return_inverse=True, return_counts=True
    )
    return np.stack(np.divmod(codes, base), axis=1), inverse, count


def border_edges(faces: IntArray) -> IntArray:
    """(B, 2) directed edges that belong to one triangle only."""
    edges = mesh_edges(faces)
    _, inverse, count = unique_pairs(np.sort(edges, axis=1))
    return edges[count[inverse] == 1]


def connected_pieces(vertices: IntArray, edges: IntArray) -> list[IntArray]:
    """Connected pieces of the mesh restricted to some of its vertices, sorted; ``edges``: (n, 2) of the whole mesh."""
    count = 1 + max(int(edges.max()), int(vertices.max(initial=0)))
    inside = np.isin(np.arange(count), vertices)
    inner = edges[inside[edges].all(axis=1)]
    graph = coo_matrix((np.ones(len(inner)), inner.T), shape=(count, count))
    labels = connected_components(graph, directed=False)[1][vertices]
    return [vertices[labels == label] for label in np.unique(labels)]


def triangle_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(F,) areas of triangles, in the square of the vertices' unit."""
    corners = np.asarray(vertices, np.float64)[faces]
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(0.5 * np.linalg.norm(np.cross(one, other), axis=1))


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """(V, 3) unit normals, area-weighted means over adjacent triangles; 0 at vertices without area."""
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    areas = np.cross(edges[:, 0], edges[:, 1])
    sums = np.stack(
        [np.bincount(faces.ravel(), np.repeat(areas[:, i], 3), len(vertices)) for i in range(3)], axis=1
    )
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(np.float64).tiny)


def even_weights(points: FloatArray, target: FloatArray) -> FloatArray:
    """(n,) weights of points (n, 3) that sum to 1 and reproduce the target, as even as possible. The target then moves
    with the points in every translation, rotation and scaling. Raises `ValueError` if the points do not span it."""
    constraints = np.vstack([points.T, np.ones(len(points))])
    even = np.full(len(points), 1 / len(points))
    wanted = np.array([*target, 1.0])
    weights: FloatArray = even + np.linalg.lstsq(constraints, wanted - constraints @ even, rcond=None)[0]
    if not np.allclose(constraints @ weights, wanted, atol=1e-6):
        raise ValueError("the points do not span the target")
    return weights


def fit_sphere(points: FloatArray) -> tuple[FloatArray, float]:
    """Centre and radius of the sphere through points (n, 3): linear (algebraic) least squares."""
    middle = points.mean(axis=0)
    local = points - middle
    design = np.concatenate([2.0 * local, np.ones((len(local), 1))], axis=1)
    solution = np.linalg.lstsq(design, (local**2).sum(axis=1), rcond=None)[0]
    return middle + solution[:3], float(np.sqrt(solution[3] + solution[:3] @ solution[:3]))


def project(points: FloatArray, camera: Camera) -> FloatArray:
    """(n, 2) pixels of points (n, 3) in the world; points behind the camera give meaningless pixels."""
    seen = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels: FloatArray = (seen @ camera.K.T)[:, :2] / np.maximum(seen[:, 2:], 1e-6)
    return pixels


def project_facing(
    points: FloatArray, normals: FloatArray, camera: Camera, cosine: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(n, 2) pixels of points (n, 3), and (n,) whether each lies in the image with its normal within an angle of that
    ``cosine`` to the camera."""
    outward = camera.center - points
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    pixels = project(points, camera)
    within = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    return pixels, ((normals * outward).sum(axis=1) > cosine) & within


def rigid_alignment(points: FloatArray, wanted: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """(4, 4) rigid motion from points (n, 3) to ``wanted`` with the smallest weighted squared distance.

    Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32, 1976; with the
    sign that excludes reflections. Without weights all points count the same.
    """
    weights = np.ones(len(points)) if weights is None else weights
    share = (weights / weights.sum())[:, None]
    middle, wanted_middle = (share * points).sum(axis=0), (share * wanted).sum(axis=0)
    u, _, vt = np.linalg.svd((share * (points - middle)).T @ (wanted - wanted_middle))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    motion = np.eye(4)
    motion[:3, :3] = (u @ sign @ vt).T
    motion[:3, 3] = wanted_middle - motion[:3, :3] @ middle
    return motion
