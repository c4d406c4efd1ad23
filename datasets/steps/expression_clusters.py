"""Expression classes of a performance, so that rare expressions are trained on as often as common ones.

"3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations"
(CVPR 2025, arXiv 2504.14967), class-balanced sampling: spectral clustering of the unposed training meshes
under the mean vertex distance of the face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from sklearn.cluster import SpectralClustering

from ...bench.contracts import Clip, FloatArray, HeadAsset, IntArray
from ...bench.errors import InputError
from ..head.model import HeadModel

FACE_REGION, EYE_REGION = "face", "eye_region"
EYE_WEIGHT = 2.0
DEFAULT_CLASSES = 16
EXACT_LIMIT = 2000
"""Timesteps up to which all pairs are compared; beyond, as many landmarks stand for the rest."""

SIMILARITY_FLOOR = 1e-6

_MESH_BATCH = 64
_COLUMN_BLOCK = 16
_ITEM_BLOCK = 128


@dataclass(frozen=True, eq=False)
class ExpressionClusters:
    """Class of each training timestep.

    Attributes
    ----------
    timesteps : (T,) sorted training timesteps.
    labels : (T,) class of each, from 0; every class has a member.
    """

    timesteps: IntArray
    labels: IntArray

    @property
    def by_timestep(self) -> dict[int, int]:
        """Class by timestep."""
        return dict(zip(self.timesteps.tolist(), self.labels.tolist()))


def cluster_expressions(
    clip: Clip, classes: int = DEFAULT_CLASSES, *, seed: int = 0, limit: int = EXACT_LIMIT
) -> ExpressionClusters:
    """Cluster the training timesteps of a clip by the shape of the face.

    Up to ``limit`` timesteps the clustering is the published one. Beyond, ``limit`` timesteps spread evenly
    over time are clustered so, and each of the others joins the class of the one nearest to it; memory then
    grows with ``limit`` squared and with T times the size of a face, never with T squared.

    There are never more classes than distinct faces.

    Raises `InputError` where the head has no region "face".
    """
    timesteps = np.array(sorted({key.timestep for key in clip.splits["train"]}))
    faces = expression_displacements(clip, timesteps.tolist())
    landmarks = np.unique(np.linspace(0, len(faces) - 1, min(limit, len(faces))).round().astype(int))
    distances = mean_vertex_distances(faces[landmarks])
    labels = cluster_by_distance(distances, classes, seed=seed)
    if len(landmarks) < len(faces):
        labels = labels[_nearest(faces, faces[landmarks])]
    return ExpressionClusters(timesteps, labels)


def expression_displacements(clip: Clip, timesteps: Sequence[int]) -> FloatArray:
    """(T, F, 3) float32 displacements of the face's F vertices from the neutral face, metres.

    Meshes keep jaw, eyes and expression and lose rotation, neck and translation; vertices of the eye region
    count `EYE_WEIGHT` times.
    """
    vertices, weights = _face_vertices(clip.head)
    model = HeadModel(clip.head)
    canonical = model.canonical(_tensor(clip.shape), _tensor(clip.static_offset))
    neutral = canonical[:, vertices]
    result = np.empty((len(timesteps), len(vertices), 3), dtype=np.float32)
    for start in range(0, len(timesteps), _MESH_BATCH):
        part = slice(start, start + _MESH_BATCH)
        arguments = model.pose_arguments([clip.poses[timestep] for timestep in timesteps[part]])
        for name in ("rotation", "neck", "translation"):
            arguments[name] = torch.zeros_like(arguments[name])
        with torch.no_grad():
            meshes = model(canonical=canonical, **arguments)[:, vertices]
            result[part] = ((meshes - neutral) * weights[:, None]).numpy()
    return result


def mean_vertex_distances(one: FloatArray, other: FloatArray | None = None) -> FloatArray:
    """(N, M) mean over vertices of the Euclidean distance between (N, F, 3) and (M, F, 3) meshes, metres.

    Without ``other``: among ``one``, each pair once. Besides the result and the inputs it holds the squared
    distances of `_COLUMN_BLOCK` meshes to one, few enough to stay in the processor's cache.
    """
    rows = _components(one)
    columns = rows if other is None else _components(other)
    result = np.zeros((rows.shape[1], columns.shape[1]), dtype=np.float32)
    for start in range(0, columns.shape[1], _COLUMN_BLOCK):
        block = columns[:, start : start + _COLUMN_BLOCK]
        squared, part = np.empty_like(block[0]), np.empty_like(block[0])
        last = rows.shape[1] if other is not None else min(start + _COLUMN_BLOCK, rows.shape[1])
        for row in range(last):
            # Differences first: the product form |a|^2 - 2ab + |b|^2 loses what sets neighbouring frames apart.
            np.square(np.subtract(block[0], rows[0, row], out=squared), out=squared)
            for axis in (1, 2):
                np.square(np.subtract(block[axis], rows[axis, row], out=part), out=part)
                squared += part
            result[row, start : start + _COLUMN_BLOCK] = np.sqrt(squared, out=squared).mean(axis=1)
    if other is None:
        upper = np.triu(result, 1)
        result = upper + upper.T
    return result


def cluster_by_distance(distances: FloatArray, classes: int, *, seed: int = 0) -> IntArray:
    """Spectral clustering under the similarity 1 - d / max d; (N,) labels from 0, without empty classes.

    Parameters
    ----------
    distances : (N, N) symmetric, zero diagonal.
    classes : at most as many; fewer where there are fewer distinct items.
    """
    largest = float(distances.max(initial=0.0))
    distinct = 1 if largest == 0 else len(np.unique(np.round(distances / largest, 6), axis=0))
    classes = min(classes, distinct)
    if classes <= 1:
        return np.zeros(len(distances), dtype=np.int64)
    similarity = 1 - distances.astype(np.float64) / largest
    # The farthest pair has similarity 0; the floor keeps a graph of few distinct faces connected.
    similarity = np.maximum(0.5 * (similarity + similarity.T), SIMILARITY_FLOOR)
    if classes >= len(distances):
        return np.arange(len(distances))
    spectral = SpectralClustering(classes, affinity="precomputed", random_state=seed)
    _, labels = np.unique(spectral.fit_predict(similarity), return_inverse=True)
    return labels.astype(np.int64)


def _face_vertices(head: HeadAsset) -> tuple[IntArray, torch.Tensor]:
    """Face vertices and their weights."""
    face = head.regions.get(FACE_REGION)
    if face is None or not len(face):
        known = ", ".join(sorted(head.regions)) or "none"
        raise InputError(
            f"head model {head.version}",
            f"regions[{FACE_REGION}]",
            "the face's vertices",
            f"regions {known}",
            "For FLAME, give FLAME_masks.pkl as masks=.",
        )
    eyes = np.isin(face, head.regions.get(EYE_REGION, np.array([], dtype=int)))
    return face, torch.from_numpy(np.where(eyes, EYE_WEIGHT, 1.0).astype(np.float32))


def _nearest(items: FloatArray, landmarks: FloatArray) -> IntArray:
    """(N,) index of the landmark nearest to each item, a block of items at a time."""
    parts = [
        mean_vertex_distances(items[start : start + _ITEM_BLOCK], landmarks).argmin(axis=1)
        for start in range(0, len(items), _ITEM_BLOCK)
    ]
    return np.concatenate(parts)


def _components(meshes: FloatArray) -> FloatArray:
    """(3, N, F) contiguous float32 of (N, F, 3)."""
    return np.ascontiguousarray(np.moveaxis(meshes, 2, 0), dtype=np.float32)


def _tensor(array: FloatArray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float32))
