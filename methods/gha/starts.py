"""Fits of single networks before training begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor, nn

from ..shared.optimisation import Optimiser
from ..shared.schedule import log_linear
from .networks import Mlp


def fitted(
    network: Mlp,
    initial: Mapping[str, Tensor],
    loss: Callable[[Optimiser, int], Tensor],
    steps: int,
    rates: tuple[float, float],
) -> dict[str, Tensor]:
    """A network's tensors after so many steps of Adam.

    Parameters
    ----------
    initial : its tensors by name, and any others.
    loss : of the tensors and the number of the step, from 1.
    rates : learning rate of the first half of the steps, and the one that it falls to, log-linearly, in the second.
    """
    names = list(network.shapes())
    weights = Optimiser(
        {name: nn.Parameter(initial[name].clone()) for name in names}, dict.fromkeys(names, rates[0])
    )
    for step in range(1, steps + 1):
        rate = log_linear(*rates, max(0.0, 2 * step / steps - 1))
        for name in names:
            weights.set_learning_rate(name, rate)
        loss(weights, step).backward()
        weights.step()
        weights.zero_grad()
    return {name: weights[name].detach() for name in names}
