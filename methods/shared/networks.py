"""Networks of the tracked parameters: their inputs and their layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import linear

from ...bench.contracts import HeadAsset
from ...datasets.head.rotations import axis_angle_to_matrix
from .schedule import torch_generator

ROTATIONS = ("neck", "jaw", "eyes")
"""Names of the inputs that are rotations."""


def tracked_inputs(arguments: Mapping[str, Tensor], names: Sequence[str]) -> Tensor:
    """(T, I) inputs of a network: unchanged coefficients, and rotations as the first two rows of their matrices.

    Eyelids are left out for a head model without them.
    """
    columns = []
    for name in names:
        values = arguments.get(name)
        if values is not None and name in ROTATIONS:
            values = axis_angle_to_matrix(values.unflatten(1, (-1, 3)))[:, :, :2].flatten(1)
        columns += [] if values is None else [values]
    return torch.cat(columns, dim=1)


def input_count(head: HeadAsset, names: Sequence[str]) -> int:
    """Number of `tracked_inputs` for a head model."""
    lids = 0 if head.eyelid_basis is None else 2
    sizes = {"expression": head.expression_basis.shape[2], "neck": 6, "jaw": 6, "eyes": 12, "eyelids": lids}
    return sum({**sizes, "translation": 3}[name] for name in names)


def layer_names(layers: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the weights and of the biases of a network."""
    weights, biases = (
        tuple(f"network_{part}_{layer}" for layer in range(layers)) for part in ("weight", "bias")
    )
    return weights, biases


def layer_shapes(sizes: Sequence[int | str]) -> dict[str, tuple[int | str, ...]]:
    """Shapes of weights and biases by name; ``sizes`` as for `initial_network`; unknown ones may be names."""
    shapes: dict[str, tuple[int | str, ...]] = {}
    for weight, bias, fan_in, fan_out in zip(*layer_names(len(sizes) - 1), sizes, sizes[1:]):
        shapes |= {weight: (fan_out, fan_in), bias: (fan_out,)}
    return shapes


def outputs_of(network: Mapping[str, Tensor], sums: Tensor, layers: int) -> Tensor:
    """Outputs of an MLP with ReLU, given the (N, H) pre-activations of its first layer."""
    weights, biases = layer_names(layers)
    for weight, bias in zip(weights[1:], biases[1:]):
        sums = linear(sums.relu(), network[weight], network[bias])
    return sums


def initial_network(sizes: Sequence[int], seed: int) -> dict[str, Tensor]:
    """Weights and biases by name, uniform in the inverse root of the layer's inputs, as `torch.nn.Linear` has them.

    ``sizes``: number of inputs, widths of the hidden layers, number of outputs.
    """
    generator, tensors = torch_generator(seed, "network"), {}
    for weight, bias, fan_in, fan_out in zip(*layer_names(len(sizes) - 1), sizes, sizes[1:]):
        for name, shape in ((weight, (fan_out, fan_in)), (bias, (fan_out,))):
            tensors[name] = (2 * torch.rand(shape, generator=generator) - 1) * fan_in**-0.5
    return tensors
