"""Expression clusters of a performance, for training on rare expressions as often as on common ones.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025, arXiv 2504.14967), class-balanced sampling: spectral clustering of the unposed training meshes
under the mean vertex distance of the face. The published code uses only training timesteps, so there is no leak; it
compares all pairs, and its k-means starts at random. Its behaviour is ``variant="official"``.

Both embeddings, of all pairs and of a few columns of the similarity matrix (Nyström), are those of scikit-learn's
`SpectralClustering` with a precomputed affinity: leading eigenvectors of D^-1/2 (S - I) D^-1/2, each row divided by
the square root of its degree. Von Luxburg, "A tutorial on spectral clustering", Statistics and Computing 2007;
Fowlkes, Belongie, Chung and Malik, "Spectral grouping using the Nyström method", PAMI 2004.

Jaw bases: a few jaw rotations that span those of a performance, and the weights of a pose on them. "3D Gaussian Head
Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations" (CVPR 2025, arXiv 2504.14967), section
on feature lines. The paper's code selects the bases from validation and test poses and seeds them with a half turn;
here they are selected only from training poses and seeded with the identity. The published behaviour is
``variant="official"``.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial.transform import Rotation
from sklearn.cluster import AgglomerativeClustering, KMeans, SpectralClustering

from ...bench.contracts import Clip, FloatArray, HeadAsset, HeadPose, IntArray, Progress, no_progress
from ...bench.protocol import evenly_with_ends
from ..head.arrays import region
from ..head.model import PosedSubject, pose_in_head_frame

IDENTITY = (1.0, 0.0, 0.0, 0.0)
HALF_TURN = (0.0, 0.0, 0.0, 1.0)
"""Real part first: half a turn about z. The published code intended the identity, with the real part last."""

DEFAULT_COUNT = 16
DISTINCT_ANGLE = np.radians(0.25)
"""Rotations nearer than this, in radians, count as equal: a tenth of the jaw's smallest visible motion."""

TGA_TEST_STRIDE = 16
"""The published code takes every 16th test frame: with 16 cameras, each timestep once."""


def leaks(variant: str) -> tuple[str, ...]:
    """Description of the leak of test data, for records of results."""
    return ("jaw bases drawn from held-out poses (published behaviour)",) if variant == "official" else ()


def jaw_quaternions(poses: Sequence[HeadPose]) -> FloatArray:
    """(N, 4) unit quaternions, real part first, of the poses' jaw rotations."""
    rotations = Rotation.from_rotvec(np.array([pose.jaw for pose in poses], dtype=np.float64).reshape(-1, 3))
    return rotations.as_quat()[:, [3, 0, 1, 2]]


def farthest_quaternions(
    candidates: FloatArray, seed: Sequence[float], count: int, *, tolerance: float = 0.0
) -> FloatArray:
    """Greedy farthest-point sampling by 1 - |<p, q>|, starting with ``seed``.

    ``candidates``: (N, 4) unit quaternions, real part first. ``seed``: (4,) the first choice, included in ``count``.
    ``tolerance``: Stop when no candidate is farther than this from the chosen ones.

    Returns
    -------
    FloatArray
        (n, 4), n at most ``count``: fewer if there are fewer distinct candidates.
    """
    chosen = [np.asarray(seed, dtype=np.float64)]
    nearest = 1 - np.abs(candidates @ chosen[0][:, None])[:, 0]
    while len(chosen) < count and nearest.size and nearest.max() > tolerance:
        chosen.append(candidates[nearest.argmax()])
        nearest = np.minimum(nearest, 1 - np.abs(candidates @ chosen[-1][:, None])[:, 0])
    return np.array(chosen)


def jaw_bases(
    clip: Clip, count: int = DEFAULT_COUNT, *, variant: Literal["paper", "official"] = "paper"
) -> FloatArray:
    """Jaw bases of a clip, (n, 4) unit quaternions with the real part first, n <= ``count``.

    There are fewer than ``count`` if the performance has fewer jaw rotations that differ by more than
    `DISTINCT_ANGLE`.

    ``variant``: "official" reproduces the published code: candidates are the poses of all novel-view frames and of every
    16th self-reenactment frame (**a leak of the test signal**), seeded with `HALF_TURN`.
    """
    if variant == "official":
        test = sorted(clip.splits["self_reenactment"], key=lambda key: (key.timestep, key.camera))
        keys = [*sorted(clip.splits["novel_view"]), *test[::TGA_TEST_STRIDE]]
        candidates = jaw_quaternions([clip.poses[key.timestep] for key in keys])
        return farthest_quaternions(candidates, HALF_TURN, count)
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    candidates = jaw_quaternions([clip.poses[timestep] for timestep in timesteps])
    # |<p, q>| is the cosine of half the angle between two rotations.
    tolerance = 1 - np.cos(DISTINCT_ANGLE / 2)
    return farthest_quaternions(candidates, IDENTITY, count, tolerance=tolerance)


def jaw_weights(quaternions: FloatArray, bases: FloatArray) -> FloatArray:
    """(N, n) weights of jaw rotations on the bases: |<q, q_i>| / sum_j |<q, q_j>|; rows sum to 1.

    They hardly depend on the pose: the cosine of half an angle a is 1 - a^2 / 8, so for angles up to 0.2 rad from the bases all
    weights lie within 0.5 % of 1 / n.

    ``quaternions``: (N, 4) unit quaternions, real part first. ``bases``: (n, 4) output of `jaw_bases`.
    """
    likeness = np.abs(quaternions @ bases.T)
    return likeness / likeness.sum(axis=1, keepdims=True)


DEFAULT_CLASSES = 16
LANDMARK_LIMIT = 500
"""Maximum number of timesteps for comparing all pairs; more timesteps are represented by at most as many landmarks."""

LANDMARK_TOLERANCE = 0.01
"""Fraction of the largest distance within which every face has a landmark, if their number permits it."""

_DIGITS = 6  # number of digits to which relative distances of one face are equal


@dataclass(frozen=True, eq=False)
class ExpressionClusters:
    """Class of each training timestep."""

    timesteps: IntArray
    """(T,) sorted training timesteps."""
    labels: IntArray
    """(T,) class of each, from 0; no class is empty."""
    medoids: IntArray
    """(classes,) timestep of each class that is nearest to its centre in the spectral embedding."""
    landmarks: int
    """Number of landmark timesteps; T if all pairs were compared."""
    radius: float
    """Metres within which every face has a landmark; 0 if all pairs were compared."""
    variant: str = "paper"
    """"official" for the published behaviour."""

    @property
    def by_timestep(self) -> dict[int, int]:
        """Class by timestep."""
        return dict(zip(self.timesteps.tolist(), self.labels.tolist()))

    def record(self) -> dict[str, Any]:
        """Content of the step's record."""
        return {
            "timesteps": len(self.timesteps),
            "class_sizes": np.bincount(self.labels).tolist(),
            "medoids": self.medoids.tolist(),
            "landmarks": self.landmarks,
            "radius_mm": round(1000 * self.radius, 4),
            "variant": self.variant,
        }


def cluster_expressions(
    clip: Clip,
    classes: int = DEFAULT_CLASSES,
    *,
    seed: int = 0,
    limit: int = LANDMARK_LIMIT,
    variant: Literal["paper", "official"] = "paper",
    progress: Progress = no_progress,
) -> ExpressionClusters:
    """Cluster the training timesteps of a clip by the shape of the face.

    Up to ``limit`` timesteps all pairs are compared. Above that, farthest-point landmarks represent all and the
    Nyström method is used (see `spectral`); memory then grows with T times ``limit`` and T times the size of a face,
    never with T squared. There are never more classes than distinct faces (landmarks, beyond ``limit``).

    ``seed``: Seed of the first landmark, or of the random starts of "official"; unused for all pairs otherwise.
    ``variant``: "official" reproduces the published code: all pairs regardless of their number, k-means from ten random
    starts. Both use training timesteps only.
    """
    timesteps = np.array(sorted({key.timestep for key in clip.splits["train"]}))
    faces = expression_displacements(clip, timesteps.tolist())
    if len(faces) <= limit or variant == "official":
        distances = mean_vertex_distances(faces)
        labels, embedding = cluster_by_distance(distances, classes, seed=seed, variant=variant)
        landmarks, radius = len(faces), 0.0
    else:
        chosen = farthest_meshes(faces, limit, seed=seed, tolerance=LANDMARK_TOLERANCE, progress=progress)
        labels, embedding = cluster_by_distance(chosen.distances, classes, chosen.indices)
        landmarks, radius = len(chosen.indices), chosen.radius
    medoids = timesteps[_medoids(labels, embedding)]
    return ExpressionClusters(timesteps, labels, medoids, landmarks, radius, variant)


def cluster_by_distance(
    distances: FloatArray,
    classes: int,
    landmarks: IntArray | None = None,
    *,
    seed: int = 0,
    variant: Literal["paper", "official"] = "paper",
) -> tuple[IntArray, FloatArray]:
    """Spectral clustering with the similarity 1 - d / max d, from all pairs or only from distances to landmarks.

    ``distances``: (N, N) symmetric, zero diagonal; or (N, m) of each item to each landmark. If the landmarks are farthest
    points, the largest of these is the largest of all, up to the landmarks' radius. ``classes``: Maximum number of classes;
    fewer if there are fewer distinct items. ``landmarks``: (m,) distinct indices of the landmarks.

    Returns
    -------
    tuple[IntArray, FloatArray]
        (N,) labels from 0, without empty classes, and the (N, c) embedding that was clustered.
    """
    count, largest = len(distances), float(distances.max(initial=0.0))
    rows = distances if landmarks is None else distances[landmarks]
    distinct = len(np.unique(np.round(rows / largest, _DIGITS), axis=0)) if largest > 0 else 1
    classes = min(classes, distinct)
    if classes <= 1 or classes >= count:  # all in one class, or each in its own
        labels = np.zeros(count, dtype=np.int64) if classes <= 1 else np.arange(count)
        return labels, labels[:, None].astype(np.float64)
    similarity = similarities(distances, largest)
    if landmarks is not None:
        embedding = nystrom_embedding(similarity, landmarks, classes)
    else:
        embedding = exact_embedding(similarity, classes)
        if variant == "official":
            published = SpectralClustering(classes, affinity="precomputed", random_state=seed)
            labels = np.unique(published.fit_predict(similarity), return_inverse=True)[1].astype(np.int64)
            return labels, embedding
    return classes_of(embedding, classes), embedding


def _medoids(labels: IntArray, embedding: FloatArray) -> IntArray:
    """(classes,) item of each class nearest to the mean of the class."""
    rows = []
    for label in range(labels.max() + 1):
        members = np.flatnonzero(labels == label)
        points = embedding[members]
        rows.append(members[np.square(points - points.mean(axis=0)).sum(axis=1).argmin()])
    return np.array(rows)


FACE_REGION, EYE_REGION = "face", "eye_region"
EYE_WEIGHT = 2.0

_BLOCK = 16
"""Number of meshes compared with one at a time, so that their differences fit in the processor's cache."""


class Landmarks(NamedTuple):
    """Landmark meshes."""

    indices: IntArray
    """(m,) indices of the landmarks, distinct, in the order of selection."""
    distances: FloatArray
    """(N, m) float32 distance of every mesh to each of them, metres."""
    radius: float
    """Distance, metres, within which every mesh has a landmark."""


def expression_displacements(clip: Clip, timesteps: Sequence[int]) -> FloatArray:
    """(T, 3, F) float32 displacements of the face's F vertices from the neutral face, metres. Meshes have jaw, eyes and
    expression, but no rotation, neck and translation; vertices of the eye region have weight `EYE_WEIGHT`."""
    vertices, weights = _face_vertices(clip.head)
    subject = PosedSubject.of(clip, torch.float32)
    poses = [pose_in_head_frame(clip.poses[timestep]) for timestep in timesteps]
    result = np.empty((len(timesteps), 3, len(vertices)), dtype=np.float32)
    start = 0
    for meshes in subject.batches(poses):
        moved = (meshes[:, vertices] - subject.neutral[vertices]) * weights[:, None]
        result[start : start + len(meshes)] = moved.transpose(0, 2, 1)
        start += len(meshes)
    return result


def mean_vertex_distances(meshes: FloatArray) -> FloatArray:
    """(N, N) float32 mean over vertices of the Euclidean distance among (N, 3, F) meshes, each pair once."""
    result = np.zeros((len(meshes), len(meshes)), dtype=np.float32)

    def fill(start: int) -> None:
        # Columns in blocks: a block stays in the cache while every mesh before its end is compared with it.
        block = meshes[start : start + _BLOCK]
        for row in range(min(start + _BLOCK, len(meshes))):
            result[row, start : start + _BLOCK] = _distances_to(block, meshes[row])

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(fill, range(0, len(meshes), _BLOCK)))
    upper = np.triu(result, 1)
    return upper + upper.T


def farthest_meshes(
    meshes: FloatArray, limit: int, *, seed: int = 0, tolerance: float = 0.0, progress: Progress = no_progress
) -> Landmarks:
    """Greedy farthest-point sampling, starting from a random mesh.

    By the triangle inequality the distance of any two meshes differs from that of their landmarks by the sum of
    their distances to these, at most twice the radius. Memory grows with N times ``limit``, never with N squared.

    ``meshes``: (N, 3, F) float32, N at least 1. ``limit``: Maximum number of landmarks. ``tolerance``: Stop when the radius
    is at most this fraction of the largest distance found.
    """
    count = min(limit, len(meshes))
    columns = np.empty((count, len(meshes)), dtype=np.float32)
    nearest = np.full(len(meshes), np.inf, dtype=np.float32)
    chosen = [int(np.random.default_rng(seed).integers(len(meshes)))]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for step in range(count):
            compare = partial(_distances_to, mesh=meshes[chosen[-1]])
            row = columns[step]
            row[:] = np.concatenate(list(pool.map(compare, np.array_split(meshes, torch.get_num_threads()))))
            np.minimum(nearest, row, out=nearest)
            progress(step + 1, count, "landmarks")
            if step + 1 == count or nearest.max() <= tolerance * columns[: step + 1].max():
                break
            chosen.append(int(nearest.argmax()))
    return Landmarks(np.array(chosen), columns[: len(chosen)].T, float(nearest.max()))


def _distances_to(meshes: FloatArray, mesh: FloatArray) -> FloatArray:
    """(N,) float32 mean vertex distances of (N, 3, F) meshes to one."""
    result = np.empty(len(meshes), dtype=np.float32)
    difference = np.empty((_BLOCK, *mesh.shape), dtype=np.float32)
    length = np.empty((_BLOCK, mesh.shape[1]), dtype=np.float32)
    for start in range(0, len(meshes), _BLOCK):
        block = meshes[start : start + _BLOCK]
        delta, norm = difference[: len(block)], length[: len(block)]
        # The product form |a|^2 - 2ab + |b|^2 would lose the differences between neighbouring frames.
        np.subtract(block, mesh, out=delta)
        np.einsum("nkf,nkf->nf", delta, delta, out=norm)
        np.mean(np.sqrt(norm, out=norm), axis=1, out=result[start : start + _BLOCK])
    return result


def _face_vertices(head: HeadAsset) -> tuple[IntArray, FloatArray]:
    """Face vertices and their weights."""
    face = region(head, FACE_REGION)
    eyes = np.isin(face, head.regions.get(EYE_REGION, np.array([], dtype=int)))
    return face, np.where(eyes, EYE_WEIGHT, 1.0).astype(np.float32)


SIMILARITY_FLOOR = 1e-6
"""The farthest pair has similarity 0; the floor keeps a graph of few distinct items connected."""

START_LIMIT = 2000
"""Maximum number of items for the hierarchy of initial classes, whose memory grows with the square of their number."""

_RANK_TOLERANCE = 1e-9  # eigenvalues of the landmarks' block below this part of the largest are noise
_SMALL_FACTOR = 4  # with fewer landmarks than this times the classes, Lanczos has no room: solve densely


def similarities(distances: FloatArray, largest: float) -> FloatArray:
    """1 - d / largest as float64, at least `SIMILARITY_FLOOR`."""
    return np.maximum(1 - distances.astype(np.float64) / largest, SIMILARITY_FLOOR)


def exact_embedding(similarity: FloatArray, classes: int) -> FloatArray:
    """(N, classes) spectral embedding of the (N, N) symmetric similarities of all pairs."""
    links = similarity.copy()
    np.fill_diagonal(links, 0.0)
    scale = 1 / np.sqrt(links.sum(axis=1))
    count = len(links)
    _, vectors = eigh(links * scale[:, None] * scale, subset_by_index=(count - classes, count - 1))
    return _leading_first(vectors) * scale[:, None]


def nystrom_embedding(columns: FloatArray, landmarks: IntArray, classes: int) -> FloatArray:
    """(N, classes) spectral embedding from the similarities to m landmarks alone.

    The matrix of all pairs is replaced by C A^+ C^T, with C the columns and A their rows at the landmarks (A need
    not be positive). Its diagonal is removed as that of the exact matrix is, and its eigenvectors are found by
    Lanczos iterations, so that they are orthogonal and nothing of size N squared is formed.

    ``columns``: (N, m) similarity of each item to each landmark. ``landmarks``: (m,) indices of the landmarks; m at least
    ``classes``.
    """
    block = columns[landmarks]
    values, vectors = eigh(0.5 * (block + block.T))
    kept = np.abs(values) > _RANK_TOLERANCE * np.abs(values).max()
    # S = factor diag(sign) factor^T
    factor = columns @ (vectors[:, kept] / np.sqrt(np.abs(values[kept])))
    sign = np.sign(values[kept])
    diagonal = np.square(factor) @ sign
    degree = factor @ (sign * factor.sum(axis=0)) - diagonal
    # Approximate degrees may be negative in rare cases; they are limited to a single weakest link.
    scale = 1 / np.sqrt(np.maximum(degree, SIMILARITY_FLOOR))

    def apply(vector: FloatArray) -> FloatArray:
        scaled = scale * vector.ravel()
        return scale * (factor @ (sign * (factor.T @ scaled)) - diagonal * scaled)

    count = len(columns)
    operator = LinearOperator((count, count), matvec=apply, dtype=np.float64)
    if count < _SMALL_FACTOR * classes:
        dense = operator @ np.eye(count)
        _, found = eigh(0.5 * (dense + dense.T), subset_by_index=(count - classes, count - 1))
    else:
        _, found = eigsh(operator, classes, which="LA", v0=np.ones(count))
    return _leading_first(found) * scale[:, None]


def classes_of(embedding: FloatArray, classes: int) -> IntArray:
    """(N,) labels from 0 by k-means; the same for the same embedding, and nearly so for a nearly equal one.

    k-means starts from the centres of Ward's hierarchy instead of from random ones: random starts end in classes
    that differ from seed to seed, and mostly fit worse. Beyond `START_LIMIT` items the hierarchy is that of
    items spread evenly over the order given.
    """
    start = evenly_with_ends(range(len(embedding)), START_LIMIT)
    sample = embedding[start]
    groups = AgglomerativeClustering(classes).fit_predict(sample)
    centres = np.array([sample[groups == group].mean(axis=0) for group in range(classes)])
    labels = KMeans(classes, init=centres, n_init=1).fit_predict(embedding)
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def _leading_first(vectors: FloatArray) -> FloatArray:
    """Eigenvectors, the leading one first, each with the sign that makes its largest entry positive."""
    vectors = vectors[:, ::-1]
    largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(vectors.shape[1])]
    return vectors * np.sign(largest)
