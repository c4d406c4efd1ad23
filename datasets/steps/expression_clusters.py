"""Expression classes of a performance, so that rare expressions are trained on as often as common ones.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025, arXiv 2504.14967), class-balanced sampling: spectral clustering of the unposed training meshes
under the mean vertex distance of the face. The published code draws on training timesteps alone, so nothing
leaks; it compares all pairs, and its k-means starts at random. Its behaviour is ``variant="official"``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from sklearn.cluster import SpectralClustering

from ...bench.contracts import Clip, FloatArray, IntArray, Progress, no_progress
from .face_distances import expression_displacements, farthest_meshes, mean_vertex_distances
from .spectral import classes_of, exact_embedding, nystrom_embedding, similarities

DEFAULT_CLASSES = 16
LANDMARK_LIMIT = 500
"""Timesteps up to which all pairs are compared; beyond, at most as many landmarks stand for all."""

LANDMARK_TOLERANCE = 0.01
"""Fraction of the largest distance within which every face has a landmark, if so many are allowed."""

_DIGITS = 6  # distances equal to so many digits, as parts of the largest, are those of one face


@dataclass(frozen=True, eq=False)
class ExpressionClusters:
    """Class of each training timestep.

    Attributes
    ----------
    timesteps : (T,) sorted training timesteps.
    labels : (T,) class of each, from 0; every class has a member.
    medoids : (classes,) timestep of each class that is the nearest to its centre in the spectral embedding.
    landmarks : timesteps that stood for all; T where all pairs were compared.
    radius : metres within which every face has a landmark; 0 where all pairs were compared.
    variant : "official" where the published behaviour was asked for.
    """

    timesteps: IntArray
    labels: IntArray
    medoids: IntArray
    landmarks: int
    radius: float
    variant: str = "paper"

    @property
    def by_timestep(self) -> dict[int, int]:
        """Class by timestep."""
        return dict(zip(self.timesteps.tolist(), self.labels.tolist()))

    def record(self) -> dict[str, Any]:
        """What a record of the step says."""
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

    Up to ``limit`` timesteps all pairs are compared. Beyond, farthest-point landmarks stand for all and the
    clustering is Nyström's (see `spectral`); memory then grows with T times ``limit`` and T times the size of a
    face, never with T squared. There are never more classes than distinct faces (landmarks, beyond ``limit``).

    Parameters
    ----------
    seed : decides the first landmark, or the random starts of "official"; all pairs without it need none.
    variant : "official" reproduces the published code: all pairs however many, k-means from ten random starts.
        It sees training timesteps alone, as the default does.

    Raises
    ------
    InputError
        Where the head has no region "face".
    """
    timesteps = np.array(sorted({key.timestep for key in clip.splits["train"]}))
    faces = expression_displacements(clip, timesteps.tolist())
    if len(faces) <= limit or variant == "official":
        distances = mean_vertex_distances(faces)
        labels, embedding = cluster_by_distance(distances, classes, seed=seed, variant=variant)
        landmarks, radius = len(faces), 0.0
    else:
        found = farthest_meshes(faces, limit, seed=seed, tolerance=LANDMARK_TOLERANCE, progress=progress)
        labels, embedding = cluster_by_landmarks(found.distances, found.indices, classes)
        landmarks, radius = len(found.indices), found.radius
    medoids = timesteps[_medoids(labels, embedding)]
    return ExpressionClusters(timesteps, labels, medoids, landmarks, radius, variant)


def cluster_by_distance(
    distances: FloatArray, classes: int, *, seed: int = 0, variant: Literal["paper", "official"] = "paper"
) -> tuple[IntArray, FloatArray]:
    """Spectral clustering of all pairs under the similarity 1 - d / max d.

    Parameters
    ----------
    distances : (N, N) symmetric, zero diagonal.
    classes : at most as many; fewer where there are fewer distinct items.

    Returns
    -------
    (N,) labels from 0, without empty classes, and the (N, c) embedding that they part.
    """
    largest = float(distances.max(initial=0.0))
    classes = min(classes, _distinct(distances, largest))
    if classes <= 1 or classes >= len(distances):
        return _trivial(len(distances), classes)
    similarity = similarities(distances, largest)
    embedding = exact_embedding(similarity, classes)
    if variant == "official":
        published = SpectralClustering(classes, affinity="precomputed", random_state=seed)
        labels = np.unique(published.fit_predict(similarity), return_inverse=True)[1].astype(np.int64)
        return labels, embedding
    return classes_of(embedding, classes), embedding


def cluster_by_landmarks(
    distances: FloatArray, landmarks: IntArray, classes: int
) -> tuple[IntArray, FloatArray]:
    """Spectral clustering from the distances to landmarks alone; results as of `cluster_by_distance`.

    Parameters
    ----------
    distances : (N, m) of each item to each landmark. Where the landmarks are farthest points, the largest of
        these is the largest of all, or within the landmarks' radius of it.
    landmarks : (m,) which items they are; distinct.
    """
    largest = float(distances.max(initial=0.0))
    classes = min(classes, _distinct(distances[landmarks], largest))
    if classes <= 1 or classes >= len(distances):
        return _trivial(len(distances), classes)
    embedding = nystrom_embedding(similarities(distances, largest), landmarks, classes)
    return classes_of(embedding, classes), embedding


def _distinct(distances: FloatArray, largest: float) -> int:
    """Number of distinct items, by their rows of distances."""
    return 1 if largest == 0 else len(np.unique(np.round(distances / largest, _DIGITS), axis=0))


def _trivial(count: int, classes: int) -> tuple[IntArray, FloatArray]:
    """All in one class, or each in its own."""
    labels = np.zeros(count, dtype=np.int64) if classes <= 1 else np.arange(count)
    return labels, labels[:, None].astype(np.float64)


def _medoids(labels: IntArray, embedding: FloatArray) -> IntArray:
    """(classes,) item of each class nearest to the mean of the class."""
    found = []
    for label in range(labels.max() + 1):
        members = np.flatnonzero(labels == label)
        points = embedding[members]
        found.append(members[np.square(points - points.mean(axis=0)).sum(axis=1).argmin()])
    return np.array(found)
