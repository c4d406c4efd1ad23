"""``headbench doctor stress head``: numerical extremes of the head model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import Progress
from ...bench.doctor import Row, table
from ...bench.specs import CommandResult
from .arrays import HeadArrays
from .model import HeadModel
from .procedural.model import procedural_head

Arguments = Mapping[str, Tensor]

ANGLES = ("rotation", "neck", "jaw", "eyes")
FLOAT32 = 1e-6
"""Largest error of float32 vertices as a part of the mesh's extent, including coefficients of ten deviations."""


@dataclass(frozen=True)
class HeadExtreme:
    """One extreme: the arguments that it changes, and the head."""

    name: str
    change: Callable[[Arguments], Arguments] = lambda arguments: {}
    head: Callable[[HeadArrays], HeadArrays] = lambda head: head


def _turned(name: str, *vector: float) -> Callable[[Arguments], Arguments]:
    return lambda a: {
        name: torch.tensor(vector * (a[name].shape[1] // 3), dtype=a[name].dtype).expand_as(a[name])
    }


def _scaled(factor: float, *names: str) -> Callable[[Arguments], Arguments]:
    return lambda a: {name: factor * torch.sign(a[name]) for name in names}


def _collapsed(head: HeadArrays) -> HeadArrays:
    """Every tenth triangle to a point, every tenth to a line."""
    template = head.template.copy()
    points, lines = head.faces[::10], head.faces[5::10]
    template[points[:, 1:]] = template[points[:, :1]]
    template[lines[:, 2]] = 0.5 * (template[lines[:, 0]] + template[lines[:, 1]])
    return replace(head, template=template)


HEAD_EXTREMES = (
    HeadExtreme("all rotations zero", lambda a: {name: torch.zeros_like(a[name]) for name in ANGLES}),
    *(HeadExtreme(f"{name} turned by pi", _turned(name, np.pi, 0.0, 0.0)) for name in ANGLES),
    HeadExtreme("rotation by pi about a diagonal", _turned("rotation", *(np.pi / 3**0.5,) * 3)),
    HeadExtreme("rotation by two pi", _turned("rotation", 0.0, 2 * np.pi, 0.0)),
    HeadExtreme("rotations of 1e-20", lambda a: {name: 1e-20 * a[name] for name in ("jaw", "neck")}),
    HeadExtreme("rotations of 1e-4", _turned("jaw", 1e-4, -1e-4, 1e-4)),
    HeadExtreme("expression at ten deviations", _scaled(10.0, "expression")),
    HeadExtreme("identity at ten deviations", _scaled(10.0, "shape")),
    HeadExtreme("both at ten deviations", _scaled(10.0, "shape", "expression")),
    HeadExtreme("100 m away", lambda a: {"translation": a["translation"] + 100.0}),
    HeadExtreme("triangles without area", head=_collapsed),
)


def stress(quick: bool, progress: Progress) -> CommandResult:
    """Try every case; ``quick`` tries the same, it takes seconds."""
    rows: list[Row] = []
    for done, case in enumerate(HEAD_EXTREMES):
        progress(done, len(HEAD_EXTREMES), case.name)
        rows.append(try_extreme(case))
    sound = sum(row["verdict"] == "ok" for row in rows)
    text = (
        "Vertices in float32 against float64, as parts of the extent; gradients relative.\n\n"
        f"{table(rows)}\n\n{sound} of {len(rows)} behave as expected."
    )
    return CommandResult(text, {"verdicts": rows}, passed=sound == len(rows))


def try_extreme(case: HeadExtreme, head: HeadArrays | None = None) -> Row:
    """Pose a head as the case says, in both precisions, with gradients of all arguments."""
    asset = case.head(procedural_head("2020") if head is None else head)
    exact, single = HeadModel(asset, dtype=torch.float64), HeadModel(asset)
    given = _arguments(exact, 2, torch.float64)
    # Both start from what float32 can hold, so that the error is that of the computation.
    narrow = {name: value.float() for name, value in {**given, **case.change(given)}.items()}
    wide = {name: value.double() for name, value in narrow.items()}
    truth, wanted = _with_gradients(exact, wide)
    drawn, gradients = _with_gradients(single, narrow)
    error = float((drawn.double() - truth).abs().max() / truth.abs().max())
    relative = max(
        float((gradients[name].double() - value).norm() / value.norm().clamp_min(1e-12))
        for name, value in wanted.items()
    )
    finite = all(bool(torch.isfinite(value).all()) for value in (drawn, *gradients.values()))
    bounds = {
        "not finite": finite,
        f"float32 error over {FLOAT32:.0e}": error <= FLOAT32,
        "gradients differ": relative <= 1e-3,
    }
    verdict = next((complaint for complaint, kept in bounds.items() if not kept), "ok")
    return {"case": case.name, "float32": error, "gradient": relative, "verdict": verdict}


def _arguments(model: HeadModel, batch: int, dtype: torch.dtype) -> dict[str, Tensor]:
    """Identities and poses in which every joint turns, (B, size) each."""
    generator = torch.Generator().manual_seed(3)
    sizes = {
        "shape": (model.shape_size, 1.0),
        "expression": (model.expression_size, 1.0),
        "rotation": (3, 0.3),
        "neck": (3, 0.2),
        "jaw": (3, 0.2),
        "eyes": (6, 0.2),
        "translation": (3, 0.1),
        **({} if model.eyelid_matrix is None else {"eyelids": (2, 0.3)}),
    }
    return {
        name: (scale * torch.randn(batch, size, generator=generator, dtype=torch.float64)).to(dtype)
        for name, (size, scale) in sizes.items()
    }


def _with_gradients(model: HeadModel, arguments: Arguments) -> tuple[Tensor, dict[str, Tensor]]:
    """Vertices and the gradients of a fixed weighted sum of them, by every argument."""
    leaves = {name: value.clone().requires_grad_() for name, value in arguments.items()}
    vertices = model(**leaves)
    # Positive weights: sums that cancel would show the sums' rounding and not the model's.
    weights = 1.5 + torch.linspace(0, 40, vertices.numel(), dtype=torch.float64).cos()
    gradients = torch.autograd.grad(
        (vertices * weights.to(vertices).view_as(vertices)).sum(), list(leaves.values())
    )
    return vertices.detach(), dict(zip(leaves, gradients, strict=True))
