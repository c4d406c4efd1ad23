"""Expression classes against constructed groups and the method of all pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sklearn.cluster import SpectralClustering
from sklearn.metrics import adjusted_rand_score

from headbench.datasets.steps import clusters as module
from headbench.datasets.steps.clusters import (
    cluster_by_distance,
    cluster_expressions,
    expression_displacements,
    mean_vertex_distances,
    similarities,
)
from headbench.datasets.synthetic.performance import HELD_OUT, perform, share_out
from headbench.datasets.synthetic.plan import load_geometry

from ..head.refit.heads import performance
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


def performed_clip(timesteps: int, seed: int):
    """Training timesteps as subjects of the synthetic capture perform them, with the noise of a tracking; without images."""
    geometry = load_geometry("procedural")
    rng = np.random.default_rng(seed)
    lengths = share_out(round(1.2 * timesteps) + 1)  # a sixth of a performance is held out
    poses = [
        geometry.translation.pose(moment, "s", 0)
        for name, count in lengths.items()
        if name != HELD_OUT
        for moment in perform(name, count, 100 * seed).activations
    ]
    clip = performance(geometry.head, timesteps)
    noisy = {
        t: replace(
            pose, timestep=t, expression=pose.expression + 0.02 * rng.standard_normal(len(pose.expression))
        )
        for t, pose in enumerate(poses[:timesteps])
    }
    return replace(clip, poses=noisy)


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


def test_landmarks_agree_better_than_two_published_runs():
    """300 performed timesteps, half of them landmarks; adjusted Rand index."""
    clip = performed_clip(300, 0)
    exact = cluster_expressions(clip)
    approximate = [cluster_expressions(clip, limit=150, seed=start) for start in range(2)]
    distances = mean_vertex_distances(expression_displacements(clip, list(range(300))))
    affinity = similarities(distances, distances.max())
    published = [
        SpectralClustering(16, affinity="precomputed", random_state=start).fit_predict(affinity)
        for start in range(3)
    ]
    own = [adjusted_rand_score(one, two) for i, one in enumerate(published) for two in published[:i]]
    ours = [adjusted_rand_score(exact.labels, other.labels) for other in approximate]
    assert np.mean(own) < 0.95  # else this compares nothing
    assert np.mean(ours) >= np.mean(own)


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


def test_chains_of_equal_mean_are_told_apart():
    """Two chains of equal mean: what spectral clustering is for."""
    distances = np.full((20, 20), 10.0)
    for start in (0, 10):
        index = np.arange(10)
        distances[start : start + 10, start : start + 10] = np.abs(index[:, None] - index) * 0.5
    labels, _ = cluster_by_distance(distances, 2)
    assert len(set(labels[:10])) == len(set(labels[10:])) == 1
    assert labels[0] != labels[10]


@pytest.mark.parametrize("limit", [5, 20])
@pytest.mark.parametrize("faces", [1, 2])
def test_no_more_classes_than_distinct_faces(limit, faces):
    still = {"jaw": lambda t: np.zeros(3), "eyes": lambda t: np.zeros(6)}
    clip = with_poses(make_clip(20), expression=lambda t: np.full(8, float(t % faces)), **still)
    labels = cluster_expressions(clip, limit=limit).labels
    assert len(set(labels)) == len({*zip(labels, np.arange(20) % faces)}) == faces


@pytest.mark.parametrize("seeds", [{"seed": 0, "limit": 20}, {"seed": 1}], ids=["landmarks", "all pairs"])
def test_the_same_seed_or_all_pairs_give_the_same_classes(seeds):
    clip = make_clip(50)
    one, other = (
        cluster_expressions(clip, 6, **{"seed": 0, **choice}) for choice in (seeds, {**seeds, "seed": 0})
    )
    np.testing.assert_array_equal(one.labels, other.labels)
