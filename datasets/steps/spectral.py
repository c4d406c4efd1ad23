"""Normalised spectral clustering: of all pairs, or of a few columns of the similarity matrix by Nyström's method.

Both embeddings are those of scikit-learn's `SpectralClustering` with a precomputed affinity: leading eigenvectors
of D^-1/2 (S - I) D^-1/2, each row divided by the square root of its degree. Von Luxburg, "A tutorial on spectral
clustering", Statistics and Computing 2007; Fowlkes, Belongie, Chung and Malik, "Spectral grouping using the
Nyström method", PAMI 2004.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import eigh
from scipy.sparse.linalg import LinearOperator, eigsh
from sklearn.cluster import AgglomerativeClustering, KMeans

from ...bench.contracts import FloatArray, IntArray

SIMILARITY_FLOOR = 1e-6
"""The farthest pair has similarity 0; the floor keeps a graph of few distinct items connected."""

START_LIMIT = 2000
"""Items from which classes start: a hierarchy takes memory by their number squared."""

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

    Parameters
    ----------
    columns : (N, m) similarity of each item to each landmark.
    landmarks : (m,) which items these are; m at least ``classes``.
    """
    block = columns[landmarks]
    values, vectors = eigh(0.5 * (block + block.T))
    kept = np.abs(values) > _RANK_TOLERANCE * np.abs(values).max()
    # S = factor diag(sign) factor^T
    factor = columns @ (vectors[:, kept] / np.sqrt(np.abs(values[kept])))
    sign = np.sign(values[kept])
    diagonal = np.square(factor) @ sign
    degree = factor @ (sign * factor.sum(axis=0)) - diagonal
    # Approximate degrees are positive in all but the strangest graphs; never below a single weakest link.
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
    start = np.unique(
        np.linspace(0, len(embedding) - 1, min(START_LIMIT, len(embedding))).round().astype(int)
    )
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
