"""Adam with growing tensors against the textbook update."""

import numpy as np
import torch
from torch import nn

from headbench.methods.shared.optimisation import Optimiser


def textbook(values, gradients, rate, epsilon=1e-15):
    """Kingma and Ba 2015, algorithm 1, in float64."""
    m = v = np.zeros_like(values)
    for t, g in enumerate(gradients, 1):
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        values = values - rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + epsilon)
    return values


def make(rows=4, **options):
    values = torch.arange(rows * 3, dtype=torch.float64).reshape(rows, 3)
    optimiser = Optimiser(
        {"a": nn.Parameter(values.clone()), "b": nn.Parameter(torch.zeros(2, dtype=torch.float64))},
        {"a": 0.1, "b": 0.2},
        **options,
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


def test_a_parameter_may_have_an_epsilon_of_its_own():
    optimiser, start = make(epsilons={"a": 0.3})
    gradients = np.random.default_rng(0).normal(size=(3, 4, 3))
    for gradient in gradients:
        optimiser["b"].grad = torch.full_like(optimiser["b"], 1e-9)
        step(optimiser, gradient)
    np.testing.assert_allclose(optimiser["a"].detach(), textbook(start, gradients, 0.1, 0.3), rtol=1e-12)
    expected = textbook(np.zeros(2), np.full((3, 2), 1e-9), 0.2)
    np.testing.assert_allclose(optimiser["b"].detach(), expected, rtol=1e-12)


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
