"""What stands in for RGBAvatar's rasteriser and for nvdiffrast: against sums pixel by pixel, the camera, and the native texels."""

import numpy as np
import pytest
import torch

from headbench.methods.official.shim.cpu import BatchRasterizer, Settings, TargetRasterizer, rasterize_chart
from headbench.methods.shared.surface_points import chart_resolution, texel_points
from headbench.methods.splats import rasterize

WIDTH, HEIGHT, FOCAL, CENTER = 24, 20, 30.0, (13.0, 9.0)


def settings(ground=(0.0, 0.0, 0.0)):
    """A camera at the origin with its principal point off the middle; matrices are for row vectors, as in the authors' code."""
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1] = 2 * FOCAL / WIDTH, 2 * FOCAL / HEIGHT
    projection[0, 2], projection[1, 2] = 2 * CENTER[0] / WIDTH - 1, 2 * CENTER[1] / HEIGHT - 1
    projection[2, 2], projection[2, 3], projection[3, 2] = 1.0, -0.01, 1.0
    view = torch.eye(4)
    view[:3, 3] = torch.tensor([0.1, 0.0, 0.5])
    return Settings(
        image_height=HEIGHT,
        image_width=WIDTH,
        bg=torch.as_tensor(ground),
        scale_modifier=1.0,
        tanfovx=WIDTH / 2 / FOCAL,
        tanfovy=HEIGHT / 2 / FOCAL,
        sh_degree=0,
        campos=torch.zeros(3),
        viewmatrix=view.T,
        projmatrix=(projection @ view).T,
        prefiltered=False,
        debug=False,
    )


def splats(count, seed=0):
    rng = torch.Generator().manual_seed(seed)
    means = 0.3 * torch.randn(count, 3, generator=rng) + torch.tensor([0.0, 0.0, 1.5])
    return {
        "means3D": means.requires_grad_(),
        "means2D": torch.zeros(count, 3),
        "opacities": 0.3 + 0.6 * torch.rand(count, 1, generator=rng),
        "shs": torch.randn(count, 1, 3, generator=rng).requires_grad_(),
        "scales": 0.03 + 0.05 * torch.rand(count, 3, generator=rng),
        "rotations": torch.randn(count, 4, generator=rng),
    }


def target(seed=0):
    return torch.rand(4, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))


def test_sums_count_weights_above_a_tenth_on_the_head():
    """Against weights by renderings of single splats in order; the sum of all weights is the coverage."""
    given, image = splats(25), target()
    _, alpha, colors, weights, radii = TargetRasterizer(settings())(**given, target_image=image)
    assert (radii > 0).all()
    assert alpha.shape == (1, HEIGHT, WIDTH)
    view, K = (
        settings().viewmatrix.T,
        torch.tensor([[FOCAL, 0, CENTER[0]], [0, FOCAL, CENTER[1]], [0, 0, 1.0]]),
    )
    shapes = given["means3D"].detach(), given["rotations"], given["scales"], given["opacities"][:, 0]
    light = torch.ones(HEIGHT, WIDTH)
    for index in (shapes[0] @ view[2, :3]).argsort().tolist():
        one = [part[index : index + 1] for part in shapes]
        drawn = rasterize(*one, torch.ones(1, 1), view, K, WIDTH, HEIGHT).alpha
        weight = torch.where((light * drawn > 0.1) & (image[3] > 0.5), light * drawn, 0)
        torch.testing.assert_close(weights[index], weight.sum(), rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(colors[index], (weight * image[:3]).sum((1, 2)), rtol=1e-3, atol=1e-3)
        light = light * (1 - drawn)
    torch.testing.assert_close(alpha[0].detach(), 1 - light, rtol=1e-3, atol=1e-3)


def test_the_principal_point_is_that_of_the_matrix():
    one = splats(1)
    one["means3D"] = torch.tensor([[-0.1, 0.0, 1.5]])  # on the axis of the camera
    with torch.no_grad():
        _, alpha, _, _, _ = TargetRasterizer(settings())(**one)
    columns, rows = torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5
    assert float((alpha[0].sum(0) * columns).sum() / alpha.sum()) == pytest.approx(CENTER[0], abs=0.05)
    assert float((alpha[0].sum(1) * rows).sum() / alpha.sum()) == pytest.approx(CENTER[1], abs=0.05)


def test_a_batch_has_the_images_and_gradients_of_its_members():
    grounds = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])
    members = [splats(12, seed) for seed in range(2)]
    batch = {name: torch.stack([each[name].detach() for each in members]) for name in members[0]}
    batch["shs"].requires_grad_()
    images = torch.stack([target(seed) for seed in range(2)])
    many = BatchRasterizer(12, 4, settings())
    many.raster_settings.bg = grounds[:, :, None, None]
    found = many(**batch, target_image=images)
    found[0].square().sum().backward()
    for index, each in enumerate(members):
        alone = TargetRasterizer(settings(grounds[index]))(**each, target_image=images[index])
        for one, other in zip(found, alone, strict=True):
            torch.testing.assert_close(one[index], other)
        alone[0].square().sum().backward()
        torch.testing.assert_close(batch["shs"].grad[index], each["shs"].grad)


def test_texels_of_a_chart_are_those_of_the_native_method():
    """Triangles and barycentric coordinates, texel by texel from the lowest row."""
    corners = (
        np.random.default_rng(0).random((9, 3, 2)) * 0.3 + np.indices((3, 3)).reshape(2, 9).T[:, None] / 3
    )
    size = chart_resolution(corners, 400)
    native = texel_points(corners, np.arange(9), 400)
    flat = torch.from_numpy(corners.reshape(-1, 2)).float() * 2 - 1
    clip = torch.nn.functional.pad(torch.nn.functional.pad(flat, [0, 1]), [0, 1], value=1.0)
    found, nothing = rasterize_chart(None, clip[None], torch.arange(27).view(9, 3), (size, size))
    assert nothing is None
    places = (native.barycentric[:, :, None] * corners[native.triangles]).sum(1)
    column, row = np.floor(places * size).astype(int).T
    texels = found[0].numpy()
    assert (texels[..., 3] > 0).sum() == len(native.triangles)
    np.testing.assert_array_equal(texels[row, column, 3] - 1, native.triangles)
    np.testing.assert_allclose(texels[row, column, :2], native.barycentric[:, :2], atol=1e-4)
    with pytest.raises(ValueError, match="square"):
        rasterize_chart(None, clip[None], torch.arange(27).view(9, 3), (size, size + 1))
