"""The compiled networks against their float64 references: values, gradients, threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from headbench.methods.gha import driving, gaussian_head, kernel
from headbench.methods.gha.driving import Influence
from headbench.methods.gha.networks import SLOPE, Mlp, blended_reference
from headbench.methods.shared.networks import encode
from headbench.tests.benchmarks.timing import torch_threads

needs_kernel = pytest.mark.skipif(not kernel.available(), reason="the kernel is missing")
POINTS = 331  # no multiple of a tile, more than one chunk


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed + sum(shape)), dtype=torch.float64)


class Case(NamedTuple):
    """Two ways to the same tensor; ``fast`` takes the instruction set after the inputs."""

    fast: Callable[..., Tensor]
    slow: Callable[..., Tensor]
    inputs: Sequence[Tensor]


def _layers(mlp: Mlp, seed: int) -> dict[str, Tensor]:
    initial = mlp.initial(torch.Generator().manual_seed(seed))
    return {name: 2 * value.double() for name, value in initial.items()}


def _perceptron(hidden: tuple[int, ...], condition: tuple[int, ...], outputs: int, squashed: bool) -> Case:
    mlp = Mlp("m", 27, condition[-1] if condition else 0, hidden, 5)
    weights = _layers(mlp, 3)
    points, code = _random(POINTS, 27), _random(*condition, seed=1) if condition else None
    rows = torch.arange(POINTS)
    several = len(condition) == 2

    def slow(*values: Tensor) -> Tensor:
        points_, code_, layers = _split_up(values)
        found = mlp.reference(layers, points_, code_, outputs)
        return torch.tanh(found) if squashed else found

    def fast(*values: Tensor) -> Tensor:
        points_, code_, layers = _split_up(values[:-1])
        part = mlp.part(layers, rows, None, code_, squashed=squashed)
        return kernel.perceptron(points_, part, outputs, SLOPE, values[-1])

    def _split_up(values: Sequence[Tensor]) -> tuple[Tensor, Tensor | None, dict[str, Tensor]]:
        rest = list(values)
        at = points.to(rest[0].dtype) if several else rest.pop(0)
        return at, rest.pop(0) if code is not None else None, dict(zip(weights, rest))

    # With several conditions points have no gradient.
    inputs = [*([] if several else [points]), *([] if code is None else [code]), *weights.values()]
    return Case(fast, slow, inputs)


def _blend(squashed: bool, channels: int) -> Case:
    networks = Mlp("near", 9, 20, (40, 17, 33), 8), Mlp("far", 9, 6, (20,), 8)
    weights = _layers(networks[0], 4) | _layers(networks[1], 5)
    share = torch.rand(POINTS, generator=torch.Generator().manual_seed(6), dtype=torch.float64) * 2 - 0.5
    share = share.clamp(0, 1)
    near, far = (share > 0).nonzero().squeeze(1), (share < 1).nonzero().squeeze(1)

    def split_up(values: Sequence[Tensor]) -> tuple[object, ...]:
        points, first, second, one, other, *layers = values
        return (
            dict(zip(weights, layers)),
            points,
            (Influence(near, first), Influence(far, second)),
            (one, other),
        )

    def fast(*values: Tensor) -> Tensor:
        layers, points, influences, conditions = split_up(values[:-1])
        parts = [
            network.part(layers, part.rows, part.weights, condition, squashed=squashed)
            for network, part, condition in zip(networks, influences, conditions)
        ]
        return kernel.blended(points, parts, channels, SLOPE, values[-1])

    def slow(*values: Tensor) -> Tensor:
        return blended_reference(networks, *split_up(values), squashed=squashed, channels=channels)

    shares = share[near], 1 - share[far]
    inputs = [_random(POINTS, 9), *shares, _random(20), _random(6), *weights.values()]
    return Case(fast, slow, inputs)


def _convolution(height: int, width: int, before: int, after: int) -> Case:
    return Case(
        kernel.normalised_convolution,
        gaussian_head.normalised_convolution,
        [_random(height, width, before), _random(after, before, 3, 3)],
    )


def _influences() -> Case:
    def joined(found: Sequence[Tensor]) -> Tensor:
        rows, weights, far, far_weights = found
        assert rows.dtype == far.dtype == torch.int64
        return torch.cat([rows.to(weights), 3 * weights, far.to(weights), far_weights])

    def slow(points: Tensor, landmarks: Tensor) -> Tensor:
        near, far = driving.reference_influences(points, landmarks, 0.1, 0.5)
        return joined([*near, *far])

    return Case(
        lambda points, landmarks, isa: joined(kernel.influences(points, landmarks, 0.1, 0.5, isa)),
        slow,
        [_random(POINTS, 3), _random(50, 3, seed=1)],
    )


def _residual_image(channels: int) -> Case:
    alpha = _random(21, 35, seed=3).clamp_min(0)
    alpha[:, 20:] = 0
    ground = torch.tensor([1.0, 0.5, 0.25])
    near = gaussian_head.near_drawn(alpha)
    assert 0.2 < near.mean() < 0.8

    def slow(values: Tensor, weight: Tensor, bias: Tensor, plain: Tensor, alpha: Tensor) -> Tensor:
        colors = torch.nn.functional.linear(values, weight, bias)
        return gaussian_head.residual_image(colors, plain, alpha, near, ground.double())

    return Case(
        lambda *x: kernel.residual_image(*x[:5], near.to(torch.uint8), ground, x[5]),
        slow,
        [_random(21, 35, channels), _random(3, channels), _random(3), _random(21, 35, 3), alpha],
    )


def _posed() -> Case:
    scales = kernel.Scales(0.1, 0.3, 0.2, 0.5)
    shapes = (3, 3), (3,), (4, 4), (POINTS, 3), (POINTS, 3), (POINTS, 3), (POINTS, 4), (POINTS,), (POINTS, 8)
    inputs = [_random(*shape, seed=number) for number, shape in enumerate(shapes)]
    return Case(
        lambda *x: torch.cat([t.flatten() for t in kernel.posed(scales, *x[:-1], instruction_set=x[-1])]),
        lambda *x: torch.cat([t.flatten() for t in gaussian_head.posed(scales, *x)]),
        inputs,
    )


def _with_colors() -> Case:
    return Case(
        lambda features, _: torch.cat(kernel.with_colors(features), dim=2),
        lambda features: torch.cat([features, features[..., :3]], dim=2),
        [_random(5, 6, 7)],
    )


def _motion(scale: float) -> Case:
    tracked = _random(6, 3)
    tracked[:2] *= scale
    return Case(
        lambda correction, _: torch.cat([t.flatten() for t in kernel.motion(tracked.float(), correction)]),
        lambda correction: torch.cat([t.flatten() for t in driving.reference_motion(tracked, correction)]),
        [0.1 * scale * _random(6)],
    )


CASES = {
    "perceptron": _perceptron((70, 64, 20), (11,), 5, False),
    "perceptron, squashed, some outputs": _perceptron((33, 20), (11,), 2, True),
    "perceptron of one layer": _perceptron((), (11,), 5, False),
    "perceptron without condition": _perceptron((24, 24), (), 5, False),
    "perceptron, several conditions": _perceptron((24, 40), (3, 11), 5, True),
    "blend": _blend(False, 8),
    "blend, squashed, some channels": _blend(True, 3),
    "convolution": _convolution(37, 29, 16, 16),
    "convolution, other channels": _convolution(20, 35, 6, 35),
    "convolution of many channels": _convolution(6, 70, 70, 80),
    "convolution of one row": _convolution(1, 50, 5, 3),
    "encoding": Case(kernel.encode, encode, [4 * _random(POINTS, 3)]),
    "hyperbolic tangent": Case(kernel.tanh, torch.tanh, [3 * _random(POINTS, 7)]),
    "influences": _influences(),
    "posing": _posed(),
    "residual image": _residual_image(16),
    "residual image, other channels": _residual_image(21),
    "motion of the head": _motion(1.0),
    "motion of the head, small angles": _motion(0.01),
    "motion of the head, large angles": _motion(2.5),
    "colours beside features": _with_colors(),
}


def _outcome(function: Callable[..., Tensor], inputs: Sequence[Tensor], *more: str) -> list[Tensor]:
    """What a function gives, and the gradients of a weighted sum of it by all inputs."""
    leaves = [value.clone().requires_grad_() for value in inputs]
    found = function(*leaves, *more)
    weighted = (found * _random(*found.shape, seed=9).to(found.dtype)).sum()
    return [found.detach(), *torch.autograd.grad(weighted, leaves)]


@needs_kernel
@pytest.mark.parametrize("instruction_set", kernel.KERNEL.instruction_sets)
@pytest.mark.parametrize("name", CASES)
def test_kernel_agrees_with_its_reference(name, instruction_set):
    case = CASES[name]
    expected = _outcome(case.slow, case.inputs)
    found = _outcome(case.fast, [value.float() for value in case.inputs], instruction_set)
    for fast, slow in zip(found, expected, strict=True):
        assert fast.dtype == torch.float32
        torch.testing.assert_close(fast.double(), slow, rtol=3e-5, atol=3e-6 * float(slow.abs().max()))


@needs_kernel
@pytest.mark.parametrize("name", CASES)
def test_any_number_of_threads_gives_the_same_bits(name):
    case = CASES[name]
    inputs = [value.float() for value in case.inputs]
    outcomes = []
    for threads in (1, 2, 5):
        with torch_threads(threads):
            leaves = [value.clone().requires_grad_() for value in inputs]
            found = case.fast(*leaves, "")
            weights = _random(*found.shape, seed=9).float()
            outcomes.append([found.detach(), *torch.autograd.grad(found, leaves, weights)])
    for other in outcomes[1:]:
        assert all(torch.equal(a, b) for a, b in zip(outcomes[0], other, strict=True))


@needs_kernel
@pytest.mark.parametrize("name", CASES)
def test_values_are_the_same_without_gradients(name):
    case = CASES[name]
    inputs = [value.float() for value in case.inputs]
    with torch.no_grad():
        plain = case.fast(*inputs, "")
    assert torch.equal(plain, case.fast(*(value.requires_grad_() for value in inputs), "").detach())


@needs_kernel
@pytest.mark.parametrize("shape", [(9, 13), (1, 1), (30, 2), (2, 30)])
def test_surroundings_of_what_is_drawn(shape):
    alpha = torch.rand(shape, generator=torch.Generator().manual_seed(1)).sub(0.93).clamp_min(0)
    near = kernel.near_drawn(alpha, gaussian_head.REACH, gaussian_head.COVERED)
    assert torch.equal(near.float(), gaussian_head.near_drawn(alpha))
