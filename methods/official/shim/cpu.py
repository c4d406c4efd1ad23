"""Runs official CUDA code on a CPU: headbench's renderer replaces theirs, and stand-ins replace the rest.

The shim is installed in the interpreter before their scripts are run (`launch`). Their files are not modified. Results
have the label "(cpu-shim)", since they are not those of their rasteriser.
"""

from __future__ import annotations

import builtins
import importlib.util
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import PIL.Image
import torch
import torch.utils.data
from scipy.spatial import KDTree
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from ...ops.planes import C0, harmonic_colors
from ...splats import pixel_weights, rasterize
from . import blendshapes
from .blendshapes import OF_FLASHAVATAR, REPLACED, Mesh, Silent, rasterize_meshes

NEAR = 0.2
"""Metres; nearer splats are not drawn, as published."""


class GaussianRasterizationSettings(NamedTuple):
    """The published settings; matrices multiply row vectors from the right. ``prefiltered`` and ``debug`` have no effect."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool = False


class GaussianRasterizer(nn.Module):
    """The published module."""

    def __init__(self, raster_settings: GaussianRasterizationSettings):
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        alpha_point_id: int | None = None,
    ) -> tuple[Tensor, ...]:
        """Render (N,) splats.

        - ``means3D``, ``scales``, ``rotations``: (N, 3), (N, 3), (N, 4) wxyz; metres.
        - ``means2D``: (N, 3) values that do not affect the image. Their gradient is the one with respect to the projected means
          in normalised device units, with a zero third column.
        - ``opacities``: (N, 1) or (N,) in [0, 1].
        - ``shs``, ``colors_precomp``: (N, K, 3) harmonics of which ``sh_degree`` are used, or (N, 3) colours; exactly one of
          them.
        - ``alpha_point_id``: argument of GaussianBlendshapes' fork; 0 also returns the coverage by all splats.
        - Returns image (3, H, W); coverage (H, W) if requested; radii (N,), positive for every splat in view, regardless of its
          opacity.
        """
        to = self.raster_settings
        if (shs is None) == (colors_precomp is None):
            raise ValueError("expected either shs or colors_precomp")
        if cov3D_precomp is not None or scales is None or rotations is None:
            raise ValueError("expected scales and rotations; the shim does not support covariances")
        if alpha_point_id not in (None, 0):
            raise ValueError("expected alpha_point_id 0; the shim supports only the coverage by all splats")
        if shs is not None:
            colors_precomp = _colors(shs, means3D - to.campos, to.sh_degree)
        assert colors_precomp is not None
        width, height = int(to.image_width), int(to.image_height)
        # The value of means2D has no effect: the difference is zero, its gradient is not.
        half = means3D.new_tensor([0.5 * width, 0.5 * height])
        offset = (means2D - means2D.detach())[:, :2] * half
        rendering = rasterize(
            *(means3D, rotations, to.scale_modifier * scales, opacities.reshape(-1), colors_precomp),
            *(to.viewmatrix.detach().T, self.intrinsics(), width, height),
            background=to.bg,
            near=NEAR,
            means2d_offset=offset,
            check_values=False,
        )
        image = rendering.image.permute(2, 0, 1)
        return (
            (image, rendering.radii) if alpha_point_id is None else (image, rendering.alpha, rendering.radii)
        )

    def intrinsics(self) -> Tensor:
        """(3, 3): the principal point is the middle of the image."""
        width, height = float(self.raster_settings.image_width), float(self.raster_settings.image_height)
        focal = width / (2 * self.raster_settings.tanfovx), height / (2 * self.raster_settings.tanfovy)
        return torch.tensor([[focal[0], 0, width / 2], [0, focal[1], height / 2], [0, 0, 1]])

    def markVisible(self, positions: Tensor) -> Tensor:
        """(N,) whether positions are beyond the near plane."""
        view = self.raster_settings.viewmatrix
        return positions @ view[:3, 2] + view[3, 2] > NEAR


def _colors(shs: Tensor, vectors: Tensor, degree: int) -> Tensor:
    """(N, 3) colours of harmonics along (N, 3) vectors from the camera."""
    if degree == 0:
        return torch.relu(0.5 + C0 * shs[:, 0])
    return harmonic_colors(shs[:, 0].contiguous(), shs[:, 1:].transpose(1, 2).contiguous(), vectors, degree)


PUBLIC: dict[str, Any] = {
    "GaussianRasterizationSettings": GaussianRasterizationSettings,
    "GaussianRasterizer": GaussianRasterizer,
}


LEAST_WEIGHT = 0.1
"""Weights of a splat in a pixel up to this do not count, as published (``forward.cu``, ``renderCUDA``)."""
LEAST_COVERAGE = 0.5
"""Pixels of the target image with a coverage up to this do not count, as published (the same)."""


class Settings(SimpleNamespace):
    """The published settings by name, see `GaussianRasterizationSettings`; ``bg`` is set for every batch."""


class TargetRasterizer(GaussianRasterizer):
    """The published module for one image."""

    raster_settings: Any

    def forward(self, target_image: Tensor | None = None, **splats: Any) -> tuple[Tensor, ...]:  # type: ignore[override]
        """Render splats.

        - ``target_image``: (4, H, W) straight colours and coverage in [0, 1]; none if it is empty.
        - ``splats``: those of `GaussianRasterizer.forward`, by name.
        - Returns image (3, H, W), coverage (1, H, W), sums over pixels of weight times target colour (N, 3) and of weight (N,),
          and radii (N,).
        """
        image, alpha, radii = super().forward(**splats, alpha_point_id=0)
        sums = image.new_zeros(len(radii), 4)
        if target_image is not None and target_image.numel():
            self._add_sums(sums, target_image, **splats)
        return image, alpha[None], sums[:, :3], sums[:, 3], radii

    def intrinsics(self) -> Tensor:
        """(3, 3) with the principal point of the projection matrix."""
        to = self.raster_settings
        projection = (torch.linalg.inv(to.viewmatrix.double()) @ to.projmatrix.double()).T
        width, height = to.image_width, to.image_height
        focal = projection[0, 0] * width / 2, projection[1, 1] * height / 2
        center = (projection[0, 2] + 1) * width / 2, (projection[1, 2] + 1) * height / 2
        return torch.tensor([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])

    @torch.no_grad()
    def _add_sums(
        self,
        sums: Tensor,
        target: Tensor,
        means3D: Tensor,
        rotations: Tensor,
        scales: Tensor,
        opacities: Tensor,
        **rest: Any,
    ) -> None:
        to = self.raster_settings
        shapes = means3D, rotations, to.scale_modifier * scales, opacities.reshape(-1)
        camera = to.viewmatrix.T, self.intrinsics().to(means3D), to.image_width, to.image_height
        splats, pixels, weights = pixel_weights(*shapes, *camera, NEAR)
        colors, coverage = target[:3].flatten(1).T, target[3].flatten()
        counted = (weights > LEAST_WEIGHT) & (coverage[pixels] > LEAST_COVERAGE)
        weights, splats, pixels = weights[counted, None], splats[counted], pixels[counted]
        sums.index_add_(0, splats, torch.cat([weights * colors[pixels], weights], dim=1))


class BatchRasterizer(nn.Module):
    """The published module for images of one camera: every argument and result has a leading axis of images."""

    def __init__(self, max_gaussian_size: int, max_batch_size: int, raster_settings: Settings):
        super().__init__()
        self.raster_settings = raster_settings

    def forward(self, **batch: Tensor) -> tuple[Tensor, ...]:
        """Render every image on its own background; see `TargetRasterizer.forward`."""
        found = []
        for index, ground in enumerate(self.raster_settings.bg.reshape(-1, 3)):
            settings: Any = Settings(**{**vars(self.raster_settings), "bg": ground})
            one = TargetRasterizer(settings)
            found.append(one(**{name: values[index] for name, values in batch.items()}))
        return tuple(torch.stack(parts) for parts in zip(*found, strict=True))


def rasterize_chart(
    context: Any, pos: Tensor, tri: Tensor, resolution: tuple[int, int]
) -> tuple[Tensor, None]:
    """nvdiffrast's ``rasterize`` for a flat mesh in a square: the triangle at the centre of each texel, the lowest row first.

    Of several triangles in a texel the first is taken.

    - ``pos``, ``tri``: (1, V, 4) clip coordinates with w = 1; (F, 3) triangles.
    - ``resolution``: texels of both sides, S and S.
    - Returns (1, S, S, 4): first two barycentric coordinates, z, and the number of the triangle from 1, all 0 without a
      triangle.
    """
    if resolution[0] != resolution[1]:
        raise ValueError("expected a square; the shim does not support other charts")
    # PyTorch3D's coordinates, which `rasterize_meshes` takes, point the other way along both sides.
    turned = torch.cat([-pos[..., :2], pos[..., 2:3]], dim=-1)
    triangles, z, barycentric, _ = rasterize_meshes(Mesh(turned, tri[None].long()), resolution[0])
    fragments = torch.cat([barycentric[..., 0, :2], z, triangles + 1.0], dim=-1)
    return fragments * (triangles >= 0), None


RASTERIZER: dict[str, Any] = {
    "GaussianRasterizationSettings": Settings,
    "GaussianRasterizer": TargetRasterizer,
    "BatchGaussianRasterizer": BatchRasterizer,
}
OF_BLENDED: dict[str, dict[str, Any]] = {
    "torch.utils.tensorboard": {"SummaryWriter": Silent},
    "fused_ssim": {"fused_ssim": None},
}
"""Stand-in modules for packages that are not installed, by name."""
ALWAYS: dict[str, dict[str, Any]] = {
    **REPLACED,
    "nvdiffrast": {},
    "nvdiffrast.torch": {
        **dict.fromkeys(("RasterizeCudaContext", "RasterizeGLContext"), Silent),
        "rasterize": rasterize_chart,
    },
}
"""Stand-ins used even if the package is installed: nvdiffrast needs CUDA or OpenGL."""


def install(threads: int, code: str) -> None:
    """Install the shim for everything that is imported later.

    ``code``: "bound splats", "blendshapes", "charted splats" or "blended splats", see `OfficialMethod.shimmed`. Packages that code imports
    optionally must stay missing, so stand-ins are limited to the required ones.
    """
    torch.set_num_threads(threads)
    extra = RASTERIZER if code == "blended splats" else {}
    _module("diff_gaussian_rasterization", PUBLIC | blendshapes.RASTERIZER | extra)
    _module("diff_gaussian_rasterization._C", blendshapes.RASTERIZER_KERNELS)
    _module("simple_knn")
    _module("simple_knn._C", {"distCUDA2": mean_square_distances, **blendshapes.NEIGHBOURS})
    packages = {
        "blendshapes": blendshapes.OF_BLENDSHAPES,
        "charted splats": {**blendshapes.OF_MESHES, **OF_FLASHAVATAR},
        "blended splats": OF_BLENDED,
    }
    # Imported by scripts, but not used: no mesh is drawn, no external OBJ file read and no LPIPS measured.
    context = dict.fromkeys(("RasterizeCudaContext", "RasterizeGLContext"), Silent)
    unused: dict[str, dict[str, Any]] = {
        "nvdiffrast": {},
        "nvdiffrast.torch": context,
        "iopath": {},
        "iopath.common": {},
        "iopath.common.file_io": {"PathManager": LocalPaths},
        "torchvision": {},
        "torchvision.models": {},
        **packages.get(code, {}),
    }
    for name, content in unused.items():
        if not _is_installed(name):
            _module(name, content)
    for name, content in {"charted splats": REPLACED, "blended splats": ALWAYS}.get(code, {}).items():
        _module(name, content)
    _without_cuda()
    _signed_images()


def mean_square_distances(points: Tensor) -> Tensor:
    """(N,) mean of the squared distances from each of (N, 3) points to its three nearest neighbours."""
    distances, _ = KDTree(points.detach().numpy()).query(points.detach().numpy(), k=4)
    return torch.from_numpy(np.square(distances[:, 1:]).mean(axis=1)).to(points.dtype)


def _is_installed(name: str) -> bool:
    """Whether a module is installed or already replaced by a stand-in."""
    package = name.partition(".")[0]
    if package == "torch":  # replaced by a module that imports another package
        package = name.rpartition(".")[2]
    module = sys.modules.get(package)
    if module is not None:
        return module.__spec__ is not None
    return importlib.util.find_spec(package) is not None


class LocalPaths:
    """``iopath``'s path manager for files of this machine."""

    def open(self, path: Any, mode: str = "r", **options: Any) -> Any:
        """Open a file."""
        return builtins.open(path, mode, **options)

    def exists(self, path: Any) -> bool:
        """Whether there is such a file."""
        return os.path.exists(path)


def _module(name: str, content: Mapping[str, Any] | None = None) -> None:
    module = ModuleType(name)
    module.__dict__.update(content or {})
    sys.modules[name] = module
    parent, _, child = name.rpartition(".")
    if parent:
        setattr(sys.modules[parent], child, module)


class OnCPU(TorchFunctionMode):
    """Replaces every CUDA device by the CPU."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        if "device" in kwargs:
            kwargs = {**kwargs, "device": _on_cpu(kwargs["device"])}
        if func is Tensor.to:
            args = tuple(map(_on_cpu, args))
        return func(*args, **kwargs)


def _on_cpu(value: Any) -> Any:
    return "cpu" if isinstance(value, str | torch.device) and str(value).startswith("cuda") else value


class _Event(Silent):
    """A CUDA event that measures nothing."""

    def elapsed_time(self, other: Any) -> float:
        return 0.0


def _without_cuda() -> None:
    replaced: Any = torch.cuda
    for name in ("synchronize", "set_device", "empty_cache"):
        setattr(replaced, name, lambda *arguments, **options: None)
    replaced.Event, replaced.Stream, replaced.current_stream = _Event, Silent, Silent
    replaced.stream = lambda stream: nullcontext()
    pinned: Any = Tensor
    pinned.pin_memory = lambda self, *arguments, **options: self
    for of in (Tensor, torch.nn.Module):
        of.cuda = lambda self, *arguments, **options: self  # type: ignore[method-assign,union-attr,assignment]
    OnCPU().__enter__()  # active until the process ends
    stock: Any = torch.utils.data.DataLoader

    def loader(*arguments: Any, **options: Any) -> Any:
        # Workers decode images for a GPU; on a CPU they would take the cores from training.
        options |= {"num_workers": 0, "pin_memory": False, "persistent_workers": False}
        return stock(*arguments, **options)

    torch.utils.data.DataLoader = loader  # type: ignore[misc,assignment]


def _signed_images() -> None:
    stock: Any = PIL.Image.fromarray

    def fromarray(values: Any, *arguments: Any, **options: Any) -> Any:
        values = values.view(np.uint8) if getattr(values, "dtype", None) == np.int8 else values
        return stock(values, *arguments, **options)

    PIL.Image.fromarray = fromarray  # type: ignore[assignment]
