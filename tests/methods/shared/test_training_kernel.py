"""The compiled passes of training against their float64 reference implementations: values, gradients, threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from headbench.methods.shared import binding, losses, training_kernel
from headbench.methods.shared.networks import sh_to_rgb
from headbench.methods.shared.threads import torch_threads
from headbench.methods.splats.cpu import instruction_sets

VERTICES, FACES, SPLATS = 211, 310, 2_077  # no multiples of a vector, more than one task


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed + sum(shape)), dtype=torch.float64)


def _faces() -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.stack([torch.randperm(VERTICES, generator=generator)[:3] for _ in range(FACES)])


def _binding() -> Tensor:
    return torch.randint(0, FACES, (SPLATS,), generator=torch.Generator().manual_seed(2))


class Case(NamedTuple):
    """Two ways to the same tensors; ``fast`` takes the backend after the inputs."""

    fast: Callable[..., Tensor | Sequence[Tensor]]
    slow: Callable[..., Tensor | Sequence[Tensor]]
    inputs: Sequence[Tensor]


def _photometric(height: int, width: int, weight: float) -> Case:
    image, truth = (_random(height, width, 3, seed=seed).sigmoid() for seed in (0, 1))
    return Case(
        lambda image, backend: training_kernel.photometric_loss(image, truth.float(), weight, backend),
        lambda image: losses.photometric_loss(image, truth, weight),
        [image],
    )


def _triangles() -> Case:
    faces = _faces()
    return Case(
        lambda vertices, backend: training_kernel.triangle_frames(vertices, faces, backend),
        lambda vertices: binding.triangle_frames(vertices, faces),
        [_random(VERTICES, 3)],
    )


def _to_world() -> Case:
    frames = binding.triangle_frames(_random(VERTICES, 3), _faces())
    bound = _binding()
    return Case(
        lambda *x: training_kernel.to_world(binding.Frames(*x[:4]), bound, *x[4:7], x[7]),
        lambda *x: binding.to_world(binding.Frames(*x[:4]), bound, *x[4:]),
        [*frames, _random(SPLATS, 3), _random(SPLATS, 3, seed=1), _random(SPLATS, 4)],
    )


def _harmonics(degree: int) -> Case:
    def slow(dc: Tensor, rest: Tensor, vectors: Tensor) -> Tensor:
        return sh_to_rgb(dc, rest, torch.nn.functional.normalize(vectors, dim=1), degree)

    return Case(
        lambda *x: training_kernel.harmonic_colors(*x[:3], degree, x[3]),
        slow,
        [_random(SPLATS, 3), _random(SPLATS, 3, 15), _random(SPLATS, 3, seed=1)],
    )


CASES = {
    "photometric": _photometric(131, 70, 0.2),
    "photometric, SSIM alone, smaller than the window": _photometric(5, 7, 1.0),
    "photometric, L1 alone, one column": _photometric(100, 1, 0.0),
    "triangle frames": _triangles(),
    "to world": _to_world(),
    **{f"harmonics of degree {degree}": _harmonics(degree) for degree in range(4)},
}
needs_kernel = pytest.mark.skipif(not instruction_sets(), reason="the compiled kernel is missing")


def _run(
    function: Callable[..., Tensor | Sequence[Tensor]], inputs: Sequence[Tensor], *rest: str
) -> list[Tensor]:
    """Outputs, and gradients of a fixed weighting of them by the inputs."""
    leaves = [value.clone().requires_grad_() for value in inputs]
    found = function(*leaves, *rest)
    outputs = [found] if isinstance(found, Tensor) else list(found)
    weighted = [(value * _random(*value.shape, seed=9).to(value)).sum() for value in outputs]
    gradients = torch.autograd.grad(sum(weighted), leaves, allow_unused=True, materialize_grads=True)
    return [*(value.detach() for value in outputs), *gradients]


@needs_kernel
@pytest.mark.parametrize("backend", instruction_sets())
@pytest.mark.parametrize("name", CASES)
def test_equals_the_reference_in_values_and_gradients(name: str, backend: str) -> None:
    case = CASES[name]
    expected = _run(case.slow, case.inputs)
    found = _run(case.fast, [value.float() for value in case.inputs], backend)
    for one, other in zip(found, expected, strict=True):
        bound = 2e-6 * max(1e-6, float(other.abs().max()))
        torch.testing.assert_close(one.double(), other, rtol=0, atol=bound)


@needs_kernel
@pytest.mark.parametrize("name", CASES)
def test_bits_do_not_depend_on_threads(name: str) -> None:
    case = CASES[name]
    inputs = [value.float() for value in case.inputs]
    found = []
    for threads in (1, 2, 3):
        with torch_threads(threads):
            found.append(_run(case.fast, inputs, "cpu"))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


@needs_kernel
def test_degenerate_splats_and_triangles_have_finite_gradients() -> None:
    vertices = torch.zeros(3, 3)
    frames = training_kernel.triangle_frames(vertices.requires_grad_(), torch.tensor([[0, 1, 2], [0, 0, 1]]))
    local = [torch.zeros(4, 3, requires_grad=True), torch.full((4, 3), -200.0, requires_grad=True)]
    quats = torch.zeros(4, 4, requires_grad=True)
    world = training_kernel.to_world(frames, torch.tensor([0, 1, 1, 0]), *local, quats)
    colors = training_kernel.harmonic_colors(torch.ones(4, 3), torch.ones(4, 3, 15), world.means, 3)
    sum(value.sum() for value in (*world, colors)).backward()
    for leaf in (vertices, *local, quats):
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
    assert torch.isfinite(world.scales).all()
