"""``headbench stress head``: the head model at numerical extremes, each case with what is expected of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import Progress
from ....bench.specs import Findings
from ....datasets.head.arrays import HeadArrays
from ....datasets.head.model import HeadModel
from ....datasets.head.procedural.model import procedural_head

_ANGLES = ("rotation", "neck", "jaw", "eyes")
FLOAT32 = 1e-6
"""Largest error of float32 vertices as a part of the mesh's extent, including coefficients of ten deviations."""


@dataclass(frozen=True)
class Case:
    """One extreme: the arguments it changes."""

    name: str
    change: Callable[[dict[str, Tensor]], dict[str, Tensor]]
    head: Callable[[HeadArrays], HeadArrays] = lambda head: head


@dataclass(frozen=True)
class Verdict:
    """What came of one case."""

    case: str
    float32_error: float
    """Largest error of a vertex as a part of the mesh's extent."""
    paths_error: float
    """Largest difference of fast and readable path in float64, as a part of the mesh's extent."""
    gradient_error: float
    """Of the readable path's float32 gradients against float64, relative, the worst argument's."""
    complaint: str
    """What is wrong; empty where nothing is."""


def _turned(name: str, vector: tuple[float, ...]) -> Callable[[dict[str, Tensor]], dict[str, Tensor]]:
    def change(a: dict[str, Tensor]) -> dict[str, Tensor]:
        rows = torch.tensor(vector * (a[name].shape[1] // len(vector)), dtype=a[name].dtype)
        return {**a, name: rows.expand_as(a[name]).clone()}

    return change


def _at_rest(a: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.zeros_like(value) if name in _ANGLES else value for name, value in a.items()}


def _scaled(factor: float, *names: str) -> Callable[[dict[str, Tensor]], dict[str, Tensor]]:
    return lambda a: {
        name: factor * torch.sign(value) if name in names else value for name, value in a.items()
    }


def _far(a: dict[str, Tensor]) -> dict[str, Tensor]:
    return {**a, "translation": a["translation"] + 100.0}


def _collapsed(head: HeadArrays) -> HeadArrays:
    """Every tenth triangle to a point, every tenth to a line."""
    template = head.template.copy()
    points, lines = head.faces[::10], head.faces[5::10]
    template[points[:, 1:]] = template[points[:, :1]]
    template[lines[:, 2]] = 0.5 * (template[lines[:, 0]] + template[lines[:, 1]])
    return replace(head, template=template)


CASES = (
    Case("all rotations zero", _at_rest),
    *(Case(f"{name} turned by pi", _turned(name, (np.pi, 0.0, 0.0))) for name in _ANGLES),
    Case("rotation by pi about a diagonal", _turned("rotation", (np.pi / 3**0.5,) * 3)),
    Case("rotation by two pi", _turned("rotation", (0.0, 2 * np.pi, 0.0))),
    Case("rotations of 1e-20", lambda a: {**a, "jaw": a["jaw"] * 1e-20, "neck": a["neck"] * 1e-20}),
    Case("rotations of 1e-4", _turned("jaw", (1e-4, -1e-4, 1e-4))),
    Case("expression at ten deviations", _scaled(10.0, "expression")),
    Case("identity at ten deviations", _scaled(10.0, "shape")),
    Case("both at ten deviations", _scaled(10.0, "shape", "expression")),
    Case("100 m away", _far),
    Case("triangles without area", lambda a: a, _collapsed),
)


def measure(quick: bool, progress: Progress) -> Findings:
    """Try every case; ``quick`` tries the same, it takes seconds."""
    verdicts = []
    for done, case in enumerate(CASES):
        progress(done, len(CASES), case.name)
        verdicts.append(try_case(case))
    progress(len(CASES), len(CASES), "")
    failed = sum(bool(verdict.complaint) for verdict in verdicts)
    lines = [
        "Vertices against float64 and fast against readable path, as parts of the extent; gradients relative.",
        f"{'case':34}  {'float32':>8}  {'paths':>8}  {'gradient':>8}  verdict",
        *(
            f"{v.case:34}  {v.float32_error:8.1e}  {v.paths_error:8.1e}  {v.gradient_error:8.1e}  "
            f"{v.complaint or 'ok'}"
            for v in verdicts
        ),
        f"{len(verdicts) - failed} of {len(verdicts)} behave as expected.",
    ]
    return Findings("\n".join(lines), {"verdicts": [asdict(v) for v in verdicts]}, passed=not failed)


def try_case(case: Case, head: HeadArrays | None = None) -> Verdict:
    """Pose a head as the case says, in both precisions and by both paths, with gradients of all arguments."""
    asset = case.head(procedural_head("2020") if head is None else head)
    exact, single = HeadModel(asset, dtype=torch.float64), HeadModel(asset)
    given = case.change(_arguments(exact))
    # Both start from what float32 can hold, so that the error is that of the computation.
    given = {name: value.float().double() for name, value in given.items()}
    truth, truth_gradients = _with_gradients(exact, given)
    drawn, gradients = _with_gradients(single, {name: value.float() for name, value in given.items()})
    fast64, fast32 = exact(**given), single(**{name: value.float() for name, value in given.items()})
    extent = float(truth.abs().max())
    error = max(float((value - truth).abs().max()) for value in (drawn.double(), fast32.double())) / extent
    paths = float((fast64 - truth).abs().max()) / extent
    relative = [
        float((gradients[name].double() - wanted).norm() / wanted.norm().clamp_min(1e-12))
        for name, wanted in truth_gradients.items()
    ]
    finite = all(bool(torch.isfinite(value).all()) for value in (drawn, fast32, *gradients.values()))
    complaint = ""
    if not finite:
        complaint = "not finite"
    elif not error <= FLOAT32:
        complaint = f"float32 error over {FLOAT32:.0e}"
    elif not paths <= 1e-13:
        complaint = "the paths differ"
    elif not max(relative) <= 1e-3:
        complaint = "gradients differ"
    return Verdict(case.name, error, paths, max(relative), complaint)


def _arguments(model: HeadModel) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)

    def draw(size: int, scale: float) -> Tensor:
        return scale * torch.randn(2, size, generator=generator, dtype=torch.float64)

    arguments = {"shape": draw(model.shape_size, 1.0), "expression": draw(model.expression_size, 1.0)}
    arguments |= {"rotation": draw(3, 0.3), "neck": draw(3, 0.2), "jaw": draw(3, 0.2), "eyes": draw(6, 0.2)}
    arguments |= {"translation": draw(3, 0.1)}
    if model.eyelid_matrix is not None:
        arguments["eyelids"] = draw(2, 0.3)
    return arguments


def _with_gradients(model: HeadModel, arguments: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
    """Vertices and the gradients of a fixed weighted sum of them, by every argument."""
    leaves = {name: value.clone().requires_grad_() for name, value in arguments.items()}
    vertices = model(**leaves)
    # Positive weights: sums that cancel would show the sums' rounding and not the model's.
    weights = 1.5 + torch.linspace(0, 40, vertices.numel(), dtype=torch.float64).cos()
    weights = weights.to(vertices).view_as(vertices)
    (vertices * weights).sum().backward()
    gradients = {}
    for name, leaf in leaves.items():
        assert leaf.grad is not None, "every argument moves vertices"
        gradients[name] = leaf.grad
    return vertices.detach(), gradients
