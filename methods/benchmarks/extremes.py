"""``headbench doctor stress splats``: the renderer at numerical extremes, forward and backward, each with a verdict.

Cases are small: their true values are from the float64 reference. Bounds hold for float32 arithmetic with any instruction set:
the mean absolute error of the image (colours of order 1), and the relative L2 error of the worst gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from ...bench.contracts import Progress
from ...bench.doctor import Row, table
from ...bench.specs import CommandResult
from ..splats.rasterize import available_backends, rasterize
from ..splats.request import ALPHA_MIN
from .splats import (
    DIFFERENTIABLE,
    DrawnScene,
    SplatScene,
    cloud,
    head_shell,
    relative_error,
    render_with_gradients,
)

TIGHT = 1e-4  # of gradients where float32 loses nothing; 2e-4 for quaternions is within
FLIPPED = 1e-4
"""A pixel with a larger error, in units of the largest colour, was on the other side of a threshold in float64. Such pixels
count in the image's error but are excluded from the comparison of gradients."""
FLIPPED_MAX = 0.01
"""Maximum fraction of such pixels."""


@dataclass(frozen=True)
class Extreme:
    """A test case with extreme inputs."""

    name: str
    make: Callable[[], SplatScene]
    image: float = 1e-6
    gradient: float = TIGHT
    each_quaternion: bool = False
    """Whether gradients of quaternions are compared splat by splat, being of very different sizes."""
    compared: tuple[str, ...] = DIFFERENTIABLE
    """The gradients that have a bound; all must be finite."""
    options: Mapping[str, Any] = field(default_factory=dict)
    complaint: Callable[[DrawnScene], str] = lambda outcome: ""
    """Further check of the result; returns a fault, or an empty text."""


def uneven(count: int, scale: float) -> Tensor:
    """Scales (count, 3) of about ``scale``: equal ones would leave quaternions without a gradient to compare."""
    return scale * torch.tensor([1.0, 0.8, 0.6]).repeat(count, 1)


def facing(count: int, size: int = 32, *, seed: int = 0, spread: float = 0.25, **fields: Any) -> SplatScene:
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


def culled(*indices: int) -> Callable[[DrawnScene], str]:
    """Check that exactly these splats are out of view and get no gradient."""

    def complaint(outcome: DrawnScene) -> str:
        found = (outcome.rendering.radii == 0).nonzero().flatten().tolist()
        if found != sorted(indices):
            return f"out of view are {found}, expected {sorted(indices)}"
        return _moved(outcome, indices)

    return complaint


def too_faint(*indices: int) -> Callable[[DrawnScene], str]:
    """Check that these splats get no gradient, although all splats are in view."""

    def complaint(outcome: DrawnScene) -> str:
        hidden = (outcome.rendering.radii == 0).nonzero().flatten().tolist()
        return f"out of view are {hidden}" if hidden else _moved(outcome, indices)

    return complaint


def _moved(outcome: DrawnScene, indices: Sequence[int]) -> str:
    for name in ("means", "quats", "scales", "opacities", "colors", "means2d_offset"):
        if outcome.gradients[name][list(indices)].any():
            return f"splats that are not drawn have a gradient of {name}"
    return ""


def _background_alone(outcome: DrawnScene) -> str:
    if outcome.rendering.alpha.any():
        return "something is drawn"
    moved = [name for name, gradient in outcome.gradients.items() if gradient.any() and name != "background"]
    return f"gradients of {', '.join(moved)}" if moved else ""


def _clamped_alpha(outcome: DrawnScene) -> str:
    highest = float(outcome.rendering.alpha.max())
    return "" if abs(highest - 0.99) < 1e-6 else f"alpha reaches {highest}, expected 0.99"


def _first_alone(outcome: DrawnScene) -> str:
    middle = outcome.rendering.alpha[8, 8].item()
    return "" if abs(middle - 0.99) < 1e-6 else f"alpha of {middle} in the middle, expected 0.99"


def _in_range(outcome: DrawnScene) -> str:
    low, high = float(outcome.rendering.alpha.min()), float(outcome.rendering.alpha.max())
    return "" if 0 <= low <= high <= 1 else f"alpha from {low} to {high}"


def _depths(values: list[float]) -> Tensor:
    return torch.tensor([[0.05 * z * (i % 3 - 1), 0.03 * z * (i % 2), z] for i, z in enumerate(values)])


def _wide_outside() -> SplatScene:
    return facing(
        2,
        means=[[2.6, 0.1, 1.0], [-0.3, -2.4, 1.1]],
        scales=[[0.9, 0.8, 0.7], [0.7, 0.9, 0.6]],
        opacities=[0.8, 0.7],
    )


def _wide_beside_an_off_centre_image() -> SplatScene:
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


def _far_from_a_turned_camera() -> SplatScene:
    """Four means whose products with the camera's rotation overflow, of either sign; the others are in its sight."""
    scene = facing(8)
    viewmat = cloud(1, 8, 8).viewmat
    means = (scene.means - viewmat[:3, 3]) @ viewmat[:3, :3]
    means[:4] = 3e38 * torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]])
    return scene._replace(means=means, viewmat=viewmat)


def _crowd(count: int) -> SplatScene:
    """Faint splats of about a pixel, scattered over a quarter of a tile."""
    scene = facing(count, 8, spread=0.0, scales=uneven(count, 0.003), opacities=[0.0045] * count)
    place = torch.rand(count, 3, generator=torch.Generator().manual_seed(4)) - 0.5
    return scene._replace(means=scene.means + place * torch.tensor([1.7, 1.7, 0.1]))


def _layers(count: int, opacity: float) -> SplatScene:
    """Splats wider than the image, one behind the other."""
    z = torch.linspace(1.5, 2.5, count)
    means = torch.stack([0.02 * torch.sin(7 * z), 0.02 * torch.cos(5 * z), z], dim=1)
    return facing(count, 16, means=means, scales=uneven(count, 2.0), opacities=[opacity] * count)


def _same_depth(count: int) -> SplatScene:
    scene = facing(count, seed=1)
    means = scene.means.clone()
    means[:, 2] = 2.0
    return scene._replace(means=means, scales=3 * scene.scales)


def _one_ulp_apart(count: int) -> SplatScene:
    scene = _same_depth(count)
    steps = torch.randperm(count, generator=torch.Generator().manual_seed(2))
    means = scene.means.clone()
    means[:, 2] = (means[:, 2].view(torch.int32) + steps.to(torch.int32)).view(torch.float32)
    return scene._replace(means=means)


def _needles(length: float, **fields: Any) -> SplatScene:
    count = 12
    scales = torch.tensor([length, 1e-4, 1e-4]).repeat(count, 1)
    return facing(count, 48, seed=3, spread=0.1, scales=scales, **fields)


def _scaled_colors(scene: SplatScene, factor: float) -> SplatScene:
    return scene._replace(colors=factor * scene.colors, background=-factor * scene.background)


EXTREMES = (
    Extreme(
        "behind, on and before the near plane",
        lambda: facing(12, means=_depths([-1.0, 0.0, 0.005, 0.01, 0.0101, 0.011]), scales=[[1e-3] * 3] * 6),
        complaint=culled(0, 1, 2, 3),
    ),
    Extreme(
        "near plane at 0.2 m",
        lambda: facing(12, means=_depths([-1.0, 0.1, 0.199, 0.201, 0.25]), scales=[[1e-2] * 3] * 5),
        options={"near": 0.2},
        complaint=culled(0, 1, 2),
    ),
    Extreme(
        "beyond the far plane",
        lambda: facing(8, means=[[0.0, 0, 100.0], [0, 0, 101.0], [0, 0, 3e38]]),
        options={"far": 100.0},
        complaint=culled(0, 1, 2),
    ),
    Extreme(
        "enormous splat just beyond the near plane",
        lambda: facing(6, means=[[0.0, 0.0, 0.0101]], opacities=[0.3]),
        gradient=1e-3,
    ),
    Extreme("wide splats beyond the clamped slopes", _wide_outside, gradient=1e-3),
    Extreme(
        "the same beside an image with its principal point near a corner", _wide_beside_an_off_centre_image
    ),
    Extreme(
        "splats far outside, 1e6 to 1e30 m aside",
        lambda: facing(8, means=[[1e6, 0, 2.0], [0, -1e10, 0.02], [1e30, 1e30, 2.0]]),
        complaint=culled(0, 1, 2),
    ),
    Extreme(
        "splats 3e38 m off in every axis, the camera turned",
        _far_from_a_turned_camera,
        complaint=culled(0, 1, 2, 3),
    ),
    Extreme("far smaller than a pixel", lambda: facing(20, scales=uneven(20, 1e-6), opacities=[0.9] * 20)),
    Extreme(
        "the same, antialiased",
        lambda: facing(20, scales=uneven(20, 1e-6), opacities=[0.9] * 20),
        options={"antialiased": True},
        complaint=_background_alone,
    ),
    Extreme(
        "a tenth of a pixel wide, antialiased",
        lambda: facing(20, scales=uneven(20, 0.005), opacities=[0.9] * 20),
        options={"antialiased": True},
    ),
    Extreme(
        "without the low-pass filter, half a pixel wide",
        lambda: facing(20, scales=uneven(20, 0.03), opacities=[0.9] * 20),
        options={"eps2d": 0.0},
    ),
    Extreme("needles 100 px long, 0.55 px thin", lambda: _needles(1.5), gradient=1e-3),
    Extreme("needles 4000 px long, 0.55 px thin", lambda: _needles(60.0), gradient=2e-2, complaint=_in_range),
    Extreme(
        "needles 16000 px long, 0.55 px thin", lambda: _needles(240.0), gradient=0.2, complaint=_in_range
    ),
    Extreme(
        "needles, antialiased",
        lambda: _needles(1.5, opacities=[0.9] * 12),
        gradient=2e-3,
        options={"antialiased": True},
    ),
    Extreme(
        "scales of 1e4 m",
        lambda: facing(6, scales=[[1e4, 8e3, 6e3], [1e4, 1e-3, 1e-3]], opacities=[0.3, 0.3]),
        gradient=1e-3,
        compared=("opacities", "colors", "background"),
    ),
    Extreme(
        "scales of 1e12 m to 1e38 m",
        lambda: facing(8, scales=[[1e12] * 3, [1e20] * 3, [3e38] * 3]),
        complaint=culled(0, 1, 2),
    ),
    Extreme(
        "scales of zero and 1e-38 m",
        lambda: facing(8, scales=[[0.0, 0, 0], [0.1, 0, 0], [1e-38] * 3, [0.1, 0.1, 0]]),
    ),
    Extreme(
        "quaternions from 1e-40 to 4e38 long, and zero",
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
    Extreme(
        "opacities of 0, below 1/255 and at it",
        lambda: facing(
            9, spread=0.05, opacities=[0.0, 0.5 * ALPHA_MIN, 0.999 * ALPHA_MIN, 1.001 * ALPHA_MIN, 1.0]
        ),
        complaint=too_faint(0, 1, 2),
    ),
    Extreme(
        "opacity 1",
        lambda: facing(1, means=[[0.0, 0.0, 2.0]], scales=uneven(1, 0.2), opacities=[1.0]),
        complaint=_clamped_alpha,
    ),
    Extreme("opaque splats one behind the other", lambda: _layers(3, 1.0), complaint=_first_alone),
    Extreme("150 layers of alpha 0.05", lambda: _layers(150, 0.05), gradient=2e-4),
    Extreme("40 layers of alpha 0.98", lambda: _layers(40, 0.98)),
    Extreme(
        "1500 splats of opacity 1/200 in a tile",
        lambda: facing(1500, 16, spread=0.1, scales=uneven(1500, 0.6), opacities=[0.005] * 1500),
        image=2e-6,
        gradient=5e-4,
    ),
    Extreme("66 000 splats in a tile", lambda: _crowd(66_000), gradient=5e-4),
    Extreme("equal depths", lambda: _same_depth(60)),
    Extreme("depths one unit in the last place apart", lambda: _one_ulp_apart(60)),
    Extreme(
        "depths from 0.02 m to 1e9 m",
        lambda: facing(
            12,
            means=_depths([1e9, 0.02, 1e3, 0.5, 1e6, 30.0]),
            scales=[[z * 0.04] * 3 for z in (1e9, 0.02, 1e3, 0.5, 1e6, 30.0)],
        ),
    ),
    Extreme("no splats", lambda: facing(0), complaint=_background_alone),
    Extreme(
        "all splats behind the camera",
        lambda: facing(9, means=[[0.0, 0.0, -2.0]] * 9),
        complaint=_background_alone,
    ),
    Extreme("one pixel", lambda: cloud(200, 1, 1, seed=6, size=0.2), gradient=2e-4),
    Extreme("one row of 50 pixels", lambda: cloud(150, 50, 1, seed=7, size=0.1), gradient=2e-4),
    Extreme("17 x 33 pixels, 32 channels", lambda: cloud(80, 17, 33, seed=8, channels=32)),
    Extreme("colours and background of 1e6 and -1e6", lambda: _scaled_colors(facing(30), 1e6), image=1.0),
    Extreme("colours and background of 1e30 and -1e30", lambda: _scaled_colors(facing(30), 1e30), image=1e24),
)


def stress(quick: bool, progress: Progress) -> CommandResult:
    """Try every case on every backend; with ``quick`` on the preferred one alone."""
    names = [name for name in available_backends() if name not in ("cpu", "reference")] or ["reference"]
    rows: list[Row] = []
    for backend in names[:1] if quick else names:
        for number, case in enumerate(EXTREMES):
            progress(number, len(EXTREMES), f"{backend}, {case.name}")
            rows.append(try_extreme(case, backend))
        for name, complaint in special_cases(backend).items():
            rows.append({"backend": backend, "case": name, "verdict": complaint or "ok"})
    sound = sum(row["verdict"] == "ok" for row in rows)
    text = (
        "Against the float64 reference: mean absolute error of the image, relative L2 error of the worst gradient.\n\n"
        f"{table(rows)}\n\n{sound} of {len(rows)} behave as expected."
    )
    return CommandResult(text, {"verdicts": rows}, passed=sound == len(rows))


def try_extreme(case: Extreme, backend: str) -> Row:
    """Render and differentiate a case in float32, and compare with the reference in float64."""
    scene = case.make()
    size = float(max(scene.colors.abs().max() if len(scene.colors) else 0.0, scene.background.abs().max()))
    weights = None
    for _ in range(2):
        options = {"weights": weights, **case.options}
        truth = render_with_gradients(scene, torch.float64, backend="reference", **options)
        drawn = render_with_gradients(scene, torch.float32, backend=backend, **options)
        error = (drawn.rendering.image - truth.rendering.image).abs().amax(-1)
        same = error <= FLIPPED * size
        if same.all():
            break
        weights = same.double()
    errors = {
        name: _gradient_error(drawn.gradients[name], truth.gradients[name], case, name)
        for name in case.compared
    }
    worst = max(errors, key=lambda name: errors[name])
    image, gradient = float(error.mean()), errors[worst]
    bad = [name for name, value in drawn.gradients.items() if not torch.isfinite(value).all()]
    complaint = ""
    if not all(torch.isfinite(value).all() for value in (drawn.rendering.image, drawn.rendering.alpha)):
        complaint = "the image is not finite"
    elif bad:
        complaint = f"gradients of {', '.join(bad)} are not finite"
    elif not image <= case.image:
        complaint = f"image error over {case.image:.0e}"
    elif not gradient <= case.gradient:
        complaint = f"gradient error of {worst} over {case.gradient:.0e}"
    elif not same.float().mean() >= 1 - FLIPPED_MAX:
        complaint = f"{int((~same).sum())} pixels on another side of a threshold"
    verdict = complaint or case.complaint(drawn) or "ok"
    columns = {"image error": image, "gradient error": gradient, "worst gradient": worst, "verdict": verdict}
    return {"backend": backend, "case": case.name, **columns}


def _gradient_error(value: Tensor, truth: Tensor, case: Extreme, name: str) -> float:
    if name == "quats" and case.each_quaternion:
        return max((relative_error(a, b) for a, b in zip(value, truth, strict=True)), default=0.0)
    return relative_error(value, truth)


def special_cases(backend: str) -> dict[str, str]:
    """Faults with non-finite values and other numbers of threads, by case; empty for none."""
    results = {}
    for bad in (float("nan"), float("inf"), -float("inf")):
        scene = poisoned(bad)
        try:
            rasterize(*scene[:9], background=scene.background, backend=backend)
            results[f"{bad} in five splats' inputs"] = "accepted"
        except ValueError as error:
            results[f"{bad} in five splats' inputs"] = "" if "finite" in str(error) else str(error)
    results["NaN in the image's gradient at one splat"] = _upstream(backend)
    results["1, 2, 3 and 8 threads, bit for bit"] = _threads(backend)
    return results


def poisoned(bad: float) -> SplatScene:
    """Thirty splats; in each of the first five, one input has the given value."""
    scene = facing(30, seed=9)
    for index, name in enumerate(("means", "quats", "scales", "opacities", "colors")):
        value = getattr(scene, name).clone()
        value[index, ...] = bad
        scene = scene._replace(**{name: value})
    return scene


def _upstream(backend: str) -> str:
    """NaN in the loss's gradient at one pixel has to reach the splats there, and no others."""
    scene = facing(2, means=[[-0.3, 0.0, 2.0], [0.3, 0.0, 2.0]], scales=uneven(2, 0.05), opacities=[0.8, 0.8])
    colors = scene.colors.clone().requires_grad_()
    image = rasterize(*scene[:4], colors, *scene[5:9], background=scene.background, backend=backend).image
    upstream = torch.ones_like(image)
    upstream[16, 10] = float("nan")
    (gradient,) = torch.autograd.grad(image, colors, upstream)
    if not gradient[0].isnan().all():
        return "hidden from the splat there"
    return "" if torch.isfinite(gradient[1]).all() else "spread to a splat elsewhere"


def _threads(backend: str) -> str:
    scene = head_shell(1500, 70, 50)
    one, *others = (
        render_with_gradients(scene, torch.float32, backend=backend, threads=threads)
        for threads in (1, 2, 3, 8)
    )
    same = all(
        torch.equal(one.rendering.image, other.rendering.image)
        and all(torch.equal(value, other.gradients[name]) for name, value in one.gradients.items())
        for other in others
    )
    return "" if same else "image or gradients differ"
