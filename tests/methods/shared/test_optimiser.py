"""Adam with growing tensors against the textbook update."""

import numpy as np
import pytest
import torch
from torch import nn

from headbench.methods.shared import optimisation
from headbench.methods.shared.avatar_kernel import available, call
from headbench.methods.shared.optimisation import Optimiser
from headbench.methods.splats.cpu import instruction_sets
from headbench.tests.benchmarks.timing import torch_threads

needs_kernel = pytest.mark.skipif(not available(), reason="needs the compiled kernel")


def textbook(values, gradients, rate):
    """Kingma and Ba 2015, algorithm 1, in float64; eps 1e-15."""
    m = v = np.zeros_like(values)
    for t, g in enumerate(gradients, 1):
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        values = values - rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)
    return values


def make(rows=4):
    values = torch.arange(rows * 3, dtype=torch.float64).reshape(rows, 3)
    optimiser = Optimiser(
        {"a": nn.Parameter(values.clone()), "b": nn.Parameter(torch.zeros(2, dtype=torch.float64))},
        {"a": 0.1, "b": 0.2},
    )
    return optimiser, values.numpy()


def step(optimiser, gradient):
    optimiser["a"].grad = torch.as_tensor(gradient)
    optimiser.step()
    optimiser.zero_grad()


def test_steps_are_adams():
    optimiser, start = make()
    gradients = np.random.default_rng(0).normal(size=(5, 4, 3))
    for gradient in gradients:
        step(optimiser, gradient)
    np.testing.assert_allclose(optimiser["a"].detach(), textbook(start, gradients, 0.1), rtol=1e-12)
    assert (optimiser["b"] == 0).all()  # no gradient, no step


@needs_kernel
@pytest.mark.parametrize("backend", instruction_sets())
@pytest.mark.parametrize("size", [1, 16, 37, 40_000])
def test_compiled_steps_are_adams(monkeypatch, backend, size):
    monkeypatch.setattr(optimisation, "call", lambda *values, backend: call(*values, backend=chosen))
    chosen, numbers = backend, np.random.default_rng(size)
    start, gradients = numbers.normal(size=size), numbers.normal(size=(6, size))
    gradients[:, : size // 3] = 0  # where nothing changes
    gradients[3:, size // 2 :] = 0  # moments alone
    found = []
    for threads in (1, 3):
        optimiser = Optimiser({"a": nn.Parameter(torch.from_numpy(start).float())}, {"a": 0.1})
        with torch_threads(threads):
            for gradient in gradients:
                step(optimiser, torch.from_numpy(gradient).float())
        found.append(optimiser["a"].detach())
    np.testing.assert_allclose(found[0], textbook(start, gradients, 0.1), rtol=2e-6, atol=2e-6)
    assert torch.equal(found[0][: size // 3], torch.from_numpy(start).float()[: size // 3])
    assert torch.equal(*found)
    assert optimiser.moments("a")["step"] == len(gradients)


@needs_kernel
def test_compiled_steps_do_not_hide_what_is_not_a_number():
    optimiser = Optimiser({"a": nn.Parameter(torch.ones(20))}, {"a": 0.1})
    step(optimiser, torch.zeros(20).index_fill(0, torch.tensor([3, 19]), torch.nan))
    assert optimiser["a"].isnan().nonzero().flatten().tolist() == [3, 19]


@needs_kernel
def test_torch_and_the_kernel_go_on_from_each_other(monkeypatch):
    start, gradients = np.ones(5), np.random.default_rng(3).normal(size=(6, 5))
    optimiser = Optimiser({"a": nn.Parameter(torch.ones(5))}, {"a": 0.1})
    for number, gradient in enumerate(gradients):
        monkeypatch.setattr(optimisation, "usable", lambda _, compiled=number % 2: bool(compiled))
        step(optimiser, torch.from_numpy(gradient).float())
    np.testing.assert_allclose(optimiser["a"].detach(), textbook(start, gradients, 0.1), rtol=2e-6)


def test_select_keeps_rows_with_their_moments():
    optimiser, start = make()
    gradients = np.random.default_rng(1).normal(size=(4, 4, 3))
    for gradient in gradients[:2]:
        step(optimiser, gradient)
    optimiser.select(["a"], torch.tensor([True, False, True, True]))
    for gradient in gradients[2:]:
        step(optimiser, gradient[[0, 2, 3]])
    expected = textbook(start, gradients, 0.1)[[0, 2, 3]]
    np.testing.assert_allclose(optimiser["a"].detach(), expected, rtol=1e-12)


def test_state_restores_another_number_of_rows_and_continues():
    one, _ = make()
    gradients = np.random.default_rng(2).normal(size=(4, 3, 3))
    step(one, np.ones((4, 3)))
    one.select(["a"], torch.tensor([True, True, False, True]))
    one.set_learning_rate("a", 0.05)
    other, _ = make()
    other.load_state(one.state())
    for gradient in gradients:
        step(one, gradient)
        step(other, gradient)
    assert torch.equal(one["a"], other["a"])
