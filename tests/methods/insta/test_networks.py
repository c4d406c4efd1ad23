"""The block-wise network against autograd, in float64."""

import pytest
import torch

from headbench.methods.insta import networks
from headbench.methods.insta.networks import initial_weights, layer_shapes, network, network_reference


@pytest.mark.parametrize("constants", [0, 3])
@pytest.mark.parametrize("layers", [1, 3])
def test_values_and_gradients_are_those_of_autograd(constants, layers, monkeypatch):
    monkeypatch.setattr(networks, "CPU_BLOCK", 16)  # several blocks, the last one short
    generator = torch.Generator().manual_seed(layers)
    inputs = torch.randn(53, 5, generator=generator, dtype=torch.float64)
    others = torch.randn(4, constants, generator=generator, dtype=torch.float64)
    rows = torch.randint(4, (53,), generator=generator)
    weights = [w.double() for w in initial_weights(layer_shapes(5 + constants, 7, layers, 2), generator)]
    gradient = torch.randn(53, 2, generator=generator, dtype=torch.float64)
    results = []
    for function in (network, network_reference):
        leaves = [value.clone().requires_grad_() for value in (inputs, *weights)]
        output = function(leaves[0], others, rows, leaves[1:])
        output.backward(gradient)
        results.append((output.detach(), *(leaf.grad for leaf in leaves)))
    for one, other in zip(*results):
        torch.testing.assert_close(one, other, atol=1e-12, rtol=0)


def test_no_rows_are_no_trouble():
    weights = [torch.ones(4, 3, requires_grad=True), torch.ones(2, 4)]
    output = network(torch.empty(0, 3), torch.empty(1, 0), torch.empty(0, dtype=torch.int64), weights)
    output.sum().backward()
    assert output.shape == (0, 2)
    assert weights[0].grad.abs().sum() == 0
