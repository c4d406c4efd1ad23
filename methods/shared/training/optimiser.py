"""Adam over named groups whose per-splat tensors may grow and shrink."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn


class Optimiser:
    """One Adam (eps 1e-15, dense) over named parameters.

    Densification replaces per-splat parameters by longer or shorter ones; `select` and `append` carry the moments
    along, with zeros for new rows. A replaced parameter has no gradient, so it sits out the step that follows,
    as in the published code.

    Parameters
    ----------
    parameters : name -> parameter.
    learning_rates : name -> initial learning rate.
    betas : decay of the two moments.
    """

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        learning_rates: Mapping[str, float],
        betas: tuple[float, float] = (0.9, 0.999),
    ):
        groups = [{"params": [p], "lr": learning_rates[name], "name": name} for name, p in parameters.items()]
        self._adam = torch.optim.Adam(groups, betas=betas, eps=1e-15, fused=True)
        self._groups: dict[str, dict[str, Any]] = {g["name"]: g for g in self._adam.param_groups}

    def __getitem__(self, name: str) -> nn.Parameter:
        """The current parameter of a group."""
        return self._groups[name]["params"][0]

    def set_learning_rate(self, name: str, value: float) -> None:
        """Change the learning rate of one group."""
        self._groups[name]["lr"] = value

    def zero_grad(self) -> None:
        """Drop all gradients."""
        self._adam.zero_grad(set_to_none=True)

    def step(self) -> None:
        """Update every parameter that has a gradient."""
        self._adam.step()

    def select(self, names: Iterable[str], keep: Tensor) -> None:
        """Keep only the rows where the (N,) mask is true, in parameters and moments."""
        rows = keep.nonzero().squeeze(1)
        for name in names:
            self._replace(name, lambda tensor: tensor.index_select(0, rows))

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add rows to parameters; their moments start at zero."""
        for name, new in rows.items():
            self._replace(
                name,
                lambda tensor, new=new: torch.cat([tensor, new]),  # type: ignore[misc]
                lambda moment, new=new: torch.cat([moment, torch.zeros_like(new)]),  # type: ignore[misc]
            )

    def set_values(self, name: str, values: Tensor) -> None:
        """Put new values into a parameter and forget its moments (opacity reset)."""
        self._replace(name, lambda _: values, torch.zeros_like)

    def _replace(self, name: str, change: Any, change_moment: Any = None) -> None:
        group = self._groups[name]
        old = group["params"][0]
        new = nn.Parameter(change(old.detach()).clone())
        state = self._adam.state.pop(old, None)
        if state:
            for moment in ("exp_avg", "exp_avg_sq"):
                state[moment] = (change_moment or change)(state[moment]).clone()
            self._adam.state[new] = state
        group["params"][0] = new

    def moments(self, name: str) -> dict[str, Tensor]:
        """Adam state of a group: exp_avg, exp_avg_sq, step; empty before its first step."""
        return dict(self._adam.state.get(self[name], {}))

    def state(self) -> dict[str, Any]:
        """Parameters, moments and learning rates as tensors and plain containers."""
        return {
            name: {
                "value": group["params"][0].detach(),
                "lr": float(group["lr"]),
                "moments": self.moments(name),
            }
            for name, group in self._groups.items()
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Take over what `state` gave, whatever the number of rows then was."""
        for name, group in self._groups.items():
            entry = state[name]
            old = group["params"][0]
            self._adam.state.pop(old, None)
            new = nn.Parameter(entry["value"].to(old.device, old.dtype))
            group["params"][0] = new
            group["lr"] = entry["lr"]
            if entry["moments"]:
                self._adam.state[new] = {k: v.to(old.device) for k, v in entry["moments"].items()}
