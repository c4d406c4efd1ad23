"""The CPU shim: its rasteriser against the float64 reference and a closed form, and what it does to a script."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from headbench.datasets.head.rotations import axis_angle_to_matrix
from headbench.methods.insta.marching import squared_distances
from headbench.methods.official.method import LAUNCHER
from headbench.methods.official.shim import blendshapes as shim
from headbench.methods.official.shim.blendshapes import SMALLEST_AREA, Mesh, load_obj, rasterize_meshes
from headbench.methods.official.shim.cpu import (
    GaussianRasterizationSettings,
    GaussianRasterizer,
    mean_square_distances,
)
from headbench.methods.ops.planes import harmonic_colors, sh_basis
from headbench.methods.shared.surface_points import texel_points
from headbench.methods.splats import rasterize


def draw(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_turned_harmonics_have_the_values_of_before():
    rotations = axis_angle_to_matrix(draw(5, 3))
    coefficients = draw(5, 16, 3, seed=1).requires_grad_()
    turned = shim.rotate_harmonics(rotations, coefficients)
    directions = torch.nn.functional.normalize(draw(5, 3, seed=2), dim=1)
    seen = torch.einsum("pk,pkc->pc", sh_basis(torch.einsum("pij,pj->pi", rotations, directions), 3), turned)
    before = torch.einsum("pk,pkc->pc", sh_basis(directions, 3), coefficients)
    assert torch.allclose(seen, before, atol=1e-12)
    # Turning keeps each degree's length, so the gradient of half the squared length is the coefficients.
    (0.5 * turned.square().sum()).backward()
    assert torch.allclose(coefficients.grad, coefficients, atol=1e-12)
    for degree in range(4):
        part = slice(degree**2, (degree + 1) ** 2)
        assert torch.allclose(turned[:, part].norm(dim=1), coefficients[:, part].norm(dim=1), atol=1e-12)


@pytest.mark.parametrize("shape", [(4,), (4, 3), (4, 16, 3)])
@pytest.mark.parametrize(("initial", "mask"), [(True, True), (False, True), (True, False), (False, False)])
def test_blended_expressions_and_their_gradients(shape, initial, mask):
    points, count = shape[0], 7
    mean, basis = draw(*shape).requires_grad_(), draw(*shape, count, seed=1).requires_grad_()
    coefficients = draw(count, seed=2)
    added = draw(*shape, count, seed=3) if initial else None
    weights = draw(points, count, seed=4).abs() if mask else None
    found = shim.composite_blendshape(mean, basis, coefficients, added, weights)
    spread = (weights if mask else torch.ones(points, count)).reshape(points, *[1] * (len(shape) - 1), count)
    expected = mean + (((added if initial else 0.0) + basis * spread) * coefficients).sum(-1)
    assert torch.allclose(found, expected)
    outer = draw(*shape, seed=5)
    gradients = [torch.autograd.grad((value * outer).sum(), (mean, basis)) for value in (found, expected)]
    for one, other in zip(*gradients):
        assert torch.allclose(one, other)


def test_inverses_and_their_gradients():
    matrices = (torch.eye(3, dtype=torch.float64) + 0.2 * draw(6, 3, 3)).requires_grad_()
    found, expected = shim.inverse(matrices), torch.linalg.inv(matrices)
    assert torch.allclose(found, expected)
    outer = draw(6, 3, 3, seed=1)
    gradients = [torch.autograd.grad((value * outer).sum(), matrices)[0] for value in (found, expected)]
    assert torch.allclose(*gradients)


@pytest.mark.parametrize("decay", [0.0, 0.01])
def test_adam_is_torch_s(decay):
    known = torch.nn.Parameter(draw(20))
    own, mean, square = known.detach().clone(), torch.zeros(20).double(), torch.zeros(20).double()
    optimiser = torch.optim.Adam([known], lr=0.01, betas=(0.9, 0.999), eps=1e-15, weight_decay=decay)
    for step in range(1, 6):
        known.grad = draw(20, seed=step)
        optimiser.step()
        corrections = 1 - 0.9**step, math.sqrt(1 - 0.999**step)
        rate = 0.01 / corrections[0]
        shim.adam_update(0.9, 0.999, *corrections, rate, 1e-15, decay, own, known.grad.clone(), mean, square)
    assert torch.allclose(own, known.detach(), rtol=1e-12)


@pytest.fixture
def octahedron():
    vertices = 0.05 * torch.cat([torch.eye(3), -torch.eye(3)])
    faces = [[x, y, z] for x in (0, 3) for y in (1, 4) for z in (2, 5)]
    return vertices, torch.tensor(faces, dtype=torch.int32)


def test_nearest_triangles_are_those_of_brute_force(octahedron):
    vertices, faces = octahedron
    points = 0.05 * torch.nn.functional.normalize(draw(200, 3, dtype=torch.float32), dim=1)
    found = shim.nearest_triangles(vertices, faces, points, 16)
    near = (points[:, None] - vertices).norm(dim=2).min(1).values < shim.FAR
    assert 20 < near.sum() < 180
    squared = squared_distances(points, vertices[faces.long()])
    own = squared.gather(1, found.long()[:, None])[:, 0]
    assert torch.allclose(own[near], squared.min(1).values[near], atol=1e-9)
    # Far away it is a triangle of the nearest vertex.
    corner = (points[:, None] - vertices).norm(dim=2).argmin(1)
    assert (faces.long()[found.long()] == corner[:, None]).any(1)[~near].all()


def test_features_are_interpolated_on_the_nearest_triangle(octahedron):
    vertices, faces = octahedron
    weights = torch.tensor([[0.85, 0.1, 0.05], [0.8, 0.05, 0.15]])
    triangles = torch.tensor([1, 6])
    points = (weights[:, :, None] * vertices[faces.long()[triangles]]).sum(1)
    outwards = 1 + 1e-3 * torch.ones(2, 1)
    features = draw(6, 4, dtype=torch.float32)
    found = shim.nearest_features(vertices, features, faces, points * outwards, 16)
    expected = (weights[:, :, None] * features[faces.long()[triangles]]).sum(1)
    assert torch.allclose(found, expected, atol=2e-3)


def test_ids_around_a_point_and_their_shares():
    grid = torch.arange(2 * 3 * 4).view(2, 3, 4)
    # Nodes lie at -1 and 1 of each axis and evenly between: x has 4 of them, y 3, z 2.
    points = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [0.0, 0.5, -0.5]])
    ids, shares = shim.ids_and_weights(points, grid, True)
    assert shares.sum(1).tolist() == pytest.approx([1, 1, 1])
    blended = (ids * shares).sum(1)
    position = (points * 0.5 + 0.5) * torch.tensor([3.0, 2.0, 1.0])
    assert torch.allclose(blended, position @ torch.tensor([1.0, 4.0, 12.0]))
    assert ids[0, 0] == 0
    assert ids[1].tolist() == [23] * 8


def test_six_numbers_are_the_first_rows_of_a_rotation():
    rotations = axis_angle_to_matrix(draw(4, 3))
    six = shim.matrix_to_rotation_6d(rotations)
    assert torch.allclose(six[:, 3:], rotations[:, 1])
    stretched = torch.cat([2 * six[:, :3], six[:, 3:] + 0.3 * six[:, :3]], dim=1)
    assert torch.allclose(shim.rotation_6d_to_matrix(stretched), rotations)


def test_meshes_are_sampled():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    triangles, barycentric = shim.sample_mesh_poisson_disk(vertices, np.array([[0, 1, 2]]), 100)
    assert 80 < len(triangles) < 120
    assert barycentric.dtype == np.float32
    assert barycentric.sum(1) == pytest.approx(1)


SIZE = 24


def mesh(vertices, faces):
    return Mesh(torch.tensor(vertices)[None].float(), torch.tensor(faces)[None])


def brute_force(vertices, faces, size):
    """Triangle, z and barycentric coordinates by pixel: every triangle in every pixel, by solving for the weights."""
    found = {}
    for row in range(size):
        for column in range(size):
            # To the right and downwards, normalised device coordinates go from 1 to -1.
            point = [1 - (2 * column + 1) / size, 1 - (2 * row + 1) / size]
            hits = []
            for index, corners in enumerate(vertices[faces]):
                system = np.vstack([corners[:, :2].T, np.ones(3)])
                if abs(np.linalg.det(system)) <= SMALLEST_AREA:
                    continue
                weights = np.linalg.solve(system, [*point, 1.0])
                depth = float(weights @ corners[:, 2])
                if weights.min() > 0 and depth >= 0:
                    hits.append((depth, index, weights))
            if hits:
                found[row, column] = min(hits, key=lambda hit: hit[:2])
    return found


def test_pixels_have_the_triangle_of_brute_force():
    random = np.random.default_rng(0)
    vertices = random.uniform(-1.2, 1.2, (30, 3)).astype(np.float32).astype(np.float64)
    vertices[:, 2] += 0.9  # some are behind z = 0
    faces = random.integers(0, 30, (25, 3))
    faces[3] = faces[7]  # the first of equal depth
    faces[4, 1] = faces[4, 0]  # no area
    triangles, z, barycentric, _ = rasterize_meshes(mesh(vertices, faces), image_size=SIZE)
    assert triangles.shape == z.shape == (1, SIZE, SIZE, 1)
    expected = brute_force(vertices, faces, SIZE)
    assert 100 < len(expected) < SIZE**2
    for row in range(SIZE):
        for column in range(SIZE):
            hit = expected.get((row, column))
            assert int(triangles[0, row, column, 0]) == (-1 if hit is None else hit[1])
            if hit is not None:
                assert float(z[0, row, column, 0]) == pytest.approx(hit[0], abs=1e-6)
                assert barycentric[0, row, column, 0].numpy() == pytest.approx(hit[2], abs=1e-6)


def test_the_upper_left_is_the_first_row_and_column():
    triangle = [[0.99, 0.99, 1.0], [0.4, 0.99, 1.0], [0.99, 0.4, 1.0]]
    triangles = rasterize_meshes(mesh(triangle, [[0, 1, 2]]), image_size=4)[0][0, :, :, 0]
    assert (triangles == 0).nonzero().tolist() == [[0, 0]]
    turned = rasterize_meshes(mesh(triangle, [[2, 1, 0]]), image_size=4)[0][0, :, :, 0]
    assert torch.equal(triangles, turned)


def test_texels_of_a_chart_are_those_of_the_native_method():
    """A grid of cells, each of two triangles, a third of which have no place in the chart."""
    random, side = np.random.default_rng(1), 7
    lines = np.linspace(0.03, 0.96, side + 1)
    places = np.stack(np.meshgrid(lines, lines), axis=-1) + random.uniform(
        -0.03, 0.03, (side + 1, side + 1, 2)
    )
    corner = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    a, b, c, d = (corner[i : i + side, j : j + side].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    uv = places.reshape(-1, 2)[faces].astype(np.float32).astype(np.float64)
    kept = np.flatnonzero(random.random(len(faces)) > 1 / 3)
    edges = uv[kept, 1:] - uv[kept, :1]
    area = 0.5 * np.abs(np.linalg.det(edges)).sum()
    resolution = 40
    points = texel_points(uv, kept, round(area * resolution**2))

    # As the authors' code calls it: coordinates run from -1 to 1, and both axes are turned.
    ndc = 1 - 2 * uv[kept].reshape(-1, 2)
    ndc[:, 1] *= -1
    vertices = np.column_stack([ndc, np.ones(len(ndc))])
    corners = np.arange(3 * len(kept)).reshape(-1, 3)
    triangles, _, barycentric, _ = rasterize_meshes(mesh(vertices, corners), image_size=resolution)
    hit = triangles[0, :, :, 0].numpy()
    rows, columns = np.nonzero(hit >= 0)
    assert len(rows) == len(points.triangles) > 300
    theirs = {
        (row, column): (kept[hit[row, column]], barycentric[0, row, column, 0].numpy())
        for row, column in zip(rows, columns)
    }
    at = (points.barycentric[:, :, None] * uv[points.triangles]).sum(1) * resolution
    for triangle, weights, (x, y) in zip(*points, at):
        found, theirs_weights = theirs[resolution - 1 - int(y), int(x)]
        assert found == triangle
        assert theirs_weights == pytest.approx(weights, abs=2e-4)  # vertices are float32


def test_objects_with_and_without_a_chart_are_read(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(
        "# a\no head\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0.5 0.25\nvt 1 0\nvn 0 0 1\nf 1/2/1 2/1/1 3/1/1\nf 3 2 1\nf 1//1 2//1 3//1\n"
    )
    vertices, faces, extra = load_obj(str(path), load_textures=False)
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert faces.verts_idx.tolist() == [[0, 1, 2], [2, 1, 0], [0, 1, 2]]
    assert faces.textures_idx.tolist() == [[1, 0, 0], [-1] * 3, [-1] * 3]
    assert extra.verts_uvs.tolist() == [[0.5, 0.25], [1, 0]]
    path.write_text("v 0 0 0\nf 1 1 1\n")
    assert load_obj(str(path))[2].verts_uvs is None


WIDTH, HEIGHT, FOCAL = 40, 24, (50.0, 44.0)


def settings(degree=0, background=(0.0, 0.0, 0.0)):
    """A camera at the origin that looks along z, as the published code describes it."""
    tangents = WIDTH / (2 * FOCAL[0]), HEIGHT / (2 * FOCAL[1])
    view = torch.eye(4)
    return GaussianRasterizationSettings(
        *(HEIGHT, WIDTH, *tangents, torch.tensor(background), 1.0, view, view, degree, torch.zeros(3), False)
    )


def splats(count, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape, scale=1.0, shift=0.0):
        return (scale * torch.randn(*shape, generator=generator) + shift).requires_grad_()

    means = torch.rand(count, 3, generator=generator) * torch.tensor([0.6, 0.4, 0.5])
    return {
        "means3D": (means + torch.tensor([-0.3, -0.2, 1.0])).requires_grad_(),
        "means2D": torch.zeros(count, 3, requires_grad=True),
        "opacities": (0.2 + 0.7 * torch.rand(count, 1, generator=generator)).requires_grad_(),
        "shs": draw(count, 16, 3, scale=0.3),
        "scales": (0.01 + 0.05 * torch.rand(count, 3, generator=generator)).requires_grad_(),
        "rotations": draw(count, 4),
    }


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_image_and_gradients_are_the_reference_s(degree):
    given = splats(30, seed=degree)
    image, radii = GaussianRasterizer(settings(degree, (0.2, 0.5, 1.0)))(**given)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(9))
    (image * weights).sum().backward()

    exact = {name: value.detach().double().requires_grad_() for name, value in given.items()}
    shs, offset = exact["shs"], torch.zeros(30, 2, dtype=torch.float64, requires_grad=True)
    rendering = rasterize(
        *(exact["means3D"], exact["rotations"], exact["scales"], exact["opacities"][:, 0]),
        harmonic_colors(shs[:, 0], shs[:, 1:].transpose(1, 2), exact["means3D"], degree),
        *(np.eye(4), np.array([[FOCAL[0], 0, WIDTH / 2], [0, FOCAL[1], HEIGHT / 2], [0, 0, 1]])),
        *(WIDTH, HEIGHT),
        background=[0.2, 0.5, 1.0],
        means2d_offset=offset,
        backend="reference",
    )
    (rendering.image.permute(2, 0, 1) * weights.double()).sum().backward()
    assert torch.allclose(image.double(), rendering.image.permute(2, 0, 1), atol=2e-5)
    assert torch.equal(radii > 0, rendering.radii > 0)
    for name in set(given) - {"means2D"}:
        expected = exact[name].grad
        assert torch.allclose(given[name].grad.double(), expected, atol=2e-4 * float(expected.abs().max())), (
            name
        )
    # Normalised device coordinates run over 2 where pixels run over the image's size.
    in_device_units = offset.grad * torch.tensor([WIDTH / 2, HEIGHT / 2])
    found = given["means2D"].grad.double()
    assert float(in_device_units.abs().max()) > 0
    assert torch.allclose(found[:, :2], in_device_units, atol=2e-4 * float(in_device_units.abs().max()))
    assert not found[:, 2].any()


def test_one_round_splat_is_the_closed_form():
    opacity, scale, depth = 0.7, 0.05, 2.0
    one = {
        "means3D": torch.tensor([[0.0, 0.0, depth]]),
        "means2D": torch.zeros(1, 3, requires_grad=True),
        "opacities": torch.tensor([[opacity]]),
        "colors_precomp": torch.tensor([[1.0, 0.5, 0.25]]),
        "scales": torch.full((1, 3), scale),
        "rotations": torch.tensor([[1.0, 0, 0, 0]]),
    }
    image, radii = GaussianRasterizer(settings())(**one)
    row, column = 10, 23  # away from the middle, which is between pixels
    dx, dy = column + 0.5 - WIDTH / 2, row + 0.5 - HEIGHT / 2
    # 0.3 square pixels are the published low-pass filter; radii are three deviations of the wider axis.
    variances = [(focal * scale / depth) ** 2 + 0.3 for focal in FOCAL]
    alpha = opacity * np.exp(-0.5 * (dx**2 / variances[0] + dy**2 / variances[1]))
    assert image[:, row, column].detach().numpy() == pytest.approx(alpha * np.array([1, 0.5, 0.25]), rel=1e-4)
    assert radii.tolist() == [int(np.ceil(3 * np.sqrt(max(variances))))]
    image[0, row, column].backward()
    expected = [alpha * dx / variances[0] * WIDTH / 2, alpha * dy / variances[1] * HEIGHT / 2, 0.0]
    assert one["means2D"].grad[0].numpy() == pytest.approx(expected, rel=1e-3)


def test_a_splat_is_in_view_whatever_its_opacity():
    given = splats(3)
    means = torch.tensor(
        [[0.0, 0, 1], [9.0, 0, 1], [0.0, 0, 0.1]]
    )  # in the middle, beside the image, too near
    given |= {"means3D": means, "opacities": torch.full((3, 1), 1e-6)}
    rasterizer = GaussianRasterizer(settings(1))
    _, radii = rasterizer(**given)
    assert (radii > 0).tolist() == [True, False, False]
    assert rasterizer.markVisible(means).tolist() == [True, True, False]


def test_distances_are_to_the_three_nearest():
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
    # The edges of the box, squared 1, 4 and 9; its shorter face diagonal, squared 5, is nearer than the longest edge.
    assert mean_square_distances(corners).tolist() == pytest.approx([(1 + 4 + 5) / 3] * 8)


# ------------------------------------------------------------------ the launcher

SCRIPT = """
import sys
import numpy as np, torch
from PIL import Image
from torch.utils.data import DataLoader
from part import LENGTH
from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from simple_knn._C import distCUDA2
import nvdiffrast.torch as dr
dr.RasterizeCudaContext()
FIXED = 5

class Dataset:
    cameras = [type("Camera", (), {"image_path": f"/x/images/{i}.png"}) for i in (2, 0, 1)]
    def __len__(self): return 3
    def __getitem__(self, index): return self.cameras[index].image_path
Dataset.__getitem__.__annotations__ = {}
values = torch.zeros(2, device="cuda").cuda() + torch.ones(2).to("cuda:0")
event = torch.cuda.Event(enable_timing=True); event.record()
torch.cuda.set_device(torch.device("cuda:0"))
image = Image.fromarray(np.array([[[-1, 0, 1]]], np.int8), "RGB")
drawn = list(DataLoader(Dataset(), batch_size=None, shuffle=True, num_workers=8, pin_memory=True, persistent_workers=True))
listed = list(DataLoader(Dataset(), batch_size=None, shuffle=False, num_workers=8))
print("result", [FIXED, LENGTH, values.tolist(), image.getpixel((0, 0)), drawn, listed, sys.argv[1:], __name__])
"""


def launch(tmp_path, **plan):
    """Run the script by the launcher; its result, or what it ended with."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "script.py").write_text(SCRIPT)
    (tmp_path / "code" / "part.py").write_text("LENGTH = 10\n")
    whole = {"shim": "", "threads": 1, "patches": [], "order": [], **plan}
    (tmp_path / "plan.json").write_text(json.dumps(whole))
    command = [sys.executable, LAUNCHER, tmp_path / "plan.json", tmp_path / "code" / "script.py", "--a", "1"]
    done = subprocess.run(list(map(str, command)), check=False, capture_output=True, text=True, cwd=tmp_path)
    return done.stdout if done.returncode == 0 else done.stderr


def test_a_script_for_cuda_runs_as_it_stands(tmp_path):
    patches = [["script.py", "FIXED = 5", "FIXED = 6"], ["part.py", "LENGTH = 10", "LENGTH = 20"]]
    names = ["1.png", "1.png", "2.png", "0.png"]
    found = launch(tmp_path, shim="blendshapes", patches=patches, order=names)
    drawn, listed = (
        [f"/x/images/{name}" for name in order] for order in (names, ["2.png", "0.png", "1.png"])
    )
    expected = [6, 20, [1.0, 1.0], (255, 0, 1), drawn, listed, ["--a", "1"], "__main__"]
    assert f"result {expected}" in found
    assert "FIXED = 5" in (tmp_path / "code" / "script.py").read_text()


def test_a_text_that_is_not_there_ends_the_script(tmp_path):
    found = launch(tmp_path, patches=[["script.py", "FIXED = 7", "FIXED = 6"]])
    assert "expected 'FIXED = 7', found none" in found
    assert "Traceback" not in found
