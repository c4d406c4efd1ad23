"""The mesh stage: its start, its drawing, its losses, and that it learns a head."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Budget, no_progress
from headbench.datasets.head.geometry import vertex_normals
from headbench.methods.gha.mesh_head import DISC_RADIUS, DISC_THICKNESS, MeshHead, vertex_discs
from headbench.methods.gha.mesh_stage import mesh_stage
from headbench.methods.gha.mesh_training import MeshTraining, roughness, soft_overlap
from headbench.methods.gha.scene import scene_of
from headbench.methods.gha.signed_distance import TangentDistance, outer_vertices
from headbench.methods.gha.tetrahedra import marching_tetrahedra, tet_grid
from headbench.methods.shared.networks import encode

from .small import small_config


def sphere(spacing=0.15):
    grid = tet_grid(np.full(3, -1.2), np.full(3, 1.2), spacing)
    crossings = marching_tetrahedra(grid.vertices.norm(dim=1) - 1, grid.tets)
    return torch.nn.functional.normalize(crossings.interpolate(grid.vertices), dim=1), crossings.faces


def test_tangent_distance_is_the_distance_to_a_sphere():
    vertices, faces = (part.numpy() for part in sphere(0.08))
    distance = TangentDistance(vertices, faces, np.arange(len(vertices)))
    places = np.random.default_rng(0).uniform(-1.5, 1.5, (2000, 3))
    exact = np.linalg.norm(places, axis=1) - 1
    found = distance(places)
    assert np.abs(found - exact).max() < 0.06  # up to the spacing of the vertices
    clear = np.abs(exact) > 0.01
    assert (np.sign(found) == np.sign(exact))[clear].all()
    np.testing.assert_allclose(vertex_normals(vertices, faces), vertices, atol=0.05)


def test_discs_lie_in_the_surface_and_cover_its_area():
    vertices, faces = sphere()
    discs = vertex_discs(vertices, faces)
    turns = Rotation.from_quat(discs.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    assert (np.abs(np.einsum("ni,ni->n", turns[:, :, 2], vertices.numpy())) > 0.98).all()
    area = (discs.scales[:, 0] / DISC_RADIUS).square().sum().item()
    assert area == pytest.approx(4 * np.pi, rel=0.02)
    np.testing.assert_allclose(discs.scales[:, 2] / discs.scales[:, 0], DISC_THICKNESS, rtol=1e-5)
    assert torch.equal(discs.means, vertices)


def test_roughness_is_the_uniform_laplacian():
    vertices, faces = sphere(0.4)
    vertices = vertices.double() + 0.1 * torch.randn(
        vertices.shape, generator=torch.Generator().manual_seed(0)
    )
    neighbours = [set() for _ in vertices]
    for a, b, c in faces.tolist():
        for one, other in ((a, b), (b, c), (c, a)):
            neighbours[one].add(other)
            neighbours[other].add(one)
    laplacian = [vertices[sorted(near)].mean(0) - vertices[place] for place, near in enumerate(neighbours)]
    assert roughness(vertices, faces).item() == pytest.approx(torch.stack(laplacian).square().mean().item())


def test_soft_overlap_of_binary_masks_is_intersection_over_union():
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, 2, (2, 8, 9)).astype(bool)
    expected = (one & other).sum() / (one | other).sum()
    found = soft_overlap(torch.tensor(one).double(), torch.tensor(other).double())
    assert found.item() == pytest.approx(expected, abs=1e-6)
    nothing = torch.zeros(3, 3)
    assert soft_overlap(nothing, nothing).item() == 1


def test_the_surface_is_that_of_the_whole_grid(clip):
    """Evaluating only what the surface passes gives what evaluating everything gives."""
    scene = scene_of(clip, small_config(), "cpu", 0)
    head = MeshHead.of(small_config(), len(scene.expression_scale))
    training = MeshTraining(scene, head, fitted=True)
    weights = {name: training.optimiser[name].detach() for mlp in head.networks for name in mlp.shapes()}
    surface = head.surface(weights, training.grid)
    values = torch.tanh(head.geometry(weights, encode(training.grid.vertices)))
    crossings = marching_tetrahedra(values[:, 0], training.grid.tets)
    reach = 0.3 * training.grid.spacing
    whole = crossings.interpolate(training.grid.vertices + reach * torch.tanh(values[:, 1:4]))
    assert len(surface.vertices) == len(whole) > 100
    order = cKDTree(whole.numpy()).query(surface.vertices.numpy())
    assert order[0].max() < 1e-4
    np.testing.assert_allclose(surface.features, crossings.interpolate(values[:, 4:])[order[1]], atol=1e-3)


@pytest.mark.parametrize("start", ["mesh", "sphere"])
def test_the_start_is_what_it_was_asked_to_be(clip, start):
    config = small_config(start=start, start_steps=80, geometry_hidden=(32, 32))
    scene = scene_of(clip, config, "cpu", 0)
    head = MeshHead.of(config, len(scene.expression_scale))
    training = MeshTraining(scene, head, fitted=True)
    with torch.no_grad():
        surface = head.surface(training.optimiser, training.grid)
    if start == "sphere":
        assert (surface.vertices.norm(dim=1) - 1).abs().mean() < 0.1
    else:
        neutral = scene.driver.canonical(scene.driver.neutral)
        distance = cKDTree(surface.vertices.numpy()).query(neutral.numpy())[0]
        assert np.median(distance) < 0.2  # canonical units; the head is some 2 of them high


@pytest.mark.parametrize("masked", [True, False])
def test_images_are_masked_on_black_where_there_are_mattes(clip, masked):
    """As published; on another background than the clip's, for that to show."""
    key = clip.splits["train"][0]
    coverage, ground = clip.mask(key)[:, :, None] / 255, np.array([0.2, 0.6, 0.4])
    image = np.round(255 * (clip.image(key) / 255 - (1 - coverage) * (1 - ground))).clip(0, 255)
    other = replace(clip, images={**clip.images, key: image.astype(np.uint8)}, background=ground)
    if not masked:
        other = replace(other, masks=dict.fromkeys(clip.masks))
    config = small_config()
    scene = scene_of(other, config, "cpu", 0)
    training = MeshTraining(scene, MeshHead.of(config, len(scene.expression_scale)), fitted=False)
    _, found, mask, background = training._target(key)
    assert (mask is not None) == masked
    np.testing.assert_allclose(background, np.zeros(3) if masked else ground, atol=1e-6)
    expected = image / 255 - ((1 - coverage) * ground if masked else 0)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_mesh_stage_learns_shape_motion_and_colour(clip, tmp_path):
    """Its loss falls, landmarks follow the tracked mesh, and the image resembles the truth."""
    config = small_config(geometry_hidden=(32, 32), mesh_lr=6e-3, landmark_weight=300.0, at_rest=True)
    scene = scene_of(clip, config, "cpu", 0)
    head = MeshHead.of(config, len(scene.expression_scale))
    losses = []

    def record(done, total, note=""):
        if note:
            losses.append(float(note.split("loss ")[1].split(";")[0]))

    result = mesh_stage(scene, head, Budget(iterations=60), tmp_path, "run", record)
    assert losses[-1] < 0.5 * losses[0]
    again = mesh_stage(scene, head, Budget(iterations=60), tmp_path, "run", no_progress)
    assert all(torch.equal(result.tensors[name], again.tensors[name]) for name in result.tensors)
    rows = torch.as_tensor(scene.landmark_rows)
    tracked = scene.driver.unposed(scene.tracked)[0, rows]
    spacing = MeshTraining(scene, head, fitted=False).grid.spacing
    landmarks = result.tensors["landmarks"]
    with torch.no_grad():
        moved = head.expressed(result.tensors, landmarks, scene.signals[0].expression)
        moved = moved + head.landmark_offsets(result.tensors, landmarks, spacing)[1]
    still = scene.driver.canonical(scene.driver.neutral)[rows]
    assert (moved - tracked).square().mean() < 0.5 * (still - tracked).square().mean()


def test_what_lies_behind_the_skin_does_not_bound_the_head(head):
    vertices, faces = np.asarray(head.template, np.float64), np.asarray(head.faces)
    kept = set(outer_vertices(vertices, faces, head.regions).tolist())
    facing = vertex_normals(vertices, faces)[:, 2]
    for name in ("left_eyeball", "right_eyeball"):
        rows = np.asarray(head.regions[name])
        front = {int(row) for row in rows if facing[row] > 0.3}
        assert kept & set(rows.tolist()) == front
        assert 0 < len(front) < len(rows)
    for name in ("mouth_socket", "teeth"):
        assert not kept & set(np.asarray(head.regions.get(name, [])).tolist())
    assert kept >= set(np.asarray(head.regions["nose"]).tolist())
