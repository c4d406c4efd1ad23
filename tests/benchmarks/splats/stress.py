"""The renderer at numerical extremes: every case against float64, forward and backward, with a verdict."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from ....bench.contracts import Progress
from ....bench.specs import Findings
from ....methods.splats.rasterize import available_backends, rasterize
from ..timing import table
from .extremes import CASES, Case, facing, uneven
from .scenes import Outcome, Scene, head_shell, relative_error, render_with_gradients

FLIPPED = 1e-4
"""A pixel this far off, in units of the largest colour, took another side of a threshold than float64 did. Such pixels
count in the image's error but are left out of the gradients compared."""
FLIPPED_MAX = 0.01
"""At most this part of the pixels may."""


@dataclass(frozen=True)
class Verdict:
    """What came of one case."""

    case: str
    expected: str
    backend: str
    image_error: float | None = None
    """Mean absolute error."""
    gradient_error: float | None = None
    """Relative L2 error of the worst gradient."""
    worst_gradient: str = ""
    flipped: float = 0.0
    """Part of the pixels on another side of a threshold."""
    complaint: str = ""
    """What is wrong; empty where nothing is."""


def measure(quick: bool, progress: Progress) -> Findings:
    """Try every case on every backend; with ``quick`` on the preferred one alone."""
    names = [name for name in available_backends() if name not in ("cpu", "reference")] or ["reference"]
    backends = names[:1] if quick else names
    steps = len(backends) * (len(CASES) + 8)
    verdicts: list[Verdict] = []
    for backend in backends:
        for case in CASES:
            verdicts.append(try_case(case, backend))
            progress(len(verdicts), steps, case.name)
        verdicts += [*non_finite(backend), try_upstream(backend), try_threads(backend)]
    failed = sum(bool(verdict.complaint) for verdict in verdicts)
    rows = [
        (
            *(v.backend, v.case, v.expected),
            *("-" if error is None else f"{error:.1e}" for error in (v.image_error, v.gradient_error)),
            v.worst_gradient or "-",
            v.complaint or "ok",
        )
        for v in verdicts
    ]
    header = ("backend", "case", "expected", "image", "gradient", "of", "verdict")
    text = (
        "Against the float64 reference: mean absolute error of the image, relative L2 error of the worst gradient.\n\n"
        f"{table(header, rows)}\n\n{len(verdicts) - failed} of {len(verdicts)} behave as expected."
    )
    return Findings(text, {"verdicts": [asdict(v) for v in verdicts]}, passed=not failed)


def try_case(case: Case, backend: str) -> Verdict:
    """Render and differentiate one case in float32, and compare with the reference in float64."""
    scene = case.make()
    size = float(max(scene.colors.abs().max() if len(scene.colors) else 0.0, scene.background.abs().max()))
    truth = render_with_gradients(scene, torch.float64, backend="reference", **case.options)
    drawn = render_with_gradients(scene, torch.float32, backend=backend, **case.options)
    error = (drawn.rendering.image - truth.rendering.image).abs().amax(-1)
    same = error <= FLIPPED * size
    if not same.all():
        options = {"weights": same.double(), **case.options}
        truth = render_with_gradients(scene, torch.float64, backend="reference", **options)
        drawn = render_with_gradients(scene, torch.float32, backend=backend, **options)
    errors = {
        name: _gradient_error(drawn.gradients[name], wanted, case.each_quaternion and name == "quats")
        for name, wanted in truth.gradients.items()
        if name in case.compared
    }
    worst = max(errors, key=lambda name: errors[name])
    flipped = 1 - float(same.float().mean())
    return Verdict(
        *(case.name, case.expected, backend, float(error.mean()), errors[worst], worst, flipped),
        complaint=_complaint(case, drawn, float(error.mean()), errors[worst], worst, flipped),
    )


def non_finite(backend: str) -> list[Verdict]:
    """NaN and infinity: refused by default, masked and counted by option."""
    verdicts = []
    for bad in (float("nan"), float("inf"), -float("inf")):
        scene = _poisoned(bad)
        name = f"{bad} in five splats' inputs"
        try:
            rasterize(*scene[:9], background=scene.background, backend=backend)
            complaint = "accepted"
        except ValueError as error:
            complaint = "" if "finite" in str(error) else str(error)
        verdicts.append(Verdict(name, "refused, the argument named", backend, complaint=complaint))
        verdicts.append(_try_masked(scene, name, backend))
    return verdicts


def try_upstream(backend: str) -> Verdict:
    """NaN in the loss's gradient at one pixel reaches the splats there, and no others."""
    scene = facing(2, means=[[-0.3, 0.0, 2.0], [0.3, 0.0, 2.0]], scales=uneven(2, 0.05), opacities=[0.8, 0.8])
    colors = scene.colors.clone().requires_grad_()
    image = rasterize(*scene[:4], colors, *scene[5:9], background=scene.background, backend=backend).image
    upstream = torch.ones_like(image)
    upstream[16, 10] = float("nan")
    (gradient,) = torch.autograd.grad(image, colors, upstream)
    complaint = ""
    if not gradient[0].isnan().all():
        complaint = "hidden from the splat there"
    elif not torch.isfinite(gradient[1]).all():
        complaint = "spread to a splat elsewhere"
    return Verdict(
        "NaN in the image's gradient", "reaches the splats there alone", backend, complaint=complaint
    )


def try_threads(backend: str) -> Verdict:
    """Image and gradients are equal bit for bit, however many threads work."""
    scene = head_shell(1500, 70, 50)
    one, *others = (
        render_with_gradients(scene, torch.float32, backend=backend, threads=threads)
        for threads in (1, 2, 3, 8)
    )
    differs = [
        name
        for other in others
        for name in one.gradients
        if not torch.equal(one.gradients[name], other.gradients[name])
        or not torch.equal(one.rendering.image, other.rendering.image)
    ]
    complaint = f"differs in {', '.join(sorted(set(differs)))}" if differs else ""
    return Verdict("1, 2, 3 and 8 threads", "equal bit for bit", backend, complaint=complaint)


def _poisoned(bad: float) -> Scene:
    scene = facing(30, seed=9)
    for index, name in enumerate(("means", "quats", "scales", "opacities", "colors")):
        value = getattr(scene, name).clone()
        value[index, ...] = bad
        scene = scene._replace(**{name: value})
    return scene


def _try_masked(scene: Scene, name: str, backend: str) -> Verdict:
    drawn = render_with_gradients(scene, torch.float32, backend=backend, mask_non_finite=True)
    rest = scene._replace(**{field: getattr(scene, field)[5:] for field in Scene._fields[:5]})
    without = render_with_gradients(rest, torch.float32, backend=backend)
    complaint = ""
    if drawn.rendering.masked != 5:
        complaint = f"{drawn.rendering.masked} counted, expected 5"
    elif not torch.equal(drawn.rendering.image, without.rendering.image):
        complaint = "the image is not that of the other splats"
    elif any(
        drawn.gradients[field][:5].any()
        or not torch.equal(drawn.gradients[field][5:], without.gradients[field])
        for field in Scene._fields[:5]
    ):
        complaint = "the gradients are not those of the other splats"
    return Verdict(name, "masked by option: left out, counted", backend, complaint=complaint)


def _gradient_error(value: Tensor, truth: Tensor, by_row: bool) -> float:
    if not by_row:
        return relative_error(value, truth)
    rows = (relative_error(a, b) for a, b in zip(value, truth, strict=True))
    return max(rows, default=0.0)


def _complaint(
    case: Case, drawn: Outcome, image_error: float, gradient_error: float, worst: str, flipped: float
) -> str:
    if not all(torch.isfinite(value).all() for value in (drawn.rendering.image, drawn.rendering.alpha)):
        return "the image is not finite"
    bad = [name for name, gradient in drawn.gradients.items() if not torch.isfinite(gradient).all()]
    if bad:
        return f"gradients of {', '.join(bad)} are not finite"
    if not image_error <= case.image:
        return f"image error {image_error:.1e} over {case.image:.0e}"
    if not gradient_error <= case.gradient:
        return f"gradient error of {worst} {gradient_error:.1e} over {case.gradient:.0e}"
    if flipped > FLIPPED_MAX:
        return f"{100 * flipped:.1f} % of the pixels on another side of a threshold"
    return case.complaint(drawn)
