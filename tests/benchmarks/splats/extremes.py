"""Numerical extremes as scenes, each with what is expected of it.

Cases are small: their truth is the float64 reference. Bounds are on float32 arithmetic, whatever the instruction set:
the mean absolute error of the image (colours of order 1), and the relative L2 error of the worst gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ....methods.splats.constants import ALPHA_MIN
from .scenes import DIFFERENTIABLE, Outcome, Scene, cloud

TIGHT = 1e-4  # of gradients where float32 loses nothing; 2e-4 for quaternions is within


def no_complaint(outcome: Outcome) -> str:
    """Nothing is asked of the outcome beyond its errors."""
    return ""


@dataclass(frozen=True)
class Case:
    """One extreme."""

    name: str
    expected: str
    make: Callable[[], Scene]
    image: float = 1e-6
    gradient: float = TIGHT
    each_quaternion: bool = False
    """Whether gradients of quaternions are compared splat by splat, being of very different sizes."""
    compared: tuple[str, ...] = DIFFERENTIABLE
    """The gradients that have a bound; all must be finite."""
    options: Mapping[str, Any] = field(default_factory=dict)
    complaint: Callable[[Outcome], str] = no_complaint
    """Says what is wrong with the outcome beyond its errors, or nothing."""


def uneven(count: int, scale: float) -> Tensor:
    """Scales (count, 3) of about ``scale``: equal ones would leave quaternions without a gradient to compare."""
    return scale * torch.tensor([1.0, 0.8, 0.6]).repeat(count, 1)


def facing(count: int, size: int = 32, *, seed: int = 0, spread: float = 0.25, **fields: Any) -> Scene:
    """Splats about the axis of a camera at the origin, two metres off; ``fields`` replace the first rows."""
    rng = torch.Generator().manual_seed(seed)
    scene = cloud(count, size, size, seed=seed)._replace(
        means=torch.tensor([0.0, 0.0, 2.0]) + spread * torch.randn(count, 3, generator=rng),
        scales=0.05 * torch.exp(0.5 * torch.randn(count, 3, generator=rng)),
        opacities=torch.full((count,), 0.4),
        viewmat=torch.eye(4),
        K=torch.tensor([[1.2 * size, 0, 0.5 * size + 0.3], [0, 1.2 * size, 0.5 * size - 0.2], [0, 0, 1]]),
    )
    for name, rows in fields.items():
        value = getattr(scene, name).clone()
        given = torch.as_tensor(rows, dtype=value.dtype)
        value[: len(given)] = given
        scene = scene._replace(**{name: value})
    return scene


def culled(*indices: int) -> Callable[[Outcome], str]:
    """Ask that just these splats are out of view and get no gradient."""

    def complaint(outcome: Outcome) -> str:
        found = (outcome.rendering.radii == 0).nonzero().flatten().tolist()
        if found != sorted(indices):
            return f"out of view are {found}, expected {sorted(indices)}"
        return _moved(outcome, indices)

    return complaint


def too_faint(*indices: int) -> Callable[[Outcome], str]:
    """Ask that these splats get no gradient, although they are in view as all others are."""

    def complaint(outcome: Outcome) -> str:
        hidden = (outcome.rendering.radii == 0).nonzero().flatten().tolist()
        return f"out of view are {hidden}" if hidden else _moved(outcome, indices)

    return complaint


def _moved(outcome: Outcome, indices: Sequence[int]) -> str:
    for name in ("means", "quats", "scales", "opacities", "colors", "means2d_offset"):
        if outcome.gradients[name][list(indices)].any():
            return f"splats that are not drawn have a gradient of {name}"
    return ""


def _background_alone(outcome: Outcome) -> str:
    if outcome.rendering.alpha.any():
        return "something is drawn"
    moved = [name for name, gradient in outcome.gradients.items() if gradient.any() and name != "background"]
    return f"gradients of {', '.join(moved)}" if moved else ""


def _clamped_alpha(outcome: Outcome) -> str:
    highest = float(outcome.rendering.alpha.max())
    return "" if abs(highest - 0.99) < 1e-6 else f"alpha reaches {highest}, expected 0.99"


def _first_alone(outcome: Outcome) -> str:
    middle = outcome.rendering.alpha[8, 8].item()
    return "" if abs(middle - 0.99) < 1e-6 else f"alpha of {middle} in the middle, expected 0.99"


def _in_range(outcome: Outcome) -> str:
    low, high = float(outcome.rendering.alpha.min()), float(outcome.rendering.alpha.max())
    return "" if 0 <= low <= high <= 1 else f"alpha from {low} to {high}"


def _depths(values: list[float]) -> Tensor:
    return torch.tensor([[0.05 * z * (i % 3 - 1), 0.03 * z * (i % 2), z] for i, z in enumerate(values)])


def _wide_outside() -> Scene:
    return facing(
        2,
        means=[[2.6, 0.1, 1.0], [-0.3, -2.4, 1.1]],
        scales=[[0.9, 0.8, 0.7], [0.7, 0.9, 0.6]],
        opacities=[0.8, 0.7],
    )


def _wide_beside_an_off_centre_image() -> Scene:
    """The principal point is near a corner, so the slopes are clamped at other values on either side."""
    scene = facing(
        4,
        means=[[2.3, 0.1, 1.0], [-1.05, 0.1, 1.0], [0.4, -2.4, 1.1], [0.3, 0.9, 1.0]],
        scales=[[0.9, 0.8, 0.7], [0.7, 0.9, 0.6], [0.8, 0.7, 0.9], [0.6, 0.7, 0.8]],
        opacities=[0.8, 0.7, 0.8, 0.7],
    )
    K = scene.K.clone()
    K[0, 2], K[1, 2] = 0.1 * scene.width, 0.95 * scene.height
    return scene._replace(K=K)


def _far_from_a_turned_camera() -> Scene:
    """Four means whose products with the camera's rotation overflow, of either sign; the others are in its sight."""
    scene = facing(8)
    viewmat = cloud(1, 8, 8).viewmat
    means = (scene.means - viewmat[:3, 3]) @ viewmat[:3, :3]
    means[:4] = 3e38 * torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]])
    return scene._replace(means=means, viewmat=viewmat)


def _crowd(count: int) -> Scene:
    """Faint splats of about a pixel, scattered over a quarter of a tile."""
    scene = facing(count, 8, spread=0.0, scales=uneven(count, 0.003), opacities=[0.0045] * count)
    place = torch.rand(count, 3, generator=torch.Generator().manual_seed(4)) - 0.5
    return scene._replace(means=scene.means + place * torch.tensor([1.7, 1.7, 0.1]))


def _one_splat(**fields: Any) -> Scene:
    return facing(1, means=[[0.0, 0.0, 2.0]], scales=uneven(1, 0.2), **fields)


def _layers(count: int, opacity: float) -> Scene:
    """Splats wider than the image, one behind the other."""
    z = torch.linspace(1.5, 2.5, count)
    means = torch.stack([0.02 * torch.sin(7 * z), 0.02 * torch.cos(5 * z), z], dim=1)
    return facing(count, 16, means=means, scales=uneven(count, 2.0), opacities=[opacity] * count)


def _same_depth(count: int) -> Scene:
    scene = facing(count, seed=1)
    means = scene.means.clone()
    means[:, 2] = 2.0
    return scene._replace(means=means, scales=3 * scene.scales)


def _one_ulp_apart(count: int) -> Scene:
    scene = _same_depth(count)
    steps = torch.randperm(count, generator=torch.Generator().manual_seed(2))
    means = scene.means.clone()
    means[:, 2] = (means[:, 2].view(torch.int32) + steps.to(torch.int32)).view(torch.float32)
    return scene._replace(means=means)


def _needles(length: float, **fields: Any) -> Scene:
    count = 12
    scales = torch.tensor([length, 1e-4, 1e-4]).repeat(count, 1)
    return facing(count, 48, seed=3, spread=0.1, scales=scales, **fields)


def _scaled_colors(scene: Scene, factor: float) -> Scene:
    return scene._replace(colors=factor * scene.colors, background=-factor * scene.background)


CASES = (
    Case(
        "behind, on and before the near plane",
        "culled up to and on the plane; finite just beyond it",
        lambda: facing(12, means=_depths([-1.0, 0.0, 0.005, 0.01, 0.0101, 0.011]), scales=[[1e-3] * 3] * 6),
        complaint=culled(0, 1, 2, 3),
    ),
    Case(
        "near plane at 0.2 m",
        "culled before it",
        lambda: facing(12, means=_depths([-1.0, 0.1, 0.199, 0.201, 0.25]), scales=[[1e-2] * 3] * 5),
        options={"near": 0.2},
        complaint=culled(0, 1, 2),
    ),
    Case(
        "beyond the far plane",
        "culled at and beyond it",
        lambda: facing(8, means=[[0.0, 0, 100.0], [0, 0, 101.0], [0, 0, 3e38]]),
        options={"far": 100.0},
        complaint=culled(0, 1, 2),
    ),
    Case(
        "enormous splat just beyond the near plane",
        "drawn, finite",
        lambda: facing(6, means=[[0.0, 0.0, 0.0101]], opacities=[0.3]),
        gradient=1e-3,
    ),
    Case(
        "wide splats beyond the clamped slopes",
        "gradient of the clamped Jacobian",
        _wide_outside,
        gradient=1e-3,
    ),
    Case(
        "the same beside an image with its principal point near a corner",
        "clamped by that point, not symmetrically",
        _wide_beside_an_off_centre_image,
    ),
    Case(
        "splats far outside, 1e6 to 1e30 m aside",
        "culled, finite",
        lambda: facing(8, means=[[1e6, 0, 2.0], [0, -1e10, 0.02], [1e30, 1e30, 2.0]]),
        complaint=culled(0, 1, 2),
    ),
    Case(
        "splats 3e38 m off in every axis, the camera turned",
        "culled, finite",
        _far_from_a_turned_camera,
        complaint=culled(0, 1, 2, 3),
    ),
    Case(
        "far smaller than a pixel",
        "the low-pass filter's footprint",
        lambda: facing(20, scales=uneven(20, 1e-6), opacities=[0.9] * 20),
    ),
    Case(
        "the same, antialiased",
        "fainter than 1/255: not drawn",
        lambda: facing(20, scales=uneven(20, 1e-6), opacities=[0.9] * 20),
        options={"antialiased": True},
        complaint=_background_alone,
    ),
    Case(
        "a tenth of a pixel wide, antialiased",
        "faint by the ratio of determinants",
        lambda: facing(20, scales=uneven(20, 0.005), opacities=[0.9] * 20),
        options={"antialiased": True},
    ),
    Case(
        "without the low-pass filter, half a pixel wide",
        "drawn sharp",
        lambda: facing(20, scales=uneven(20, 0.03), opacities=[0.9] * 20),
        options={"eps2d": 0.0},
    ),
    Case("needles 100 px long, 0.55 px thin", "the thin side survives", lambda: _needles(1.5), gradient=1e-3),
    Case(
        "needles 4000 px long, 0.55 px thin",
        "drawn as exactly; gradients along the needle lose digits",
        lambda: _needles(60.0),
        gradient=2e-2,
        complaint=_in_range,
    ),
    Case(
        "needles 16000 px long, 0.55 px thin",
        "drawn as exactly; gradients along the needle lose digits",
        lambda: _needles(240.0),
        gradient=0.2,
        complaint=_in_range,
    ),
    Case(
        "needles, antialiased",
        "the thin side decides the factor",
        lambda: _needles(1.5, opacities=[0.9] * 12),
        gradient=2e-3,
        options={"antialiased": True},
    ),
    Case(
        "scales of 1e4 m",
        "flat over the image; geometry has next to no gradient",
        lambda: facing(6, scales=[[1e4, 8e3, 6e3], [1e4, 1e-3, 1e-3]], opacities=[0.3, 0.3]),
        gradient=1e-3,
        compared=("opacities", "colors", "background"),
    ),
    Case(
        "scales of 1e12 m to 1e38 m",
        "culled: float32 does not resolve them",
        lambda: facing(8, scales=[[1e12] * 3, [1e20] * 3, [3e38] * 3]),
        complaint=culled(0, 1, 2),
    ),
    Case(
        "scales of zero and 1e-38 m",
        "drawn by the filter alone, finite",
        lambda: facing(8, scales=[[0.0, 0, 0], [0.1, 0, 0], [1e-38] * 3, [0.1, 0.1, 0]]),
    ),
    Case(
        "quaternions from 1e-40 to 4e38 long, and zero",
        "direction alone counts; zero is the identity",
        lambda: facing(
            9,
            spread=0.2,
            quats=[
                [0.5 * s, -0.3 * s, 0.7 * s, 0.4 * s]
                for s in (1.0, 4e38, 1e20, 1e-6, 1e-11, 3e-13, 1e-14, 1e-40, 0.0)
            ],
            scales=[[0.2, 0.05, 0.1]] * 9,
        ),
        gradient=2e-3,
        each_quaternion=True,
    ),
    Case(
        "opacities of 0, below 1/255 and at it",
        "in view, not drawn below, without a gradient",
        lambda: facing(
            9, spread=0.05, opacities=[0.0, 0.5 * ALPHA_MIN, 0.999 * ALPHA_MIN, 1.001 * ALPHA_MIN, 1.0]
        ),
        complaint=too_faint(0, 1, 2),
    ),
    Case(
        "opacity 1",
        "alpha clamped to 0.99, no gradient through the clamp",
        lambda: _one_splat(opacities=[1.0]),
        complaint=_clamped_alpha,
    ),
    Case(
        "opaque splats one behind the other",
        "stops at the second, whose light would be 1e-4",
        lambda: _layers(3, 1.0),
        complaint=_first_alone,
    ),
    Case(
        "150 layers of alpha 0.05",
        "transmittance recovered by division loses little",
        lambda: _layers(150, 0.05),
        gradient=2e-4,
    ),
    Case("40 layers of alpha 0.98", "stops where transmittance would reach 1e-4", lambda: _layers(40, 0.98)),
    Case(
        "1500 splats of opacity 1/200 in a tile",
        "long lists, thresholds everywhere",
        lambda: facing(1500, 16, spread=0.1, scales=uneven(1500, 0.6), opacities=[0.005] * 1500),
        image=2e-6,
        gradient=5e-4,
    ),
    Case("66 000 splats in a tile", "more than 16 bits count", lambda: _crowd(66_000), gradient=5e-4),
    Case("equal depths", "in the order of their indices", lambda: _same_depth(60)),
    Case("depths one unit in the last place apart", "in the order of depth", lambda: _one_ulp_apart(60)),
    Case(
        "depths from 0.02 m to 1e9 m",
        "in the order of depth, finite",
        lambda: facing(
            12,
            means=_depths([1e9, 0.02, 1e3, 0.5, 1e6, 30.0]),
            scales=[[z * 0.04] * 3 for z in (1e9, 0.02, 1e3, 0.5, 1e6, 30.0)],
        ),
    ),
    Case("no splats", "the background", lambda: facing(0), complaint=_background_alone),
    Case(
        "all splats behind the camera",
        "the background",
        lambda: facing(9, means=[[0.0, 0.0, -2.0]] * 9),
        complaint=_background_alone,
    ),
    Case("one pixel", "drawn", lambda: cloud(200, 1, 1, seed=6, size=0.2), gradient=2e-4),
    Case("one row of 50 pixels", "drawn", lambda: cloud(150, 50, 1, seed=7, size=0.1), gradient=2e-4),
    Case("17 x 33 pixels, 32 channels", "drawn", lambda: cloud(80, 17, 33, seed=8, channels=32)),
    Case(
        "colours and background of 1e6 and -1e6",
        "errors relative to them",
        lambda: _scaled_colors(facing(30), 1e6),
        image=1.0,
    ),
    Case(
        "colours and background of 1e30 and -1e30",
        "finite; errors relative to them",
        lambda: _scaled_colors(facing(30), 1e30),
        image=1e24,
    ),
)
