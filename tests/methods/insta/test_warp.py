"""The warp: what rigid motion and growth must do to it, and its parts against plain loops."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.methods.insta.warp import (
    Blend,
    blended,
    canonical_from_posed,
    edge_neighbours,
    touching,
    triangle_bases,
)

from ...datasets.head.toy import toy_head


@pytest.fixture(scope="module")
def head():
    return toy_head(16)


def pieces(head):
    return torch.from_numpy(head.template), torch.from_numpy(np.asarray(head.faces, dtype=np.int64))


def carried(points, triangles, matrices, vertices, faces, blend):
    transform = blended(points, triangles, matrices, vertices[faces].mean(1), blend)
    return (transform[:, :, :3] @ points[..., None])[..., 0] + transform[:, :, 3]


@pytest.mark.parametrize("compatibility", ["", "code"])
def test_a_rigid_motion_is_undone_everywhere(head, compatibility):
    vertices, faces = pieces(head)
    turn = axis_angle_to_matrix(torch.tensor([0.4, -1.0, 0.3], dtype=torch.float64))
    shift = torch.tensor([0.1, 0.2, -0.3], dtype=torch.float64)
    posed = vertices @ turn.T + shift
    blend = Blend.of(head, compatibility)
    matrices = canonical_from_posed(vertices, posed, faces, blend)
    generator = torch.Generator().manual_seed(0)
    canonical = torch.randn(300, 3, generator=generator, dtype=torch.float64) * 0.1
    triangles = torch.randint(len(faces), (300,), generator=generator)
    back = carried(canonical @ turn.T + shift, triangles, matrices, posed, faces, blend)
    torch.testing.assert_close(back, canonical, atol=1e-12, rtol=0)


def test_a_grown_head_is_shrunk(head):
    vertices, faces = pieces(head)
    blend = Blend.of(head, "")
    matrices = canonical_from_posed(vertices, 1.3 * vertices, faces, blend)
    points = vertices[faces].mean(1) * 1.7
    back = carried(points, torch.arange(len(faces)), matrices, 1.3 * vertices, faces, blend)
    torch.testing.assert_close(back, points / 1.3, atol=1e-10, rtol=0)


def test_the_code_scales_the_eye_region_alone_and_by_the_ratio_of_areas(head):
    vertices, faces = pieces(head)
    matrices = canonical_from_posed(vertices, 1.3 * vertices, faces, Blend.of(head, "code"))
    scales = torch.linalg.det(matrices[:, :, :3]).pow(1 / 3)
    apart = touching(head, "lips") | touching(head, "left_ear") | touching(head, "right_ear")
    eyes = torch.from_numpy(touching(head, "eye_region") & ~apart)
    assert eyes.any()
    torch.testing.assert_close(scales[eyes], torch.full_like(scales[eyes], 1.3**-2))
    torch.testing.assert_close(scales[~eyes], torch.ones_like(scales[~eyes]))


def test_frames_are_rotations_with_the_normal_last(head):
    vertices, faces = pieces(head)
    bases = triangle_bases(vertices, faces)
    turns = bases[:, :, :3]
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).double().expand_as(turns), atol=1e-10, rtol=0)
    assert (torch.linalg.det(turns) > 0).all()
    corners = vertices[faces]
    edge = torch.nn.functional.normalize(corners[:, 1] - corners[:, 0], dim=1)
    torch.testing.assert_close(turns[:, :, 0], -edge, atol=1e-10, rtol=0)
    assert ((corners[:, 2] - corners[:, 0]) * turns[:, :, 2]).sum(1).abs().max() < 1e-10


def test_neighbours_are_those_that_share_an_edge(head):
    faces = np.asarray(head.faces)
    neighbours = edge_neighbours(faces)
    sets = [set(face) for face in faces]
    for number in range(0, len(faces), 17):
        for side, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
            edge = {faces[number][a], faces[number][b]}
            sharing = [other for other, own in enumerate(sets) if edge <= own and other != number]
            assert neighbours[number, side] in (sharing or [-1])


def test_a_border_and_a_fan_of_three():
    assert edge_neighbours(np.array([[0, 1, 2]])).tolist() == [[-1, -1, -1]]
    # Three triangles on the edge 0-1: each has the next one as its neighbour there.
    fan = edge_neighbours(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert fan[:, 0].tolist() == [1, 2, 0]


def test_the_mean_of_transforms_is_weighted_by_distance(head):
    vertices, faces = pieces(head)
    blend = Blend.of(head, "")
    rng = np.random.default_rng(0)
    matrices = torch.from_numpy(rng.normal(size=(len(faces), 3, 4)))
    centroids = vertices[faces].mean(1)
    point, triangle = centroids[40] + 0.02, 40
    total, weights = torch.zeros(3, 4, dtype=torch.float64), 0.0
    for face in (triangle, *(int(f) for f in blend.neighbours[triangle] if f >= 0)):
        weight = np.exp(-4 * np.linalg.norm((point - centroids[face]).numpy()))
        total, weights = total + weight * matrices[face], weights + weight
    found = blended(point[None], torch.tensor([triangle]), matrices, centroids, blend)[0]
    torch.testing.assert_close(found, total / weights)


def test_collapsed_triangles_stay_finite(head):
    vertices, faces = pieces(head)
    for blend in (Blend.of(head, ""), replace(Blend.of(head, ""), root=False)):
        matrices = canonical_from_posed(vertices, torch.zeros_like(vertices), faces, blend)
        assert torch.isfinite(matrices).all()
