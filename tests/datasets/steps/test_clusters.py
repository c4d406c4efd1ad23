"""Expression classes against constructed groups and the method of all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from sklearn.cluster import SpectralClustering
from sklearn.manifold import spectral_embedding
from sklearn.metrics import adjusted_rand_score

from headbench.bench.contracts import FrameKey
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.steps import clusters as module
from headbench.datasets.steps.clusters import (
    HALF_TURN,
    IDENTITY,
    classes_of,
    cluster_expressions,
    exact_embedding,
    expression_displacements,
    farthest_meshes,
    farthest_quaternions,
    jaw_bases,
    jaw_quaternions,
    jaw_weights,
    mean_vertex_distances,
    nystrom_embedding,
    similarities,
)
from headbench.methods.shared.threads import torch_threads

from .clips import make_clip, with_poses


def grouped_clip(train: int, groups: int, noise: float = 0.02):
    """Training poses around a few well separated expressions; returns the clip and the true groups."""
    base = make_clip(train, test=1)
    rng = np.random.default_rng(1)
    centres = 4 * np.linalg.qr(rng.normal(size=(8, 8)))[0][:groups]
    truth = rng.integers(0, groups, size=train + 1)
    wobble = noise * rng.normal(size=(train + 1, 8))
    still = {"jaw": lambda t: np.zeros(3), "eyes": lambda t: np.zeros(6)}
    return with_poses(base, expression=lambda t: centres[truth[t]] + wobble[t], **still), truth[:train]


def test_separate_groups_become_the_classes():
    clip, truth = grouped_clip(60, 4)
    clusters = cluster_expressions(clip, 4)
    assert clusters.timesteps.tolist() == list(range(60))
    assert adjusted_rand_score(truth, clusters.labels) == 1
    assert clusters.by_timestep[7] == clusters.labels[7]


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_landmarks_give_the_same_classes_without_all_pairs(monkeypatch, noise):
    clip, truth = grouped_clip(150, 4, noise)
    exact = cluster_expressions(clip, 4)
    shapes = []
    original = module.nystrom_embedding

    def spy(columns, *arguments):
        shapes.append(columns.shape)
        return original(columns, *arguments)

    def refuse(_):
        raise AssertionError("all pairs compared")

    monkeypatch.setattr(module, "nystrom_embedding", spy)
    monkeypatch.setattr(module, "mean_vertex_distances", refuse)
    approximate = cluster_expressions(clip, 4, limit=40)
    assert (
        adjusted_rand_score(exact.labels, approximate.labels) == 1 == adjusted_rand_score(truth, exact.labels)
    )
    assert approximate.landmarks <= 40
    assert shapes == ([(150, approximate.landmarks)] if noise else [(150, 4)])
    assert exact.landmarks == 150
    assert exact.radius == 0
    assert (approximate.radius > 0) == (noise > 0)


def test_published_behaviour_is_that_of_scikit_learn():
    clip = make_clip(50)
    distances = mean_vertex_distances(expression_displacements(clip, list(range(50)))).astype(float)
    expected = SpectralClustering(6, affinity="precomputed", random_state=5).fit_predict(
        np.maximum(1 - distances / distances.max(), 1e-6)
    )
    found = cluster_expressions(clip, 6, seed=5, limit=10, variant="official")  # all pairs nevertheless
    assert adjusted_rand_score(expected, found.labels) == 1
    assert found.record()["variant"] == "official"
    assert found.landmarks == 50


def test_medoids_are_members_near_their_groups_centres():
    clip, _ = grouped_clip(80, 4, noise=0.2)
    clusters = cluster_expressions(clip, 4)
    assert [clusters.by_timestep[t] for t in clusters.medoids.tolist()] == [0, 1, 2, 3]
    assert clusters.record()["class_sizes"] == np.bincount(clusters.labels).tolist()
    faces = expression_displacements(clip, list(range(80)))
    for label, medoid in enumerate(clusters.medoids):
        members = faces[clusters.labels == label]
        spread = [np.linalg.norm(face - members.mean(axis=0)) for face in members]
        assert np.linalg.norm(faces[medoid] - members.mean(axis=0)) <= np.median(spread)


def test_held_out_poses_do_not_matter():
    clip, _ = grouped_clip(40, 3)
    changed = with_poses(clip, expression=lambda t: clip.poses[t].expression if t < 40 else np.full(8, 9.0))
    np.testing.assert_array_equal(cluster_expressions(clip, 3).labels, cluster_expressions(changed, 3).labels)


@pytest.mark.parametrize(("train", "classes"), [(1, 1), (2, 2), (3, 3), (16, 16), (17, 16)])
def test_short_performances_have_no_more_classes_than_timesteps(train, classes):
    labels = cluster_expressions(make_clip(train)).labels
    assert len(set(labels.tolist())) == classes
    assert labels.min() == 0
    assert labels.max() == classes - 1


@pytest.mark.parametrize("limit", [5, 20])
@pytest.mark.parametrize("faces", [1, 2])
def test_no_more_classes_than_distinct_faces(limit, faces):
    still = {"jaw": lambda t: np.zeros(3), "eyes": lambda t: np.zeros(6)}
    clip = with_poses(make_clip(20), expression=lambda t: np.full(8, float(t % faces)), **still)
    labels = cluster_expressions(clip, limit=limit).labels
    assert len(set(labels)) == len({*zip(labels, np.arange(20) % faces)}) == faces


def random_meshes(count, vertices=7, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3, vertices)).astype(np.float32)


def brute_force(one, other):
    return np.linalg.norm(one[:, None].astype(float) - other[None].astype(float), axis=2).mean(axis=2)


def test_displacements_are_of_the_unposed_face_with_eyes_doubled():
    clip = make_clip(3)
    found = expression_displacements(clip, [0, 1, 2])
    subject = PosedSubject.of(clip)
    face, eyes = clip.head.regions["face"], set(clip.head.regions["eye_region"].tolist())
    assert 0 < len(eyes & set(face.tolist())) < len(face)
    still = with_poses(clip, **dict.fromkeys(("rotation", "neck", "translation"), lambda t: np.zeros(3)))
    moved = subject.meshes([still.poses[t] for t in range(3)]) - subject.neutral
    for column, vertex in enumerate(face):
        weight = 2 if int(vertex) in eyes else 1
        np.testing.assert_allclose(found[:, :, column], weight * moved[:, vertex], atol=2e-7)


@pytest.mark.parametrize("count", [1, 5, 16, 17, 130])
@pytest.mark.parametrize("threads", [1, 3])
def test_distances_equal_brute_force_across_blocks(count, threads):
    meshes = random_meshes(count)
    with torch_threads(threads):
        found = mean_vertex_distances(meshes)
        landmarks = farthest_meshes(meshes, count)
    np.testing.assert_allclose(found, brute_force(meshes, meshes), rtol=2e-6, atol=1e-7)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(
        landmarks.distances, brute_force(meshes, meshes[landmarks.indices]), rtol=2e-6, atol=1e-7
    )


def test_small_distances_keep_their_digits():
    """Neighbouring frames differ by micrometres, a millionth of a face's size."""
    mesh = random_meshes(1, 50) * np.float32(0.1)
    near = mesh + np.float32(1e-6) * np.array([1, 0, 0], np.float32)[:, None]
    expected = np.linalg.norm((near.astype(float) - mesh.astype(float))[0], axis=0).mean()
    np.testing.assert_allclose(mean_vertex_distances(np.vstack([mesh, near]))[0, 1], expected, rtol=1e-5)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 1000), count=st.integers(1, 40), limit=st.integers(1, 45))
def test_landmarks_are_the_farthest_points_by_definition(seed, count, limit):
    meshes = random_meshes(count, seed=seed)
    distances = mean_vertex_distances(meshes)
    found = farthest_meshes(meshes, limit, seed=seed)
    chosen = [int(found.indices[0])]
    while len(chosen) < min(limit, count):
        chosen.append(int(distances[chosen].min(axis=0).argmax()))
    assert found.indices.tolist() == chosen
    assert found.radius == distances[chosen].min(axis=0).max()
    assert len(set(chosen)) == len(chosen)
    assert chosen[0] == np.random.default_rng(seed).integers(count)


def test_landmarks_stop_at_the_tolerance_and_at_distinct_meshes():
    meshes = random_meshes(6)[np.arange(60) % 6]
    assert len(farthest_meshes(meshes, 50).indices) == 6
    assert farthest_meshes(meshes, 50).radius == 0
    meshes = random_meshes(400, 1) * np.float32(0.01)
    few = farthest_meshes(meshes, 400, tolerance=0.2)
    assert len(few.indices) < 100
    assert few.radius <= 0.2 * few.distances.max()
    fewer = farthest_meshes(meshes, len(few.indices) - 1, tolerance=0.2)
    assert fewer.radius > 0.2 * fewer.distances.max()


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


def test_classes_of_separate_blobs_and_no_empty_class():
    rng = np.random.default_rng(4)
    truth = rng.integers(0, 7, size=3000)  # more than the hierarchy is made of
    embedding = 5 * np.eye(7)[truth] + 0.1 * rng.normal(size=(3000, 7))
    labels = classes_of(embedding, 7)
    assert adjusted_rand_score(truth, labels) == 1
    assert sorted(set(labels.tolist())) == list(range(7))
    np.testing.assert_array_equal(labels, classes_of(embedding, 7))


seeds = st.integers(0, 2**32 - 1)


def unit_quaternions(count: int, seed: int) -> np.ndarray:
    quaternions = np.random.default_rng(seed).normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def brute_force_farthest(candidates, seed, count):
    """The definition, with loops: the candidate whose nearest chosen one is farthest."""
    chosen = [np.array(seed)]
    while len(chosen) < count:
        best = max(range(len(candidates)), key=lambda i: min(1 - abs(candidates[i] @ q) for q in chosen))
        chosen.append(candidates[best])
    return np.array(chosen)


@settings(deadline=None)
@given(seed=seeds, count=st.integers(1, 12))
def test_sampling_equals_brute_force(seed, count):
    candidates = unit_quaternions(40, seed)
    found = farthest_quaternions(candidates, IDENTITY, count)
    np.testing.assert_array_equal(found, brute_force_farthest(candidates, IDENTITY, count))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.1, np.pi])
def test_quaternion_of_a_jaw_opening_in_closed_form(angle):
    clip = with_poses(make_clip(1), jaw=lambda t: np.array([angle, 0, 0]))
    expected = [[np.cos(angle / 2), np.sin(angle / 2), 0, 0]]
    np.testing.assert_allclose(jaw_quaternions([clip.poses[0]]), expected, atol=1e-15)


def test_bases_are_identity_and_training_poses_alone():
    clip = make_clip(30, test=10)
    bases = jaw_bases(clip, 8)
    np.testing.assert_array_equal(bases[0], IDENTITY)
    train = jaw_quaternions([clip.poses[t] for t in range(30)])
    assert all((basis == train).all(axis=1).any() for basis in bases[1:])
    changed = with_poses(clip, jaw=lambda t: clip.poses[t].jaw if t < 30 else np.array([1.0, t, 0]))
    np.testing.assert_array_equal(jaw_bases(changed, 8), bases)


def test_no_more_bases_than_distinct_rotations():
    angles = np.radians([0.0, 0.1, 5.0, 5.1, 10.0])  # within a quarter of a degree there are three
    clip = with_poses(make_clip(50), jaw=lambda t: np.array([angles[t % 5], 0, 0]))
    bases = jaw_bases(clip, 16)
    assert len(bases) == 3
    np.testing.assert_allclose(sorted(2 * np.degrees(np.arccos(bases[:, 0]))), [0, 5, 10], atol=0.11)
    still = with_poses(make_clip(5), jaw=lambda t: np.zeros(3))
    np.testing.assert_array_equal(jaw_bases(still, 16), [IDENTITY])


def test_published_bases_are_held_out_poses_and_a_half_turn():
    clip = make_clip(10, test=0)
    cameras = [f"{i:02d}" for i in range(8)]  # every 16th frame is then every second timestep
    test = tuple(FrameKey("s", "q", t, c) for t in range(10, 14) for c in cameras)
    poses = make_clip(10, test=4).poses
    clip = clip.derive("test", {}, splits={**clip.splits, "self_reenactment": test}, poses=poses)
    bases = jaw_bases(clip, 13, variant="official")
    candidates = jaw_quaternions([poses[t] for t in [*range(10), 10, 12]])
    np.testing.assert_array_equal(bases, brute_force_farthest(candidates, HALF_TURN, 13))


@settings(deadline=None)
@given(quaternions=arrays(float, (7, 4), elements=st.floats(-1, 1)), seed=seeds)
def test_weights_are_the_formula_and_blind_to_sign(quaternions, seed):
    quaternions = quaternions + np.array([2.0, 0, 0, 0])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    bases = unit_quaternions(5, seed)
    weights = jaw_weights(quaternions, bases)
    for q, row in zip(quaternions, weights):
        likeness = [abs(float(np.dot(q, b))) for b in bases]
        np.testing.assert_allclose(row, np.array(likeness) / sum(likeness), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_array_equal(jaw_weights(-quaternions, bases), weights)
