"""Spectral embeddings against scikit-learn, closed forms, and one another."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.manifold import spectral_embedding
from sklearn.metrics import adjusted_rand_score

from headbench.datasets.steps.clusters import classes_of, exact_embedding, nystrom_embedding, similarities


def similarity_of(points):
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    return similarities(distances, distances.max())


def projector(embedding, similarity):
    """Orthogonal projection onto the eigenvectors behind an embedding; blind to signs and mixed equal ones."""
    links = similarity - np.diag(np.diag(similarity))
    basis, _ = np.linalg.qr(embedding * np.sqrt(links.sum(axis=1))[:, None])
    return basis @ basis.T


@pytest.mark.parametrize("classes", [2, 5])
def test_exact_embedding_is_that_of_scikit_learn(classes):
    similarity = similarity_of(np.random.default_rng(0).normal(size=(60, 3)))
    ours = exact_embedding(similarity, classes)
    theirs = spectral_embedding(similarity, n_components=classes, drop_first=False, random_state=0)
    scale = np.linalg.norm(theirs, axis=0) / np.linalg.norm(ours, axis=0)
    sign = np.sign((ours * theirs).sum(axis=0))
    np.testing.assert_allclose(ours * scale * sign, theirs, atol=1e-8)


@pytest.mark.parametrize("count", [12, 90])
def test_nystrom_with_all_items_as_landmarks_is_exact(count):
    """Also where the similarity is not positive definite: a graph of chords."""
    rng = np.random.default_rng(1)
    distances = rng.uniform(0.2, 1, size=(count, count))
    distances = np.triu(distances, 1) + np.triu(distances, 1).T
    similarity = similarities(distances, 1.0)
    assert np.linalg.eigvalsh(similarity).min() < -0.1
    order = rng.permutation(count)
    found = nystrom_embedding(similarity[:, order], order, 4)
    np.testing.assert_allclose(
        projector(found, similarity), projector(exact_embedding(similarity, 4), similarity), atol=1e-7
    )
    values = exact_embedding(similarity, 4)
    np.testing.assert_allclose(found, values, atol=1e-7)


def test_nystrom_is_exact_for_copies_of_the_landmarks():
    """Items that repeat the landmarks add no rank, so that nothing is lost but the links among copies."""
    points = np.random.default_rng(2).normal(size=(15, 3))[np.arange(150) % 15]
    similarity = similarity_of(points)
    found = nystrom_embedding(similarity[:, :15], np.arange(15), 5)
    np.testing.assert_allclose(
        projector(found, similarity), projector(exact_embedding(similarity, 5), similarity), atol=1e-8
    )


def test_more_landmarks_bring_nystrom_nearer_the_exact_embedding():
    points = np.random.default_rng(3).normal(size=(200, 3))
    similarity = similarity_of(points)
    exact = projector(exact_embedding(similarity, 4), similarity)
    errors = []
    for count in (10, 40, 160):
        found = nystrom_embedding(similarity[:, :count], np.arange(count), 4)
        errors.append(np.linalg.norm(projector(found, similarity) - exact))
    assert errors[0] > 3 * errors[1] > 9 * errors[2]
    assert errors[2] < 0.02


def test_classes_of_separate_blobs_and_no_empty_class():
    rng = np.random.default_rng(4)
    truth = rng.integers(0, 7, size=3000)  # more than the hierarchy is made of
    embedding = 5 * np.eye(7)[truth] + 0.1 * rng.normal(size=(3000, 7))
    labels = classes_of(embedding, 7)
    assert adjusted_rand_score(truth, labels) == 1
    assert sorted(set(labels.tolist())) == list(range(7))
    np.testing.assert_array_equal(labels, classes_of(embedding, 7))


def test_similarity_is_linear_and_bounded_below():
    np.testing.assert_allclose(similarities(np.array([[0.0, 1.0, 2.0]]), 2.0), [[1, 0.5, 1e-6]])
