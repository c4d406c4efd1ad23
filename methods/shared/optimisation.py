"""Adam over named groups whose per-splat tensors may grow and shrink, densification, penalties, and small networks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import linear
from torch.optim.adam import adam

from ...bench.contracts import ByteArray, HeadAsset
from ...bench.native.dispatch import to_device
from ...datasets.head.rotations import axis_angle_to_matrix, quaternion_to_matrix
from ..ops.photometric import mean_ssim
from .config import DensifiedTraining
from .schedule import DensifySchedule, torch_generator

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


def squared_error(picture: ByteArray, truth: ByteArray) -> float:
    """Mean squared difference of two 8-bit images, in squared levels."""
    return float(np.mean((picture.astype(np.float64) - truth) ** 2))


def psnr(error: float) -> float:
    """PSNR in dB for a mean squared difference of 8-bit images; infinite for 0."""
    return math.inf if error == 0 else 10 * math.log10(255**2 / error)


def picture_ssim(picture: ByteArray, truth: ByteArray) -> float:
    """`mean_ssim` of two (H, W, 3) 8-bit images."""
    planes = [torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1) for image in (picture, truth)]
    return float(mean_ssim(*(image.contiguous() for image in planes)))


EPS = 1e-15


class OptimiserState:
    """State of a `Trainable` whose only state is its optimiser."""

    optimiser: Optimiser

    def state(self) -> dict[str, Any]:
        """Parameters and moments."""
        return {"optimiser": self.optimiser.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.optimiser.load_state(state["optimiser"])


class Optimiser:
    """One Adam (dense) over named parameters.

    Densification replaces per-splat parameters by longer or shorter ones; `select` and `append` keep the moments, with
    zeros for new rows. A replaced parameter has no gradient, so it is not changed by the following step, as in the
    published code.

    - ``betas``: decay of the two moments.
    - ``epsilons``: epsilon by name; `EPS`, that of 3DGS, for all others.
    """

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        learning_rates: Mapping[str, float],
        betas: tuple[float, float] = (0.9, 0.999),
        epsilons: Mapping[str, float] = {},
    ):
        self._parameters = dict(parameters)
        self._rates = {name: learning_rates[name] for name in parameters}
        self._betas, self._epsilons = betas, epsilons
        self._moments: dict[str, dict[str, Tensor]] = {}

    def __getitem__(self, name: str) -> nn.Parameter:
        """The current parameter of a group."""
        return self._parameters[name]

    def set_learning_rate(self, name: str, value: float) -> None:
        """Change the learning rate of one group."""
        self._rates[name] = value

    def zero_grad(self) -> None:
        """Drop all gradients."""
        for parameter in self._parameters.values():
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Update every parameter that has a gradient; Kingma and Ba 2015, algorithm 1.

        `torch.optim.Adam` does the same in one call for each group, with a third of a millisecond for its bookkeeping.
        """
        together: dict[tuple[float, float], list[str]] = {}
        for name, parameter in self._parameters.items():
            if parameter.grad is not None:
                together.setdefault((self._rates[name], self._epsilons.get(name, EPS)), []).append(name)
        first, second = self._betas
        for (rate, epsilon), names in together.items():
            parameters: list[Any] = [self._parameters[name] for name in names]
            columns = zip(*(self._state(name).values() for name in names))
            averages, squares, steps = (list(column) for column in columns)
            gradients = [parameter.grad for parameter in parameters]
            adam(
                parameters,
                gradients,
                averages,
                squares,
                [],
                steps,
                beta1=first,
                beta2=second,
                lr=rate,
                eps=epsilon,
                weight_decay=0.0,
                amsgrad=False,
                maximize=False,
                fused=True,
            )

    def _state(self, name: str) -> dict[str, Tensor]:
        """Moments of a group, zero before its first step."""
        if name not in self._moments:
            parameter = self._parameters[name]
            zeros = {moment: torch.zeros_like(parameter) for moment in ("exp_avg", "exp_avg_sq")}
            self._moments[name] = {**zeros, "step": torch.zeros((), device=parameter.device)}
        return self._moments[name]

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
        """Set the values of a parameter and reset its moments (opacity reset)."""
        self._replace(name, lambda _: values, torch.zeros_like)

    def _replace(self, name: str, change: Any, change_moment: Any = None) -> None:
        self._parameters[name] = nn.Parameter(change(self[name].detach()).clone())
        state = self._moments.get(name, {})
        for moment in state.keys() - {"step"}:
            state[moment] = (change_moment or change)(state[moment]).clone()

    def moments(self, name: str) -> dict[str, Tensor]:
        """Adam state of a group: exp_avg, exp_avg_sq, step; empty before its first step."""
        return dict(self._moments.get(name, {}))

    def state(self) -> dict[str, Any]:
        """Parameters, moments and learning rates as tensors and plain containers."""
        return {
            name: {"value": parameter.detach(), "lr": float(self._rates[name]), "moments": self.moments(name)}
            for name, parameter in self._parameters.items()
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore what `state` returned; tensors may have any number of rows."""
        for name, old in self._parameters.items():
            entry = state[name]
            self._parameters[name] = nn.Parameter(entry["value"].to(old.device, old.dtype))
            self._rates[name] = entry["lr"]
            self._moments.pop(name, None)
            if entry["moments"]:
                moments = {
                    key: entry["moments"][key].to(old.device) for key in ("exp_avg", "exp_avg_sq", "step")
                }
                self._moments[name] = moments


CHILDREN = 2
SHRINK = 0.8 * CHILDREN  # ratio of a parent's scale to its children's


class Densifier:
    """Accumulates projected gradients, and clones, splits and prunes splats.

    Per-splat parameters are the optimiser's groups ``names``; "means", "log_scales", "quats" and "opacities"
    (logits) must be among them.

    - ``binding``: (N,) int64, triangle of each splat.
    - ``extent``: size of the scene, metres (`scene_extent`).
    - ``thresholds``: (F,) gradient above which splats are cloned or split, by triangle; None uses ``settings.densify_gradient``
      for all.
    - ``keep_last``: whether the last splat of a triangle is never removed.
    - ``tables``: groups with any number of rows per splat, ordered by splat; splats on one triangle have the same number.
      Children inherit them.
    - ``table_rows``: (F,) int64, number of rows in the tables for a splat on each triangle.
    """

    def __init__(
        self,
        settings: DensifiedTraining,
        optimiser: Optimiser,
        names: tuple[str, ...],
        binding: Tensor,
        face_count: int,
        extent: float,
        seed: int,
        *,
        thresholds: Tensor | None = None,
        keep_last: bool = True,
        tables: tuple[str, ...] = (),
        table_rows: Tensor | None = None,
    ):
        self.binding = binding
        self._thresholds, self._keep_last = thresholds, keep_last
        self._tables, self._table_rows = tables, table_rows
        self._settings, self._optimiser, self._names = settings, optimiser, names
        self._face_count, self._extent, self._seed = face_count, extent, seed
        self._restart()

    def observe(self, gradient: Tensor, visible: Tensor, width: int, height: int) -> None:
        """Add one view: (N, 2) gradient with respect to the projected means in pixels, and (N,) whether a splat was
        visible.

        Gradients are converted to normalised device units by half the image size, the unit of the published thresholds.
        """
        half = to_device(torch.tensor([0.5 * width, 0.5 * height], dtype=gradient.dtype), gradient.device)
        seen = visible.to(gradient.dtype)
        self._gradient_sum += torch.linalg.vector_norm(gradient * half, dim=1) * seen
        self._views += seen

    def run(self, iteration: int, schedule: DensifySchedule, face_sizes: Tensor) -> None:
        """Clone, split and prune, then reset the accumulated gradients.

        ``face_sizes``: (F,) triangle sizes of the current frame, metres, which convert local scales into world scales.
        """
        gradient = self._gradient_sum / self._views.clamp_min(1)
        if self._thresholds is None:
            asks = gradient >= self._settings.densify_gradient
        else:
            asks = gradient >= self._thresholds.index_select(0, self.binding)
        asks = self._within_bound(asks, gradient)
        large = self._world_scale(face_sizes) > self._settings.densify_extent * self._extent
        parents = asks & large
        self._clone(asks & ~large)
        self._split(parents, face_sizes, iteration)
        self._prune(parents, face_sizes, schedule.prunes_large(iteration))
        self._restart()

    def reset_opacity(self) -> None:
        """Clamp opacities to the reset value and reset their moments."""
        ceiling = logit(self._settings.reset_opacity)
        logits = self._optimiser["opacities"].detach()
        self._optimiser.set_values("opacities", logits.clamp_max(ceiling))

    def state(self) -> dict[str, Any]:
        """Binding and accumulated statistics."""
        return {"binding": self.binding, "gradient_sum": self._gradient_sum, "views": self._views}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned."""
        self.binding = state["binding"]
        self._gradient_sum, self._views = state["gradient_sum"], state["views"]

    def _restart(self) -> None:
        like = self._optimiser["means"]
        self._gradient_sum = torch.zeros(len(self.binding), dtype=like.dtype, device=like.device)
        self._views = torch.zeros_like(self._gradient_sum)

    def _world_scale(self, face_sizes: Tensor) -> Tensor:
        largest = self._optimiser["log_scales"].detach().amax(1).exp()
        return largest * face_sizes.index_select(0, self.binding)

    def _within_bound(self, asks: Tensor, gradient: Tensor) -> Tensor:
        """If the maximum number of splats limits densification, select the candidates with the largest gradients."""
        if self._settings.max_splats is None:
            return asks
        room = max(self._settings.max_splats - len(self.binding), 0)
        if int(asks.sum()) <= room:
            return asks
        # A stable sort keeps the order of equal gradients, so that a resumed run selects the same splats.
        order = torch.argsort(
            torch.where(asks, gradient, gradient.new_full((), -1.0)), descending=True, stable=True
        )
        chosen = torch.zeros_like(asks)
        chosen[order[:room]] = True
        return chosen

    def _rows(self, rows: Tensor) -> dict[str, Tensor]:
        taken = {name: self._optimiser[name].detach().index_select(0, rows) for name in self._names}
        if self._table_rows is not None:
            entries = rows_of_tables(self._table_rows.index_select(0, self.binding), rows)
            taken |= {name: self._optimiser[name].detach().index_select(0, entries) for name in self._tables}
        return taken

    def _append(self, rows: dict[str, Tensor], binding: Tensor) -> None:
        self._optimiser.append(rows)
        self.binding = torch.cat([self.binding, binding])

    def _clone(self, mask: Tensor) -> None:
        rows = mask.nonzero().squeeze(1)
        self._append(self._rows(rows), self.binding.index_select(0, rows))

    def _split(self, parents: Tensor, face_sizes: Tensor, iteration: int) -> None:
        """Add the children of the parents; `_prune` then removes the parents."""
        rows = parents.nonzero().squeeze(1).repeat(CHILDREN)
        binding = self.binding.index_select(0, rows)
        children = self._rows(rows)
        scales = children["log_scales"].exp()
        spread = scales
        if self._settings.split_variant == "official":
            spread = scales * face_sizes.index_select(0, binding)[:, None]
        generator = torch_generator(self._seed, "split", iteration)
        noise = torch.randn(scales.shape, generator=generator, dtype=scales.dtype).to(scales.device)
        offsets = quaternion_to_matrix(children["quats"]) @ (noise * spread)[:, :, None]
        children["means"] = children["means"] + offsets[:, :, 0]
        children["log_scales"] = (scales / SHRINK).log()
        self._append(children, binding)

    def _prune(self, parents: Tensor, face_sizes: Tensor, large_too: bool) -> None:
        replaced = torch.zeros_like(self.binding, dtype=torch.bool)
        replaced[: len(parents)] = parents
        unfit = torch.sigmoid(self._optimiser["opacities"].detach()) < self._settings.prune_opacity
        if large_too:
            unfit |= self._world_scale(face_sizes) > self._settings.prune_extent * self._extent
        if self._keep_last:
            # A parent is always removed: its children keep the triangle occupied.
            kept = torch.bincount(self.binding[~(replaced | unfit)], minlength=self._face_count)
            unfit &= kept.index_select(0, self.binding) > 0
        keep = ~(replaced | unfit)
        self._optimiser.select(self._names, keep)
        if self._table_rows is not None:
            entries = self._table_rows.index_select(0, self.binding)
            self._optimiser.select(self._tables, keep.repeat_interleave(entries))
        self.binding = self.binding[keep]


def rows_of_tables(counts: Tensor, splats: Tensor) -> Tensor:
    """Rows of some splats, in order, in a table with ``counts`` (N,) rows per splat."""
    starts = counts.cumsum(0) - counts
    chosen = counts.index_select(0, splats)
    within = torch.arange(int(chosen.sum()), device=counts.device)
    before = chosen.cumsum(0) - chosen
    return within + (starts.index_select(0, splats) - before).repeat_interleave(chosen)


def logit(probability: float) -> float:
    """Inverse of the sigmoid."""
    return math.log(probability / (1 - probability))
