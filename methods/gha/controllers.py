"""What expression and head pose do to points: networks for colour, displacement and attributes, in pairs.

Of each pair one network sees the expression and one the head pose; how much each says depends on the distance to the
landmarks (`landmarks.influences`), and each is evaluated only where it has a say.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..shared.networks import ENCODING_SIZE, encode
from .config import GHAConfig
from .driving import POSE_SIZE
from .landmarks import Influence
from .networks import Mlp, Weights

ATTRIBUTES = (3, 4, 1)
"""Offsets of log-scale, quaternion and opacity logit."""

Influences = tuple[Influence, Influence]


@dataclass(frozen=True)
class Controllers:
    """The six networks.

    ``expression`` is the (E,) expression code throughout, ``pose`` the (54,) encoded head pose (`encode_pose`).
    """

    expression_color: Mlp
    pose_color: Mlp
    expression_deform: Mlp
    pose_deform: Mlp
    expression_attribute: Mlp
    pose_attribute: Mlp

    @classmethod
    def of(cls, config: GHAConfig, expression_size: int) -> Controllers:
        """Networks of the configured widths for E driving values."""
        pose = encoded_size(POSE_SIZE)

        def pair(
            kind: str, inputs: int, hidden: tuple[tuple[int, ...], ...], outputs: int
        ) -> tuple[Mlp, Mlp]:
            starts = (config.at_rest, config.at_rest and kind != "color")
            return (
                Mlp(f"expression_{kind}", inputs, expression_size, hidden[0], outputs, *starts),
                Mlp(f"pose_{kind}", inputs, pose, hidden[1], outputs, *starts),
            )

        c = config
        return cls(
            *pair("color", c.features, (c.expression_color_hidden, c.pose_color_hidden), c.channels),
            *pair("deform", ENCODING_SIZE, (c.expression_deform_hidden, c.pose_deform_hidden), 3),
            *pair(
                "attribute",
                c.features,
                (c.expression_attribute_hidden, c.pose_attribute_hidden),
                sum(ATTRIBUTES),
            ),
        )

    @property
    def of_mesh(self) -> tuple[Mlp, ...]:
        """Those that the mesh stage trains."""
        return self.expression_color, self.pose_color, self.expression_deform, self.pose_deform

    @property
    def of_gaussians(self) -> tuple[Mlp, ...]:
        """All of them."""
        return *self.of_mesh, self.expression_attribute, self.pose_attribute

    def colors(
        self,
        weights: Weights,
        features: Tensor,
        influences: Influences,
        expression: Tensor,
        pose: Tensor,
        channels: int | None = None,
    ) -> Tensor:
        """(N, C) of (N, F) features within (-1, 1), without activation; the first ``channels`` if given."""
        near, far = influences
        return _joined(
            len(features),
            (near, self.expression_color(weights, _rows(features, near), expression, channels)),
            (far, self.pose_color(weights, _rows(features, far), pose, channels)),
        )

    def attributes(
        self, weights: Weights, features: Tensor, influences: Influences, expression: Tensor, pose: Tensor
    ) -> tuple[Tensor, ...]:
        """(N, 3) log-scale, (N, 4) quaternion and (N, 1) opacity logit offsets, before their common factor."""
        near, far = influences
        values = _joined(
            len(features),
            (near, self.expression_attribute(weights, _rows(features, near), expression)),
            (far, self.pose_attribute(weights, _rows(features, far), pose)),
        )
        return values.split(list(ATTRIBUTES), dim=1)

    def displacements(
        self, weights: Weights, points: Tensor, influences: Influences, expression: Tensor, pose: Tensor
    ) -> Tensor:
        """(N, 3) displacements of (N, 3) points, each within (-1, 1), before their factor."""
        encoded = encode(points)
        near, far = influences
        return _joined(
            len(points),
            (near, torch.tanh(self.expression_deform(weights, _rows(encoded, near), expression))),
            (far, torch.tanh(self.pose_deform(weights, _rows(encoded, far), pose))),
        )


def encoded_size(size: int) -> int:
    """Numbers that `triplane.encode` makes of ``size``."""
    return size * ENCODING_SIZE // 3


def encode_pose(code: Tensor) -> Tensor:
    """(54,) of the (6,) code of a head pose."""
    return encode(code[None])[0]


def _rows(values: Tensor, influence: Influence) -> Tensor:
    return values.index_select(0, influence.rows)


def _joined(count: int, *parts: tuple[Influence, Tensor]) -> Tensor:
    """(count, C) sum of the parts' values by their weights."""
    total = parts[0][1].new_zeros(count, parts[0][1].shape[1])
    for influence, values in parts:
        total = total.index_add(0, influence.rows, influence.weights[:, None] * values)
    return total
