"""The networks by the compiled kernel, with gradients in closed form.

Each function names its reference in torch, which is the definition, takes float64, and is used where the kernel is not: other
devices, other dtypes, or no compiler at installation. The kernel's results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...bench.native.loader import Kernel
from ..shared.networks import ENCODING_SIZE
from ..shared.threads import threads

KERNEL = Kernel(
    "headbench.methods.gha._kernel", "GHA's kernel", "torch computes its networks meanwhile, slowly"
)
UNITS_STEP = 16
"""Channels are padded to a multiple of it."""


def available() -> bool:
    """Whether the kernel is there; one built from older sources, in an editable installation, counts as none."""
    return hasattr(KERNEL.imported, "motion")


def usable(like: Tensor) -> bool:
    """Whether the kernel is there and takes tensors like this one."""
    return like.dtype == torch.float32 and like.device.type == "cpu" and available()


class PerceptronPart(NamedTuple):
    """A network at some rows of a table; see `networks.Mlp`.

    Attributes
    ----------
    rows : (n,) int64, each at most once.
    influence : (n,) that its values are multiplied by, or None.
    condition : (C,), (B, C), or None.
    weights, biases : by layer.
    again : the layer that the inputs come into once more, or 0.
    squashed : whether tanh follows the last layer.
    """

    rows: Tensor
    influence: Tensor | None
    condition: Tensor | None
    weights: Sequence[Tensor]
    biases: Sequence[Tensor]
    again: int
    squashed: bool


def perceptron(
    points: Tensor, part: PerceptronPart, outputs: int, slope: float, instruction_set: str = ""
) -> Tensor:
    """(n, outputs) first outputs of a network at rows of the (N, F) points; (B, n, outputs) for a (B, C) condition.

    Compiled form of `networks.Mlp.reference`. With several conditions there is no gradient by the points.
    """
    values: Tensor = _Perceptrons.apply(  # type: ignore[no-untyped-call]
        *((part,), outputs, slope, instruction_set, points, part.influence, part.condition),
        *(*part.weights, *part.biases),
    )
    several = part.condition is not None and part.condition.ndim == 2
    return values.view(-1, len(part.rows), outputs) if several else values


def blended(
    points: Tensor, parts: Sequence[PerceptronPart], outputs: int, slope: float, instruction_set: str = ""
) -> Tensor:
    """(N, outputs) sums of networks' values times their influences at (N, F) points: compiled form of
    `networks.blended_reference`."""
    tensors: list[Tensor | None] = []
    for part in parts:
        tensors += [part.influence, part.condition, *part.weights, *part.biases]
    total: Tensor = _Perceptrons.apply(tuple(parts), outputs, slope, instruction_set, points, *tensors)  # type: ignore[no-untyped-call]
    return total


class _Perceptrons(torch.autograd.Function):
    """Influence, condition, weights and biases of each part follow the points."""

    @staticmethod
    def forward(
        ctx: Any,
        parts: tuple[PerceptronPart, ...],
        outputs: int,
        slope: float,
        instruction_set: str,
        points: Tensor,
        *tensors: Tensor | None,
    ) -> Tensor:
        keeps = any(ctx.needs_input_grad)
        blends = parts[0].influence is not None
        total = points.new_zeros(len(points), outputs) if blends else points.new_empty(0, outputs)
        saved: list[Tensor] = [points.contiguous()]
        for part in parts:
            conditions = _conditions(part, points)
            hidden = [len(weight) for weight in part.weights[:-1]]
            count = KERNEL.load().kept_floats(len(conditions), len(part.rows), hidden) if keeps else 0
            kept = points.new_empty(count)
            values = points.new_empty(len(conditions) * len(part.rows), outputs)
            inputs = _arrays(part, saved[0], conditions, slope)
            KERNEL.load().forward(
                *(*inputs, kept.numpy(), values.numpy(), total.numpy()),
                *(instruction_set, threads()),
            )
            saved += [kept, values]
        ctx.settings = parts, slope, instruction_set
        ctx.save_for_backward(*saved)
        return total if blends else saved[-1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        parts, slope, instruction_set = ctx.settings
        points, *saved = ctx.saved_tensors
        by_points = (
            torch.zeros_like(points) if ctx.needs_input_grad[4] else points.new_empty(0, points.shape[1])
        )
        gradient = grad.contiguous()
        found: list[Tensor | None] = []
        for part, kept, values in zip(parts, saved[::2], saved[1::2]):
            conditions = _conditions(part, points)
            by_influence = points.new_empty(0 if part.influence is None else len(part.rows))
            by_condition = torch.empty_like(conditions)
            by_weights = [torch.empty_like(weight) for weight in part.weights]
            by_biases = [torch.empty_like(bias) for bias in part.biases]
            KERNEL.load().backward(
                *_arrays(part, points, conditions, slope),
                *(
                    tensor.numpy()
                    for tensor in (kept, values, gradient, by_points, by_influence, by_condition)
                ),
                *([tensor.numpy() for tensor in tensors] for tensors in (by_weights, by_biases)),
                *(instruction_set, threads()),
            )
            found.append(None if part.influence is None else by_influence)
            found.append(None if part.condition is None else by_condition.view(part.condition.shape))
            found += [*by_weights, *by_biases]
        return None, None, None, None, by_points if ctx.needs_input_grad[4] else None, *found


def _conditions(part: PerceptronPart, like: Tensor) -> Tensor:
    if part.condition is None:
        return like.new_empty(1, 0)
    return part.condition.detach().view(-1, part.condition.shape[-1]).contiguous()


def _arrays(part: PerceptronPart, points: Tensor, conditions: Tensor, slope: float) -> list[Any]:
    """What both passes of the kernel take first."""
    influence = points.new_empty(0) if part.influence is None else part.influence.detach()
    return [
        *(points.detach().numpy(), part.rows.numpy(), influence.contiguous().numpy(), conditions.numpy()),
        *([t.detach().contiguous().numpy() for t in tensors] for tensors in (part.weights, part.biases)),
        *(part.again, part.squashed, slope),
    ]


def normalised_convolution(values: Tensor, weight: Tensor, instruction_set: str = "") -> Tensor:
    """(H, W, D) 3x3 convolution, padded with zeros, of an (H, W, C) image by (D, C, 3, 3) weights, each channel normalised
    over the image and rectified: compiled form of `gaussian_head.normalised_convolution`."""
    out: Tensor = _Convolution.apply(values, weight, instruction_set)  # type: ignore[no-untyped-call]
    return out


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, weight: Tensor, instruction_set: str) -> Tensor:
        values, weight = values.contiguous(), weight.contiguous()
        raw = values.new_empty(*values.shape[:2], len(weight))
        moments = values.new_empty(2, -(-len(weight) // UNITS_STEP) * UNITS_STEP)
        # Without gradients nobody asks for the raw values again.
        out = torch.empty_like(raw) if any(ctx.needs_input_grad) else raw
        KERNEL.load().convolve(
            *(tensor.detach().numpy() for tensor in (values, weight, raw, moments, out)),
            *(instruction_set, threads()),
        )
        ctx.save_for_backward(values, weight, raw, moments)
        ctx.instruction_set = instruction_set
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, weight, raw, moments = ctx.saved_tensors
        wanted = ctx.needs_input_grad[0]
        by_values = torch.empty_like(values) if wanted else values.new_empty(0, *values.shape[1:])
        by_weight = torch.empty_like(weight)
        arrays = (values, weight, raw, moments, grad.contiguous(), by_values, by_weight)
        KERNEL.load().convolve_backward(
            *(tensor.detach().numpy() for tensor in arrays), ctx.instruction_set, threads()
        )
        return by_values if wanted else None, by_weight, None


def influences(
    points: Tensor, landmarks: Tensor, near_squared: float, far_squared: float, instruction_set: str = ""
) -> tuple[Tensor, ...]:
    """Rows and weights of the near points, then of the far ones: compiled form of `driving.reference_influences`."""
    found: tuple[Tensor, ...] = _Influences.apply(  # type: ignore[no-untyped-call]
        points, landmarks, near_squared, far_squared, instruction_set
    )
    return found


class _Influences(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        landmarks: Tensor,
        near_squared: float,
        far_squared: float,
        instruction_set: str,
    ) -> tuple[Tensor, ...]:
        points, landmarks = points.contiguous(), landmarks.contiguous()
        nearest = torch.empty(len(points), dtype=torch.int32)
        rows = torch.empty(2, len(points), dtype=torch.int64)
        weights = points.new_empty(2, len(points))
        near, far = KERNEL.load().influences(
            *_plain(points, landmarks, near_squared, far_squared, nearest, rows, weights),
            *(instruction_set, threads()),
        )
        found = rows[0, :near], weights[0, :near].clone(), rows[1, :far], weights[1, :far].clone()
        ctx.mark_non_differentiable(found[0], found[2])
        ctx.save_for_backward(points, landmarks, nearest, *found)
        ctx.distances = near_squared, far_squared
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        points, landmarks, nearest, near, near_weights, far, far_weights = ctx.saved_tensors
        by_points = torch.empty_like(points)
        by_landmarks = torch.empty_like(landmarks) if ctx.needs_input_grad[1] else landmarks.new_empty(0, 3)
        KERNEL.load().influences_backward(
            *_plain(points, landmarks, *ctx.distances, nearest, near, near_weights, grads[1].contiguous()),
            *_plain(far, far_weights, grads[3].contiguous(), by_points, by_landmarks),
        )
        return by_points, by_landmarks if ctx.needs_input_grad[1] else None, None, None, None


def _plain(*values: Any) -> list[Any]:
    """Tensors as arrays, other values as they are."""
    return [value.detach().numpy() if isinstance(value, Tensor) else value for value in values]


def encode(points: Tensor, instruction_set: str = "") -> Tensor:
    """(N, 27) positional encoding of (N, 3) points: compiled form of `shared.networks.encode`."""
    encoded: Tensor = _Encoding.apply(points, instruction_set)  # type: ignore[no-untyped-call]
    return encoded


class _Encoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, instruction_set: str) -> Tensor:
        encoded = points.new_empty(len(points), ENCODING_SIZE)
        arrays = points.detach().contiguous().numpy(), encoded.numpy()
        KERNEL.load().encode(*arrays, instruction_set, threads())
        ctx.save_for_backward(encoded)
        ctx.instruction_set = instruction_set
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (encoded,) = ctx.saved_tensors
        by_points = encoded.new_empty(len(encoded), 3)
        arrays = (tensor.detach().numpy() for tensor in (encoded, grad.contiguous(), by_points))
        KERNEL.load().encode_backward(*arrays, ctx.instruction_set, threads())
        return by_points, None


def tanh(values: Tensor, instruction_set: str = "") -> Tensor:
    """Hyperbolic tangent."""
    found: Tensor = _Tanh.apply(values, instruction_set)  # type: ignore[no-untyped-call]
    return found


class _Tanh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, instruction_set: str) -> Tensor:
        values = values.contiguous()
        found = torch.empty_like(values)
        KERNEL.load().tanh(*_plain(values.view(-1), found.view(-1)), instruction_set, threads())
        ctx.save_for_backward(found)
        ctx.instruction_set = instruction_set
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (found,) = ctx.saved_tensors
        by_values = torch.empty_like(found)
        tensors = (tensor.view(-1) for tensor in (found, grad.contiguous(), by_values))
        KERNEL.load().tanh_backward(*_plain(*tensors), ctx.instruction_set, threads())
        return by_values, None


def near_drawn(alpha: Tensor, reach: int, covered: float) -> Tensor:
    """(h, w) uint8: compiled form of `gaussian_head.near_drawn`."""
    near = torch.empty(alpha.shape, dtype=torch.uint8)
    KERNEL.load().near_drawn(*_plain(alpha.contiguous(), reach, covered, near))
    return near


def residual_image(
    values: Tensor,
    weight: Tensor,
    bias: Tensor,
    plain: Tensor,
    alpha: Tensor,
    near: Tensor,
    background: Tensor,
    instruction_set: str = "",
) -> Tensor:
    """(H, W, 3) image: compiled form of `gaussian_head.residual_image`, whose ``near`` is uint8 here."""
    image: Tensor = _ResidualImage.apply(
        values, weight, bias, plain, alpha, near, background, instruction_set
    )  # type: ignore[no-untyped-call]
    return image


class _ResidualImage(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Tensor:
        tensors = [tensor.contiguous() for tensor in inputs[:7]]
        image = torch.empty_like(tensors[3])
        KERNEL.load().colors(*_plain(*tensors, image), inputs[7], threads())
        ctx.save_for_backward(*tensors[:6])
        ctx.instruction_set = inputs[7]
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        gradients = [torch.empty_like(tensor) for tensor in ctx.saved_tensors[:5]]
        KERNEL.load().colors_backward(
            *_plain(*ctx.saved_tensors, grad.contiguous(), *gradients), ctx.instruction_set, threads()
        )
        return *gradients, None, None, None


class Scales(NamedTuple):
    """How numbers become lengths; see `GHAConfig`, and `gaussian_head.LARGEST_LOG_SCALE` for the last."""

    unit: float
    displacement: float
    attribute: float
    largest_log_scale: float


def posed(scales: Scales, *tensors: Tensor, instruction_set: str = "") -> tuple[Tensor, ...]:
    """Means, quaternions, scales and opacities of a pose: compiled form of `gaussian_head.posed`."""
    found: tuple[Tensor, ...] = _Posed.apply(scales, instruction_set, *tensors)  # type: ignore[no-untyped-call]
    return found


class _Posed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Scales, instruction_set: str, *tensors: Tensor) -> tuple[Tensor, ...]:
        inputs = [tensor.contiguous() for tensor in tensors]
        _, _, _, points, _, _, quats, opacities, _ = inputs
        found = tuple(torch.empty_like(like) for like in (points, quats, points, opacities))
        KERNEL.load().pose(*scales, *_plain(*inputs, *found), instruction_set, threads())
        ctx.save_for_backward(*inputs, *found[2:])
        ctx.settings = scales, instruction_set
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        scales, instruction_set = ctx.settings
        gradients = [torch.empty_like(tensor) for tensor in ctx.saved_tensors[:9]]
        outer = (grad.contiguous() for grad in grads)
        KERNEL.load().pose_backward(
            *scales, *_plain(*ctx.saved_tensors, *outer, *gradients), *(instruction_set, threads())
        )
        return None, None, *gradients


def with_colors(features: Tensor) -> tuple[Tensor, Tensor]:
    """The (H, W, C) features, and a copy of their first three channels; one pass for both gradients."""
    found: tuple[Tensor, Tensor] = _WithColors.apply(features)  # type: ignore[no-untyped-call]
    return found


class _WithColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor) -> tuple[Tensor, Tensor]:
        return features.view_as(features), features[..., :3].contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        gradient = grads[0].clone()
        gradient[..., :3] += grads[1]
        return gradient


MOTION = (9, 3, 6, 4)
"""Numbers of a motion: rotation, translation, code, quaternion."""


def motion(tracked: Tensor, correction: Tensor) -> tuple[Tensor, ...]:
    """(3, 3), (3,), (6,) and (4,) of a head motion: compiled form of `driving.reference_motion`.

    Parameters
    ----------
    tracked : (6, 3) rotation, neck, translation, root and neck joint, origin.
    correction : (6,).
    """
    numbers: Tensor = _Motion.apply(tracked, correction)  # type: ignore[no-untyped-call]
    rotation, translation, code, quaternion = numbers.split(MOTION)
    return rotation.view(3, 3), translation, code, quaternion


class _Motion(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tracked: Tensor, correction: Tensor) -> Tensor:
        found, derivatives = tracked.new_empty(sum(MOTION)), tracked.new_empty(sum(MOTION), len(correction))
        KERNEL.load().motion(
            *_plain(tracked.contiguous().view(-1), correction.contiguous(), found, derivatives)
        )
        ctx.save_for_backward(derivatives)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return None, grad @ ctx.saved_tensors[0]
