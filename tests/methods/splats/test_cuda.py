"""The CUDA backend: against the reference where there is a GPU; everywhere, that it drives gsplat rightly."""

from __future__ import annotations

import importlib
import logging
import sys
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from headbench.bench.errors import UnavailableError
from headbench.methods.benchmarks.splats import cloud, head_shell, relative_error
from headbench.methods.splats import available_backends, cpu, cuda, rasterize

from .cases import request_of

slow = importlib.import_module("headbench.methods.splats.rasterize")  # the package's name is the function's
COMPILED_CHANNELS = (1, 2, 3, 4, 5, 8, 9, 16, 17, 32)  # by gsplat 1.5 and 1.6 alike, as far as 32
needs_gpu = pytest.mark.skipif(not cuda.installed(), reason="needs a GPU and gsplat (extra `cuda`)")


class FakeGsplat:
    """gsplat's functions in plain torch on the CPU, of any dtype; draws every splat at every pixel.

    As there, rows of splats out of view are memory that nobody wrote, here NaN, but for radii and compensations of 0.
    """

    def __init__(self, clamp=0.99):
        self.clamp = clamp

    def fully_fused_projection(
        self, means, covars, quats, scales, viewmats, Ks, width, height, *, eps2d, near_plane, far_plane,
        calc_compensations, opacities
    ):  # fmt: skip
        assert covars is None
        assert opacities.shape == (len(means),)
        w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
        entries = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
        entries += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
        entries += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
        axes = torch.stack(entries, 1).view(-1, 3, 3) * scales[:, None]
        camera = torch.einsum("vij,nj->vni", viewmats[:, :3, :3], means) + viewmats[:, None, :3, 3]
        depths = camera[..., 2]
        f = torch.stack([Ks[:, 0, 0], Ks[:, 1, 1]], -1)[:, None]
        c = torch.stack([Ks[:, 0, 2], Ks[:, 1, 2]], -1)[:, None]
        size = torch.tensor([width, height]).to(means)
        ratio = camera[..., :2] / depths[..., None]
        margin = 0.15 * size / f
        slope = torch.maximum(torch.minimum(ratio, (size - c) / f + margin), -c / f - margin)
        jacobian = torch.diag_embed(f / depths[..., None])
        jacobian = torch.cat([jacobian, (-f * slope / depths[..., None])[..., None]], -1)
        to_image = jacobian @ viewmats[:, None, :3, :3] @ axes
        sharp = to_image @ to_image.mT
        blurred = sharp + eps2d * torch.eye(2).to(means)
        inverse = torch.linalg.inv(blurred)
        conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
        factor = (torch.linalg.det(sharp) / torch.linalg.det(blurred)).clamp(min=0).sqrt()
        seen = (depths > near_plane) & (depths < far_plane)
        radii = torch.where(seen[..., None], torch.tensor([7, 9]), 0).to(torch.int32)
        means2d, conics = (torch.where(seen[..., None], x, torch.nan) for x in (f * ratio + c, conics))
        depths, factor = torch.where(seen, depths, torch.nan), torch.where(seen, factor, 0)
        return radii, means2d, depths, conics, factor if calc_compensations else None

    def isect_tiles(self, means2d, radii, depths, tile, columns, rows):
        order = torch.where(radii[..., 0] > 0, depths, torch.inf).argsort(dim=1, stable=True)
        return None, None, (order, (radii[..., 0] > 0).sum(1))

    def isect_offset_encode(self, keys, views, columns, rows):
        return torch.zeros(views, rows, columns, dtype=torch.int32)

    def rasterize_to_pixels(
        self, means2d, conics, colors, opacities, width, height, tile, offsets, lists, *, backgrounds
    ):
        assert offsets.shape[1:] == (-(-height // tile), -(-width // tile))
        assert colors.shape[-1] in COMPILED_CHANNELS
        assert backgrounds.shape == (len(colors), colors.shape[-1])
        images, alphas = [], []
        centers = [torch.arange(n).to(means2d) + 0.5 for n in (height, width)]
        y, x = torch.meshgrid(*centers, indexing="ij")
        for view, (order, seen) in enumerate(zip(*lists, strict=True)):
            light = torch.ones(height, width).to(means2d)
            running = torch.ones(height, width, dtype=torch.bool)
            image = torch.zeros(height, width, colors.shape[-1]).to(means2d)
            for n in order[:seen]:
                dx, dy = x - means2d[view, n, 0], y - means2d[view, n, 1]
                a, b, c = conics[view, n]
                raw = opacities[view, n] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
                alpha = torch.where(raw >= 1 / 255, raw.clamp(max=self.clamp), 0)
                running = running & (light * (1 - alpha) > 1e-4)
                alpha = torch.where(running, alpha, 0)
                image = image + (alpha * light)[..., None] * colors[view, n]
                light = light * (1 - alpha)
            images.append(image + light[..., None] * backgrounds[view])
            alphas.append(1 - light[..., None])
        return torch.stack(images), torch.stack(alphas)


class NewGsplat(FakeGsplat):
    """Takes the ellipses of splats, as gsplat 1.6 does."""

    def isect_tiles(self, means2d, radii, depths, tile, columns, rows, conics=None, opacities=None):
        assert conics.shape == (*means2d.shape[:2], 3)
        assert opacities.shape == means2d.shape[:2]
        return super().isect_tiles(means2d, radii, depths, tile, columns, rows)


@pytest.mark.parametrize("gsplat", [FakeGsplat(), NewGsplat()])
@pytest.mark.parametrize(("antialiased", "channels"), [(False, 3), (True, 3), (False, 7)])
def test_gsplat_is_driven_to_draw_what_the_reference_draws(antialiased, channels, gsplat):
    one = cloud(25, 19, 14, seed=1, size=0.1, channels=channels)
    one.means[:4] = torch.tensor(
        [[0.1, 0.2, -5.0], [0, 0, 2e3], [0.3, 0, 2e3], [0.1, 0.0, -9.0]]
    )  # not in view
    names = ("means", "quats", "scales", "opacities", "colors", "viewmat", "offset")

    options = {
        "background": one.background,
        "near": 0.2,
        "far": 1e3,
        "eps2d": 0.4,
        "antialiased": antialiased,
    }

    def outcome(render):
        leaves = [value.double().requires_grad_() for value in one[:6]]
        leaves.append(torch.zeros(25, 2, dtype=torch.float64, requires_grad=True))
        result = render(*leaves[:6], one.K, 19, 14, means2d_offset=leaves[6], **options)
        rng = torch.Generator().manual_seed(0)
        upstream = torch.randn(result.image.shape, generator=rng).double()
        return result, torch.autograd.grad((result.image, result.alpha), leaves, (upstream, upstream[..., 0]))

    result, gradients = outcome(lambda *a, **o: cuda.draw(gsplat, request_of(*a, **o)))
    truth, true_gradients = outcome(partial(rasterize, backend="reference"))
    assert torch.equal(result.radii, truth.radii), "not gsplat's own, which opacity changes"
    assert (result.radii == 0).sum() >= 4, "rows that are not valid were met"
    torch.testing.assert_close(result.image, truth.image)
    torch.testing.assert_close(result.alpha, truth.alpha)
    for name, value, wanted in zip(names, gradients, true_gradients, strict=True):
        assert relative_error(value, wanted) < 1e-6, name


EXTENSIONS = {
    "_C = None": "there is no nvcc.*Install the CUDA toolkit",
    "raise RuntimeError('Error building\\nmuch more')": "cannot be loaded: Error building. Install the CUDA toolkit",
    "raise ImportError('no rich')": "cannot be loaded: no rich",
    "_C = 'compiled'": None,
}


@pytest.mark.parametrize(("extension", "refused"), EXTENSIONS.items())
def test_the_extension_is_compiled_when_gsplat_is_loaded(monkeypatch, tmp_path, caplog, extension, refused):
    for name in ("gsplat", "gsplat/cuda"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    locked = "import fcntl, os\nlock = os.environ['TORCH_EXTENSIONS_DIR'] + '/headbench-gsplat.lock'\n"
    locked += (
        "try:\n    fcntl.flock(open(lock), fcntl.LOCK_EX | fcntl.LOCK_NB)\nexcept BlockingIOError:\n    "
    )
    (tmp_path / "gsplat/cuda/_backend.py").write_text(locked + extension)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: None)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "extensions"))
    for cached in (cuda.installed, cuda.load):
        cached.cache_clear()
    try:
        with caplog.at_level(logging.INFO, "headbench"):
            cuda.prepare("cpu")
            assert "gsplat" not in sys.modules
            if refused:
                with pytest.raises(UnavailableError, match=refused):
                    cuda.prepare("cuda:1")
            else:
                cuda.prepare("cuda:1")
                assert cuda.load().cuda._backend._C == "compiled"
        assert ["compiles its CUDA extension" in record.message for record in caplog.records] == [True]
        (tmp_path / "gsplat" / "csrc.cpython-311-x86_64-linux-gnu.so").touch()
        assert cuda.compiled()
    finally:
        for cached in (cuda.installed, cuda.load):
            cached.cache_clear()
        for name in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
            del sys.modules[name]


@pytest.mark.parametrize("clamp", [0.99, 0.999])
def test_another_clamp_is_measured_and_warned_of_once(monkeypatch, caplog, clamp):
    monkeypatch.setattr(cuda, "load", lambda: FakeGsplat(clamp))
    cuda.warn_of_clamp.cache_clear()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            cuda.warn_of_clamp("cpu")
    cuda.warn_of_clamp.cache_clear()
    assert cuda.clamp_of(FakeGsplat(clamp), "cpu") == pytest.approx(clamp)
    assert [("0.999" in record.message) for record in caplog.records] == ([True] if clamp == 0.999 else [])


def test_without_a_gpu_it_says_so(monkeypatch):
    for cached in (cuda.installed, cuda.load):
        cached.cache_clear()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UnavailableError, match=r"needs a GPU.*'\.\[cuda\]'"):
        rasterize(*cloud(3, 8, 8)[:9], backend="cuda")
    assert available_backends("cuda") == ("reference",)
    for cached in (cuda.installed, cuda.load):
        cached.cache_clear()


@pytest.mark.parametrize(
    ("installed", "options", "reason"),
    [
        (False, {}, "gsplat is not installed. Run in the headbench checkout: pip install"),
        (True, {"alpha_min": 0.1}, "supports only the defaults"),
        (True, {}, None),
    ],
)
def test_a_slow_backend_on_a_gpu_is_warned_of_once(monkeypatch, caplog, installed, options, reason):
    monkeypatch.setattr(cuda, "installed", lambda: installed)
    monkeypatch.setattr(cuda, "supports", lambda request: True)
    monkeypatch.setattr(cpu, "supports", lambda request: False)
    monkeypatch.setattr(cuda, "rasterize_cuda", lambda request: "gsplat")
    monkeypatch.setattr(slow, "rasterize_reference", lambda request: "reference")
    cuda._warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        drawn = {rasterize(*cloud(3, 8, 8)[:9], **options) for _ in range(2)}
    cuda._warn_once.cache_clear()
    assert drawn == {"reference" if reason else "gsplat"}
    assert [reason in record.message for record in caplog.records] == ([True] if reason else [])


@pytest.mark.parametrize(
    ("device", "dtype", "warned"),
    [("mps", torch.float32, 1), ("xpu", torch.float64, 0), ("cpu", torch.float64, 0)],
)
def test_float32_on_a_gpu_without_kernels_is_warned_of_once(caplog, device, dtype, warned):
    request = SimpleNamespace(means=SimpleNamespace(dtype=dtype, device=torch.device(device)))
    cuda._warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert {slow._choose(request) for _ in range(2)} == {"reference"}
    cuda._warn_once.cache_clear()
    assert [f"not device '{device}'" in record.message for record in caplog.records] == [True] * warned


def test_what_gsplat_cannot_do_is_refused(monkeypatch):
    scene = cloud(3, 8, 8)
    monkeypatch.setattr(cuda, "load", FakeGsplat)
    with pytest.raises(ValueError, match="float32 on a CUDA device.*cpu"):
        rasterize(*scene[:9], backend="cuda")
    monkeypatch.setattr(cuda, "supports", lambda request: True)
    with pytest.raises(ValueError, match="K: expected no gradient"):
        rasterize(*scene[:6], scene.K.clone().requires_grad_(), 8, 8, backend="cuda")


@needs_gpu
@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_agrees_with_the_reference_on_a_gpu(antialiased):
    scene = head_shell(3000, 120, 100)
    scene = scene._replace(opacities=scene.opacities.clamp(max=0.98))  # whatever this release clamps at
    upstream = torch.randn(100, 120, 3, generator=torch.Generator().manual_seed(0))

    def outcome(device, dtype, backend):
        leaves = [value.to(device, dtype).requires_grad_() for value in scene[:6]]
        leaves.append(torch.zeros(3000, 2, device=device, dtype=dtype, requires_grad=True))
        options = {"means2d_offset": leaves[6], "antialiased": antialiased}
        view = scene.K, 120, 100
        image = rasterize(*leaves[:6], *view, background=scene.background, backend=backend, **options).image
        image.backward(upstream.to(device, dtype))
        return image.detach().cpu().double(), [leaf.grad.cpu() for leaf in leaves]

    image, gradients = outcome("cuda", torch.float32, "cuda")
    truth, true_gradients = outcome("cpu", torch.float64, "reference")
    assert (image - truth).abs().mean() < 1e-5
    for value, wanted in zip(gradients, true_gradients, strict=True):
        assert relative_error(value, wanted) < 5e-3
