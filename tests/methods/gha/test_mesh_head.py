"""The mesh phase: its start, its drawing, its losses, and that it learns a head."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Budget, no_progress
from headbench.datasets.head.geometry import vertex_normals
from headbench.methods.gha.driving import training_scene
from headbench.methods.gha.gaussian_head import POINTS, FeatureImage, GaussianHead, SuperResolution
from headbench.methods.gha.mesh_head import (
    DISC_RADIUS,
    DISC_THICKNESS,
    MeshHead,
    Mlp,
    TetGrid,
    marching_tetrahedra,
    tet_grid,
    vertex_discs,
)
from headbench.methods.gha.mesh_training import (
    MeshTraining,
    TangentDistance,
    mesh_phase,
    outer_vertices,
    roughness,
    soft_overlap,
)
from headbench.methods.gha.spec import GHAConfig
from headbench.methods.ops.planes import encode
from headbench.methods.shared.loop import Fit

from .small import small_config

GROUND = torch.tensor([1.0, 0.5, 0.25], dtype=torch.float64)
PUBLISHED_EXPRESSION = 64  # coefficients of the published face model


def plain(mlp, weights, points, condition):
    """The layers one after the other on inputs side by side."""
    inputs = points
    if condition is not None:
        inputs = torch.cat([points, condition.expand(len(points), -1)], dim=1)
    values, count = inputs, len(mlp.widths) - 1
    for layer in range(count):
        if layer and layer == len(mlp.widths) // 2:
            values = torch.cat([values, inputs], dim=1)
        values = values @ weights[f"{mlp.name}.weight_{layer}"].t() + weights[f"{mlp.name}.bias_{layer}"]
        if layer < count - 1:
            values = torch.where(values > 0, values, 0.01 * values)
    return values


def test_paper_networks_have_the_published_sizes():
    def parameter_count(shapes):
        return sum(torch.Size(shape).numel() for shape in shapes.values())

    head = GaussianHead.of(GHAConfig(), PUBLISHED_EXPRESSION)
    assert [mlp.widths for mlp in head.controllers.of_gaussians] == [
        (192, 256, 256, 32),
        (182, 128, 32),
        (91, 256, 256, 256, 256, 256, 3),
        (81, 256, 256, 3),
        (192, 256, 256, 256, 8),
        (182, 128, 128, 8),
    ]
    mesh = MeshHead.of(GHAConfig(), PUBLISHED_EXPRESSION)
    assert mesh.geometry.widths == (27, 256, 256, 256, 256, 256, 132)
    controllers = sum(parameter_count(mlp.shapes()) for mlp in head.controllers.of_gaussians)
    assert controllers == 836_153
    assert parameter_count(head.super_resolution.shapes()) == pytest.approx(322_700, abs=50)
    assert 4 * (sum(POINTS.values()) + head.config.features) == 556  # bytes of a Gaussian
    assert head.config.upscale == 4


@given(
    sizes=st.tuples(st.integers(1, 5), st.integers(0, 4), st.integers(1, 3)),
    hidden=st.lists(st.integers(1, 7), max_size=5).map(tuple),
    seed=st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
def test_a_condition_once_is_a_condition_at_every_point(sizes, hidden, seed):
    points_size, condition_size, outputs = sizes
    mlp = Mlp("m", points_size, condition_size, hidden, outputs)
    generator = torch.Generator().manual_seed(seed)
    weights = {name: value.double() for name, value in mlp.initial(generator).items()}
    points = torch.randn(6, points_size, generator=generator, dtype=torch.float64)
    condition = (
        torch.randn(condition_size, generator=generator, dtype=torch.float64) if condition_size else None
    )
    expected = plain(mlp, weights, points, condition)
    assert torch.allclose(mlp(weights, points, condition), expected, atol=1e-12)
    assert torch.allclose(mlp(weights, points, condition, 1), expected[:, :1], atol=1e-12)
    if condition is not None:  # several at once are each on its own
        several = torch.stack([condition, 2 * condition, -condition])
        expected = torch.stack([plain(mlp, weights, points, one) for one in several])
        assert torch.allclose(mlp(weights, points, several), expected, atol=1e-12)


def test_network_gradients_agree_with_finite_differences():
    mlp = Mlp("m", 3, 2, (5, 4), 2)
    generator = torch.Generator().manual_seed(0)
    weights = {name: value.double().requires_grad_() for name, value in mlp.initial(generator).items()}
    points = torch.randn(4, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    condition = torch.randn(2, generator=generator, dtype=torch.float64, requires_grad=True)

    def run(points, condition, *tensors):
        return mlp(dict(zip(weights, tensors)), points, condition)

    assert torch.autograd.gradcheck(run, (points, condition, *weights.values()))


@pytest.mark.parametrize("widths", [(4,), (5, 3), (6, 4, 3)])
def test_super_resolution_is_torchs_layers(widths):
    network = SuperResolution(3, widths)
    generator = torch.Generator().manual_seed(2)
    weights = {name: value.double() for name, value in network.initial(generator, "cpu").items()}
    features = torch.randn(5, 7, 3, generator=generator, dtype=torch.float64)
    values = features.permute(2, 0, 1)[None]
    for block in range(len(widths)):
        if block:
            values = torch.nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True)(values)
        for layer in range(2):
            values = F.conv2d(values, weights[f"sr.conv_{block}_{layer}"], padding="same")
            values = torch.relu(torch.nn.InstanceNorm2d(values.shape[1])(values))
    expected = torch.sigmoid(F.conv2d(values, weights["sr.color"], weights["sr.color_bias"]))[0]
    alpha = torch.rand(5, 7, generator=generator, dtype=torch.float64)
    image = network(weights, FeatureImage(features, alpha), GROUND)
    assert image.shape == (5 * network.upscale, 7 * network.upscale, 3)
    assert torch.allclose(image, expected.permute(1, 2, 0), atol=1e-10)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 7),
    st.integers(1, 6),
    st.sampled_from([(4,), (5, 3), (6, 4, 3)]),
    st.booleans(),
    st.integers(0, 200),
)
def test_super_resolution_in_strips_is_that_of_the_whole_image(height, width, widths, residual, at_once):
    network = SuperResolution(3, widths, residual)
    generator = torch.Generator().manual_seed(7)
    weights = {
        name: torch.randn(shape, generator=generator, dtype=torch.float64)
        for name, shape in network.shapes().items()
    }
    features = torch.randn(height, width, 3, generator=generator, dtype=torch.float64)
    alpha = torch.rand(height, width, generator=generator, dtype=torch.float64)
    drawn = FeatureImage(features, alpha)
    expected = network(weights, drawn, GROUND)
    found = network.bounded(weights, drawn, GROUND, at_once)
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("widths", [(4,), (5, 3)])
def test_a_residual_starts_as_the_splatted_colours(widths):
    network = SuperResolution(6, widths, residual=True)
    generator = torch.Generator().manual_seed(4)
    weights = network.initial(generator, "cpu")
    features = torch.rand(4, 5, 6, generator=generator)
    alpha = torch.zeros(4, 5)
    planes = features[None, ..., :3].permute(0, 3, 1, 2)
    plain = torch.nn.Upsample(scale_factor=network.upscale, mode="bilinear")(planes)[0].permute(1, 2, 0)
    drawn = FeatureImage(features, torch.ones(4, 5))
    assert torch.equal(network(weights, drawn, GROUND.float()), plain)
    weights["sr.color_bias"] += 0.3
    alpha[:, 4] = 1
    image = network(weights, FeatureImage(features, alpha), GROUND.float())
    empty, clear = (
        slice(first * network.upscale, last * network.upscale) for first, last in ((0, 2), (2, 3))
    )
    assert (image[:, empty] == GROUND.float()).all()  # nothing is drawn near
    assert torch.equal(image[:, clear], plain[:, clear])
    assert (image[:, -1] != plain[:, -1]).all()


def test_zero_initialised_networks_ignore_the_condition():
    generator = torch.Generator().manual_seed(5)
    points = torch.randn(6, 3, generator=generator)
    one, other = torch.randn(2, 4, generator=generator)
    for hidden in ((), (5,), (5, 6, 7)):
        default, zeroed = (Mlp("m", 3, 4, hidden, 2, zero_condition_weights=zero) for zero in (False, True))
        weights = zeroed.initial(torch.Generator().manual_seed(6))
        assert torch.equal(zeroed(weights, points, one), zeroed(weights, points, other))
        weights = default.initial(torch.Generator().manual_seed(6))
        assert not torch.equal(default(weights, points, one), default(weights, points, other))
        resting = Mlp("m", 3, 4, hidden, 2, zero_initialised=True)
        weights = resting.initial(torch.Generator().manual_seed(6))
        assert torch.equal(resting(weights, points, one), torch.zeros(6, 2))


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


def begun(clip, config, *, fitted):
    """Scene, head and training of the mesh phase."""
    scene = training_scene(clip, config, "cpu", 0)
    head = MeshHead.of(config, len(scene.expression_scale))
    return scene, head, MeshTraining(scene, head, fitted=fitted)


def test_the_surface_is_that_of_the_whole_grid(clip):
    """Evaluating only what the surface passes gives what evaluating everything gives."""
    _, head, training = begun(clip, small_config(), fitted=True)
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
    scene, head, training = begun(clip, config, fitted=True)
    with torch.no_grad():
        surface = head.surface(training.optimiser, training.grid)
    if start == "sphere":
        assert (surface.vertices.norm(dim=1) - 1).abs().mean() < 0.1
    else:
        neutral = scene.driver.canonical(scene.driver.neutral)
        distance = cKDTree(surface.vertices.numpy()).query(neutral.numpy())[0]
        assert np.median(distance) < 0.2  # canonical units; the head is some 2 of them high


@pytest.mark.parametrize("masked", [True, False])
def test_images_are_masked_on_black_where_there_are_masks(clip, masked):
    """As published; on another background than the clip's, for that to show."""
    key = clip.splits["train"][0]
    coverage, ground = clip.mask(key)[:, :, None] / 255, np.array([0.2, 0.6, 0.4])
    image = np.round(255 * (clip.image(key) / 255 - (1 - coverage) * (1 - ground))).clip(0, 255)
    other = replace(clip, images={**clip.images, key: image.astype(np.uint8)}, background=ground)
    if not masked:
        other = replace(other, masks=dict.fromkeys(clip.masks))
    _, _, training = begun(other, small_config(), fitted=False)
    _, found, mask, background = training._target(key)
    assert (mask is not None) == masked
    np.testing.assert_allclose(background, np.zeros(3) if masked else ground, atol=1e-6)
    expected = image / 255 - ((1 - coverage) * ground if masked else 0)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_mesh_phase_learns_shape_motion_and_colour(clip, tmp_path):
    """Its loss falls, landmarks follow the tracked mesh, and the image resembles the truth."""
    config = small_config(
        geometry_hidden=(32, 32), mesh_lr=6e-3, landmark_weight=300.0, zero_initialised=True
    )
    scene, head, untrained = begun(clip, config, fitted=False)
    losses = []

    def record(done, total, note=""):
        if note:
            losses.append(float(note.split("loss ")[1].split(";")[0]))

    fit = Fit(clip, tmp_path, Budget(iterations=60), "cpu", 0, record, "run")
    result = mesh_phase(scene, head, fit)
    assert losses[-1] < 0.5 * losses[0]
    again = mesh_phase(scene, head, replace(fit, progress=no_progress))
    assert all(torch.equal(result.tensors[name], again.tensors[name]) for name in result.tensors)
    rows = torch.as_tensor(scene.landmark_rows)
    tracked = scene.driver.unposed(scene.tracked)[0, rows]
    spacing = untrained.grid.spacing
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


def box(half=1.3, spacing=0.1):
    return tet_grid(np.full(3, -half), np.full(3, half), spacing)


def surface(grid: TetGrid, distance: torch.Tensor):
    crossings = marching_tetrahedra(distance, grid.tets)
    return crossings.interpolate(grid.vertices.to(distance.dtype)), crossings.faces


def area_and_volume(vertices, faces):
    corners = vertices.double()[faces]
    across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across.norm(dim=1).sum().item() / 2, (corners[:, 0] * across).sum().item() / 6


def ellipsoid_area(a, b, c):
    """Integral of |dx/du x dx/dv| over the unit sphere's angles."""

    def density(v, u):
        s, k = np.sin(u), np.cos(u)
        across = np.array([b * c * s * s * np.cos(v), a * c * s * s * np.sin(v), a * b * s * k])
        return np.linalg.norm(across)

    return dblquad(density, 0, np.pi, 0, 2 * np.pi, epsabs=1e-4)[0]


def test_the_tetrahedra_fill_the_box_without_overlap():
    grid = tet_grid(np.zeros(3), np.array([0.5, 0.7, 0.3]), 0.1)
    corners = grid.vertices.double()[grid.tets]
    volumes = torch.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert volumes.min() > 0
    assert volumes.sum().item() == pytest.approx(0.5 * 0.7 * 0.3, rel=1e-6)
    # Within the box each triangle belongs to two tetrahedra, on its sides to one: no gaps, nothing twice.
    triangles = torch.cat([grid.tets[:, [i for i in range(4) if i != k]] for k in range(4)]).sort(1).values
    places, counts = torch.unique(triangles, dim=0, return_counts=True)
    assert set(counts.tolist()) == {1, 2}
    single = grid.vertices[places[counts == 1]]
    high = torch.tensor([0.5, 0.7, 0.3])
    on_side = ((single == 0) | ((single - high).abs() < 1e-6)).all(1).any(1)
    assert on_side.all()


@settings(max_examples=4, deadline=None)
@given(st.tuples(*[st.floats(0.5, 1.2)] * 3), st.tuples(*[st.floats(-0.05, 0.05)] * 3))
def test_ellipsoids_have_their_area_and_volume(axes, center):
    grid = box(spacing=0.08)
    scaled = (grid.vertices.double() - torch.tensor(center)) / torch.tensor(axes)
    area, volume = area_and_volume(*surface(grid, scaled.norm(dim=1) - 1))
    assert volume == pytest.approx(4 / 3 * np.pi * np.prod(axes), rel=0.015)
    assert area == pytest.approx(ellipsoid_area(*axes), rel=0.015)


def test_a_closed_surface_is_watertight_and_turned_outwards():
    grid = box()
    generator = torch.Generator().manual_seed(0)
    rough = grid.vertices.norm(dim=1) - 0.9 + 0.1 * torch.randn(len(grid.vertices), generator=generator)
    rough[(grid.vertices.abs() > 1.25).any(1)] = 1
    vertices, faces = surface(grid, rough)
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = set(map(tuple, edges.tolist()))
    assert len(forward) == len(edges)  # no directed edge twice
    assert forward == {(b, a) for a, b in forward}  # each has its opposite
    assert area_and_volume(vertices, faces)[1] > 0
    assert torch.equal(faces.unique(), torch.arange(len(vertices)))


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.floats(-0.5, 0.5))
@settings(max_examples=20, deadline=None)
def test_a_plane_is_exact(normal, shift):
    direction = torch.tensor(normal, dtype=torch.float64)
    assume(direction.norm() >= 0.1)
    direction = direction / direction.norm()
    grid = box(1.0, 0.25)
    vertices, _ = surface(grid, grid.vertices.double() @ direction - shift)
    assert (vertices @ direction - shift).abs().max() < 1e-9


def test_gradients_by_the_signed_distances():
    grid = tet_grid(np.full(3, -1.0), np.full(3, 1.0), 0.5)
    places = grid.vertices.double()
    distance = (places * torch.tensor([1.0, 1.1, 0.9])).norm(dim=1) - 0.71

    def vertices(values):
        return marching_tetrahedra(values, grid.tets).interpolate(places)

    assert torch.autograd.gradcheck(vertices, distance.requires_grad_(), eps=1e-6)
