"""Rendering of splats bound to a mesh, shared by avatars with different colour and opacity models."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import BoolArray, Camera, Changes, FloatArray, Frame, HeadPose, no_stage
from ...bench.native.dispatch import is_cuda, on_host, to_device
from ..avatars.compact.coder import codec_of
from ..ops.splats import WorldSplats
from ..splats import Rendering, pixel_weights, rasterize
from ..splats.request import ALPHA_MIN, TRANSMITTANCE_MIN
from .avatar_files import HEAD_FILE
from .surface_points import pose_key

Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class PosedSplats:
    """Splats of one pose in the world, as numpy float32."""

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    """(N, 3) metres, (N, 4) unit quaternions wxyz, (N, 3) metres."""
    opacities: FloatArray
    """(N,)."""
    colors: FloatArray | None
    """(N, 3) as seen from the requested camera; None without a camera."""


class Cutoffs(NamedTuple):
    """Thresholds below which the renderer skips work; see `rasterize`. Larger values are faster and less exact."""

    alpha_min: float = ALPHA_MIN
    transmittance_min: float = TRANSMITTANCE_MIN


USUAL = Cutoffs()
"""The renderer's defaults."""


class Copy(NamedTuple):
    """A frame being copied to pinned host memory, colours before alpha, and the event of its completion."""

    host: Tensor
    ready: torch.cuda.Event


class Drawn(NamedTuple):
    """A drawn frame on its device; the copy from a CUDA device has started."""

    image: Tensor
    """(H, W, 3) in [0, 1]."""
    alpha: Tensor
    """(H, W) in [0, 1]."""
    copy: Copy | None = None


def draw_splats(
    world: WorldSplats,
    opacities: Tensor,
    colors: Tensor,
    view: View,
    end_stage: Callable[[str], None] = no_stage,
    cutoffs: Cutoffs = USUAL,
) -> Drawn:
    """Rasterize and clip to [0, 1]: the last two stages of `StagedAvatar.draw`."""
    rendering = rasterize_view(world, opacities, colors, view, view.background, **cutoffs._asdict())
    end_stage("rasterize")
    drawn = Drawn(rendering.image.clamp(0, 1), rendering.alpha.clamp(0, 1))
    end_stage("post")
    return _copied_ahead(drawn) if is_cuda(drawn.image.device) else drawn


def rasterize_view(
    world: WorldSplats,
    opacities: Tensor,
    colors: Tensor,
    view: View,
    background: Tensor | None = None,
    **options: Any,
) -> Rendering:
    """`rasterize` for a view, without its checks of values; (C,) ``background``, black if None."""
    return rasterize(
        *(world.means, world.quats, world.scales, opacities, colors),
        *(view.world_to_camera, view.K, view.camera.width, view.camera.height),
        background=background,
        check_values=False,
        **options,
    )


def pixel_sums(
    world: WorldSplats, opacities: Tensor, view: View, targets: Tensor, least: float = 0.0
) -> Tensor:
    """(N, C) sums over pixels of (H, W, C) targets times the weight of each splat, its alpha times the transmittance before it.

    They are the derivatives of the sum of a rendering times the targets by the splats' colours. If ``least`` > 0, only
    larger weights count, which takes several times as long.
    """
    if least:
        sums = targets.new_zeros(len(opacities), targets.shape[2])
        width, height = view.camera.width, view.camera.height
        splats, pixels, weights = pixel_weights(
            *world, opacities, view.world_to_camera, view.K, width, height
        )
        counted = weights > least
        values = weights[counted, None] * targets.flatten(0, 1)[pixels[counted]]
        return sums.index_add_(0, splats[counted], values)
    colors = opacities.new_zeros(len(opacities), targets.shape[2]).requires_grad_()
    still = WorldSplats(*(part.detach() for part in world))
    rendering = rasterize_view(still, opacities.detach(), colors, view)
    return torch.autograd.grad((rendering.image * targets).sum(), colors)[0]


def splat_depth(
    world: WorldSplats, opacities: Tensor, camera: Camera, device: str, cutoffs: Cutoffs = USUAL
) -> FloatArray:
    """(H, W) mean depth of splat centres with the blending weights of the colours; NaN where alpha is below 0.5."""
    view = view_of(camera, device, (0.0, 0.0, 0.0))
    axis = view.world_to_camera[2]
    along = (world.means @ axis[:3] + axis[3]).clamp(min=0)[:, None].expand(-1, 3).contiguous()
    drawn = rasterize_view(world, opacities, along, view, view.background, **cutoffs._asdict())
    return _numpy(torch.where(drawn.alpha < 0.5, torch.nan, drawn.image[..., 0] / drawn.alpha))


def _copied_ahead(drawn: Drawn) -> Drawn:
    """Start copying a frame, so that reading it back does not wait for frames drawn later."""
    joined = _joined(drawn)
    host = torch.empty(joined.shape, dtype=joined.dtype, pin_memory=is_cuda(joined.device))
    host.copy_(joined, non_blocking=True)
    ready = torch.cuda.Event()
    ready.record(torch.cuda.current_stream(joined.device))
    return drawn._replace(copy=Copy(host, ready))


def _joined(drawn: Drawn) -> Tensor:
    return torch.cat([drawn.image.reshape(-1), drawn.alpha.reshape(-1)])


def read_back(drawn: Drawn) -> Frame:
    """Copy a drawn frame to host memory, as numpy; from a GPU by one copy."""
    image, alpha = drawn.image, drawn.alpha
    if drawn.copy is not None:
        drawn.copy.ready.synchronize()
    if drawn.copy is not None or not on_host(image):
        host = _joined(drawn).cpu() if drawn.copy is None else drawn.copy.host
        image, alpha = host[: image.numel()].view(image.shape), host[image.numel() :].view(alpha.shape)
    return Frame(_numpy(image), _numpy(alpha))


def posed_splats(world: WorldSplats, opacities: Tensor, colors: Tensor | None) -> PosedSplats:
    """Copy to numpy, since avatars reuse tensors for the next frame."""
    means, quats, scales, of_splats = (_numpy(values).copy() for values in (*world, opacities))
    return PosedSplats(means, quats, scales, of_splats, None if colors is None else _numpy(colors).copy())


def changes_of(values: Mapping[str, Tensor], penalised: BoolArray | None = None) -> Changes:
    """`Changes` of tensors by quantity."""
    return Changes({name: _numpy(each) for name, each in values.items()}, penalised)


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().to("cpu", torch.float32).numpy()


@dataclass(frozen=True)
class View:
    """A camera as tensors, and an optional (C,) background."""

    camera: Camera
    world_to_camera: Tensor
    K: Tensor
    center: Tensor
    background: Tensor


def view_of(camera: Camera, device: str, background: Sequence[float] = ()) -> View:
    """Copy a camera and a background to a device in one transfer."""
    parts = camera.world_to_camera, camera.K, camera.center, [float(channel) for channel in background]
    numbers = np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)
    joined = to_device(torch.from_numpy(numbers), device)
    transform, K, center, behind = joined.split([16, 9, 3, len(background)])
    return View(camera, transform.view(4, 4), K.view(3, 3), center, behind)


def scene_center(poses: Iterable[HeadPose]) -> FloatArray:
    """(3,) reference point near the head in these poses, metres, for worlds with a distant origin.

    Rounded to whole metres: captures around the origin, like all published ones, are unaffected, and differences are exact.
    """
    places = np.array([pose.translation for pose in poses], np.float64)
    return np.asarray(places.mean(axis=0).round())


def scene_extent(cameras: Mapping[str, Camera], center: FloatArray | None = None) -> float:
    """1.1 times the largest distance of a training camera from their mean centre, metres.

    For a single camera, half its distance to ``center`` (the head's position, see `scene_center`; None: the world's origin)
    is used instead, so that learning rates and size thresholds keep their scale.
    """
    centers = np.stack([camera.center for camera in cameras.values()])
    radius = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    if radius < 1e-6:
        radius = 0.5 * float(np.linalg.norm(centers[0] - (0 if center is None else center)))
    return 1.1 * max(radius, 1e-3)


class PlacedSplats(NamedTuple):
    """Splats of a pose in the world: geometry, (N,) opacities, and colours (N, 3) >= 0 seen from a camera's centre."""

    world: WorldSplats
    opacities: Tensor
    colors: Callable[[Tensor], Tensor]


class LastPose(Generic[Value]):
    """Cached result of ``compute`` for the last pose, since several cameras often render one pose."""

    def __init__(self, compute: Callable[[HeadPose, Callable[[str], None]], Value]):
        self._compute = compute
        self._last: tuple[bytes, Value] | None = None

    def __call__(self, pose: HeadPose, end_stage: Callable[[str], None]) -> Value:
        key = pose_key(pose)
        if self._last is None or self._last[0] != key:
            self._last = key, self._compute(pose, end_stage)
        return self._last[1]


class StoredSplatAvatar:
    """Base class of splat avatars.

    - ``stored``: files in the avatar's folder that count towards its size.
    - ``place``: returns the splats of a pose; calls its second argument with "drive" when the mesh is posed.
    """

    def __init__(
        self,
        stored: Sequence[Path],
        place: Callable[[HeadPose, Callable[[str], None]], PlacedSplats],
        device: str,
        cutoffs: Cutoffs = USUAL,
    ):
        self._stored, self._place, self._device, self._cutoffs = stored, place, device, cutoffs
        self._seen: tuple[PlacedSplats, bytes, Tensor] | None = None

    @torch.no_grad()
    def draw(
        self,
        camera: Camera,
        pose: HeadPose,
        background: Sequence[float],
        end_stage: Callable[[str], None] = no_stage,
    ) -> Drawn:
        """Draw one frame, stage by stage; see `StagedAvatar`."""
        placed, view = self._place(pose, end_stage), view_of(camera, self._device, background)
        colors = self._colors(placed, view)
        end_stage("deform")
        return draw_splats(placed.world, placed.opacities, colors, view, end_stage, self._cutoffs)

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Render one frame."""
        return read_back(self.draw(camera, pose, background))

    def read_back(self, drawn: Drawn) -> Frame:
        """A drawn frame in host memory."""
        return read_back(drawn)

    @torch.no_grad()
    def depth(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """See `splat_depth` and `DepthAvatar`."""
        placed = self._place(pose, no_stage)
        return splat_depth(placed.world, placed.opacities, camera, self._device, self._cutoffs)

    @torch.no_grad()
    def splats(self, pose: HeadPose, camera: Camera | None = None) -> PosedSplats:
        """Splats of a pose in the world; with colours if a camera is given."""
        placed = self._place(pose, no_stage)
        colors = None if camera is None else self._colors(placed, view_of(camera, self._device))
        return posed_splats(placed.world, placed.opacities, colors)

    def _colors(self, placed: PlacedSplats, view: View) -> Tensor:
        """Colours of placed splats, cached for the same splats and the same camera position."""
        place = view.camera.center.tobytes()
        if self._seen is None or self._seen[0] is not placed or self._seen[1] != place:
            self._seen = placed, place, placed.colors(view.center)
        return self._seen[2]

    def files(self) -> Sequence[Path]:
        """The files of the avatar."""
        return self._stored

    @property
    def codec(self) -> str:
        """The codec of the files, see `CodedAvatar`."""
        return codec_of(self._stored)

    def shared_files(self) -> Sequence[Path]:
        """The head model."""
        return [path.parent / HEAD_FILE for path in self._stored[:1]]
