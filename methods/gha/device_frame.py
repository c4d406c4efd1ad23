"""The Gaussians of a pose on a GPU: `GaussianHead.splats` in few operations, see `shared.device_frame`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ..shared.binding import WorldSplats, left_products
from ..shared.device_frame import to_device
from .driving import HeadMotion, Influence, Signal, influences
from .gaussian_head import LARGEST_LOG_SCALE, FeatureSplats, GaussianHead
from .networks import SLOPE, Mlp, Weights, encode, encode_pose


class DeviceSplats:
    """Poses the Gaussians of an avatar. What the points alone decide, such as influences, is known beforehand.

    Parameters
    ----------
    tensors : as those of `GaussianHead.splats`.
    """

    def __init__(self, head: GaussianHead, tensors: Weights):
        c, nets = head.config, head.controllers
        points, features = tensors["points"], torch.tanh(tensors["features"])
        parts = influences(points, tensors["landmarks"], c.near_squared, c.far_squared)
        self._config = c
        self._bounds = tensors["code_low"].cpu(), tensors["code_high"].cpu()
        self._points = points
        # Scales in metres: the unit is a constant added to their logarithms.
        shift = math.log(c.unit)
        self._largest = LARGEST_LOG_SCALE + shift
        self._attributes = torch.cat(
            [tensors["log_scales"] + shift, tensors["quats"], tensors["opacities"][:, None]], dim=1
        )
        # Conditions are sent one after the other: the code, the code that is seen, the pose.
        code, pose = nets.expression_deform.condition_inputs, nets.pose_deform.condition_inputs
        self._conditions = 2 * code + pose
        places = {"code": 0, "seen": code, "pose": 2 * code}
        pairs = {
            "moves": (encode(points), nets.expression_deform, nets.pose_deform, "code"),
            "changes": (features, nets.expression_attribute, nets.pose_attribute, "seen"),
            "colors": (features, nets.expression_color, nets.pose_color, "seen"),
        }
        self._pairs: dict[str, _Pair] = {}
        weights: list[Tensor] = []
        biases: list[Tensor] = []
        start = 0
        for name, (inputs, of_expression, of_pose, seen) in pairs.items():
            members = []
            for mlp, part, place in ((of_expression, parts[0], seen), (of_pose, parts[1], "pose")):
                layers = _Layers(mlp, tensors, inputs, part, start)
                for weight, bias in layers.conditioned:
                    before = weight.new_zeros(len(weight), places[place])
                    after = weight.new_zeros(len(weight), self._conditions - places[place] - weight.shape[1])
                    weights.append(torch.cat([before, weight, after], dim=1))
                    biases.append(bias)
                    start += len(bias)
                members.append(layers)
            self._pairs[name] = _Pair(members, points.new_zeros(len(points), of_expression.outputs))
        self._by_conditions, self._biases = torch.cat(weights), torch.cat(biases)

    def __call__(self, signal: Signal, motion: HeadMotion) -> FeatureSplats:
        """Gaussians of a pose, from its signal and motion on the host."""
        low, high = self._bounds
        parts = (
            *(signal.expression, torch.minimum(torch.maximum(signal.expression, low), high)),
            *(encode_pose(motion.code), self._config.unit * motion.rotation.t(), motion.translation),
            left_products(motion.quaternion[None])[0].t(),
        )
        sent = to_device(torch.cat([part.flatten() for part in parts]).numpy(), self._points.device)
        conditions, rotation, translation, turn = sent.split([self._conditions, 9, 3, 16])
        biases = torch.addmv(self._biases, self._by_conditions, conditions)
        moves = self._pairs["moves"](biases, squashed=True)
        canonical = torch.add(self._points, moves, alpha=self._config.displacement_scale)
        means = torch.addmm(translation, canonical, rotation.view(3, 3))
        changes = self._pairs["changes"](biases)
        attributes = torch.add(self._attributes, changes, alpha=self._config.attribute_scale)
        scales, quats, logits = attributes.split([3, 4, 1], dim=1)
        world = WorldSplats(means, quats @ turn.view(4, 4), scales.clamp_max(self._largest).exp_())
        return FeatureSplats(world, torch.sigmoid(logits[:, 0]), self._pairs["colors"](biases))


class _Layers:
    """A network at the points that it acts on, (n, inputs); the condition's part of its layers comes as biases.

    Attributes
    ----------
    conditioned : weights (H, condition_inputs) and biases (H,) of the layers that take the condition, whose sums are to be
        found from ``start`` on.
    """

    def __init__(self, mlp: Mlp, tensors: Weights, inputs: Tensor, part: Influence, start: int):
        self._inputs = inputs.index_select(0, part.rows)
        self.rows, self._influence = part.rows, part.weights[:, None].contiguous()
        self.conditioned: list[tuple[Tensor, Tensor]] = []
        # Of each layer: weights of the values before and of the inputs, and the bias or where it is found.
        self._steps: list[tuple[Tensor | None, Tensor | None, Tensor | slice]] = []
        count = len(mlp.widths) - 1
        for layer in range(count):
            weight, bias = tensors[f"{mlp.name}.weight_{layer}"], tensors[f"{mlp.name}.bias_{layer}"]
            takes = mlp.takes_inputs(layer)
            values = mlp.widths[layer] if layer else 0
            of_values = weight[:, :values].t().contiguous() if layer else None
            if not takes:
                self._steps.append((of_values, None, bias))
                continue
            of_inputs, by_condition = weight[:, values:].split(
                [mlp.point_inputs, mlp.condition_inputs], dim=1
            )
            self.conditioned.append((by_condition, bias))
            self._steps.append((of_values, of_inputs.t().contiguous(), slice(start, start + len(bias))))
            start += len(bias)

    def __call__(self, biases: Tensor, squashed: bool) -> Tensor:
        """(n, outputs), their tanh if ``squashed``, times the influence."""
        values = self._inputs
        for of_values, of_inputs, bias in self._steps:
            total = biases[bias] if isinstance(bias, slice) else bias
            if of_values is not None:
                total = torch.addmm(total, F.leaky_relu_(values, SLOPE), of_values)
            values = total if of_inputs is None else torch.addmm(total, self._inputs, of_inputs)
        return self._influence * (values.tanh_() if squashed else values)


class _Pair:
    """Sum of two networks' outputs over all points, (N, C); ``nothing`` is 0 of that shape."""

    def __init__(self, members: Sequence[_Layers], nothing: Tensor):
        self._members, self._nothing = members, nothing

    def __call__(self, biases: Tensor, squashed: bool = False) -> Tensor:
        first, second = (layers(biases, squashed) for layers in self._members)
        total = self._nothing.index_add(0, self._members[0].rows, first)
        return total.index_add_(0, self._members[1].rows, second)
