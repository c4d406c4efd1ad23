"""Expression classes against brute force and constructed groups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.metrics import adjusted_rand_score

from headbench.bench.errors import InputError
from headbench.datasets.head.model import HeadModel
from headbench.datasets.steps import expression_clusters as module
from headbench.datasets.steps.expression_clusters import (
    cluster_by_distance,
    cluster_expressions,
    expression_displacements,
    mean_vertex_distances,
)

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


def test_displacements_are_unposed_face_minus_neutral_with_eyes_doubled():
    clip = make_clip(3)
    found = expression_displacements(clip, [0, 1, 2])
    model = HeadModel(clip.head, dtype=torch.float64)
    shape, offset = torch.from_numpy(clip.shape), torch.from_numpy(clip.static_offset)
    zero = torch.zeros(3, dtype=torch.float64)
    face, eyes = clip.head.regions["face"], set(clip.head.regions["eye_region"].tolist())
    assert 0 < len(eyes & set(face.tolist())) < len(face)
    for t in range(3):
        parts = {n: torch.from_numpy(getattr(clip.poses[t], n)) for n in ("expression", "jaw", "eyes")}
        still = {n: torch.zeros_like(value) for n, value in parts.items()}
        common = {
            "shape": shape,
            "static_offset": offset,
            "rotation": zero,
            "neck": zero,
            "translation": zero,
        }
        difference = (model(**common, **parts) - model(**common, **still))[0].numpy()
        for column, vertex in enumerate(face):
            weight = 2 if int(vertex) in eyes else 1
            np.testing.assert_allclose(found[t, column], weight * difference[vertex], atol=2e-7)


def test_rigid_motion_does_not_matter():
    clip = make_clip(5)
    moved = with_poses(
        clip, rotation=lambda t: np.ones(3), neck=lambda t: np.ones(3), translation=lambda t: np.ones(3)
    )
    np.testing.assert_array_equal(
        expression_displacements(moved, [0, 3]), expression_displacements(clip, [0, 3])
    )


@pytest.mark.parametrize("counts", [(5, 4), (130, 300), (1, 1)])
def test_distances_equal_brute_force_across_blocks(counts):
    rng = np.random.default_rng(0)
    one, other = (rng.normal(size=(n, 7, 3)).astype(np.float32) for n in counts)
    expected = np.linalg.norm(one[:, None].astype(float) - other[None].astype(float), axis=3).mean(axis=2)
    np.testing.assert_allclose(mean_vertex_distances(one, other), expected, rtol=2e-6)
    within = mean_vertex_distances(one)
    np.testing.assert_allclose(
        within,
        np.linalg.norm(one[:, None].astype(float) - one[None], axis=3).mean(axis=2),
        rtol=2e-6,
        atol=1e-7,
    )
    np.testing.assert_array_equal(within, within.T)


def test_small_distances_keep_their_digits():
    """Neighbouring frames differ by micrometres, a millionth of a face's size."""
    mesh = np.random.default_rng(0).normal(size=(1, 50, 3)).astype(np.float32) * 0.1
    near = mesh + np.float32(1e-6) * np.array([1, 0, 0], np.float32)
    expected = np.linalg.norm((near.astype(float) - mesh.astype(float))[0], axis=1).mean()
    np.testing.assert_allclose(mean_vertex_distances(mesh, near)[0, 0], expected, rtol=1e-5)


def test_separate_groups_become_the_classes():
    clip, truth = grouped_clip(60, 4)
    clusters = cluster_expressions(clip, 4)
    assert clusters.timesteps.tolist() == list(range(60))
    assert adjusted_rand_score(truth, clusters.labels) == 1
    assert clusters.by_timestep[7] == clusters.labels[7]


def test_landmarks_give_the_same_classes_without_all_pairs(monkeypatch):
    clip, truth = grouped_clip(150, 4)
    exact = cluster_expressions(clip, 4)
    sizes = []
    original = module.mean_vertex_distances

    def spy(*meshes):
        result = original(*meshes)
        sizes.append(result.size)
        return result

    monkeypatch.setattr(module, "mean_vertex_distances", spy)
    approximate = cluster_expressions(clip, 4, limit=40)
    assert (
        adjusted_rand_score(exact.labels, approximate.labels) == 1 == adjusted_rand_score(truth, exact.labels)
    )
    assert max(sizes) <= max(40 * 40, module._ITEM_BLOCK * 40) < 150 * 150


def test_held_out_poses_do_not_matter():
    clip, _ = grouped_clip(40, 3)
    changed = with_poses(clip, expression=lambda t: clip.poses[t].expression if t < 40 else np.full(8, 9.0))
    np.testing.assert_array_equal(cluster_expressions(clip, 3).labels, cluster_expressions(changed, 3).labels)


def test_same_seed_same_classes():
    clip = make_clip(50)
    np.testing.assert_array_equal(
        cluster_expressions(clip, 6, seed=3).labels, cluster_expressions(clip, 6, seed=3).labels
    )


@pytest.mark.parametrize(("train", "classes"), [(1, 1), (2, 2), (3, 3), (16, 16), (17, 16)])
def test_short_performances_have_no_more_classes_than_timesteps(train, classes):
    labels = cluster_expressions(make_clip(train)).labels
    assert len(set(labels.tolist())) == classes
    assert labels.min() == 0
    assert labels.max() == classes - 1


def test_one_repeated_face_is_one_class():
    clip = with_poses(
        make_clip(20), expression=lambda t: np.ones(8), jaw=lambda t: np.zeros(3), eyes=lambda t: np.zeros(6)
    )
    assert not cluster_expressions(clip).labels.any()


def test_two_faces_are_two_classes_however_many_are_asked_for():
    still = {"jaw": lambda t: np.zeros(3), "eyes": lambda t: np.zeros(6)}
    clip = with_poses(make_clip(20), expression=lambda t: np.full(8, float(t % 2)), **still)
    labels = cluster_expressions(clip).labels
    assert set(labels[::2]) != set(labels[1::2])
    assert len(set(labels)) == 2


def test_spectral_clustering_tells_rings_apart_where_nearest_means_cannot():
    """Two chains of equal mean: what spectral clustering is for."""
    distances = np.full((20, 20), 10.0)
    for start in (0, 10):
        index = np.arange(10)
        distances[start : start + 10, start : start + 10] = np.abs(index[:, None] - index) * 0.5
    labels = cluster_by_distance(distances, 2)
    assert len(set(labels[:10])) == len(set(labels[10:])) == 1
    assert labels[0] != labels[10]


def test_head_without_a_face_region_is_refused():
    clip = make_clip(3)
    clip = replace(clip, head=replace(clip.head, regions={}))
    with pytest.raises(InputError, match=r"regions\[face\].*FLAME_masks.pkl"):
        cluster_expressions(clip)
