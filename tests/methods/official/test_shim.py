"""The CPU shim: its rasteriser against the float64 reference and a closed form, and what it does to a script."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from headbench.methods.official.method import LAUNCHER
from headbench.methods.official.shim.cpu import mean_square_distances
from headbench.methods.official.shim.rasterizer import GaussianRasterizationSettings, GaussianRasterizer
from headbench.methods.ops.harmonics import harmonic_colors
from headbench.methods.splats import rasterize

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
