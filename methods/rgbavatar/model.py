"""The model of RGBAvatar: blendshapes of splats, the network of their weights, and the avatar's file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor
from torch.nn.functional import linear

from ...bench.configuration import build
from ...bench.contracts import HeadAsset
from ..ops.planes import C0
from ..shared.optimisation import input_count, layer_names, layer_shapes, outputs_of
from ..shared.surface_points import SubjectMesh, SurfacePoints
from ..shared.surface_splats import ChartSurface, PointSurface, SurfaceSplats
from .spec import RGBAvatarConfig

SHAPES = {"means": "mean_shapes", "quats": "quat_shapes", "colors": "color_shapes"}
"""Attributes that blendshapes change, and the names of their blendshapes."""
PER_SPLAT = {"means": (3,), "quats": (4,), "colors": (3,), "log_scales": (3,), "opacities": ()}
"""Shape of a splat's attributes. Positions are in metres along the axes of the triangle, quaternions wxyz, colours harmonics of
degree 0, scales logarithms of metres, opacities logits."""
WEIGHTS, BIASES = layer_names(3)
FRAMES = ";frame_variant="
"""Separator of the inputs and the variant of the axes in an avatar's file."""


def blend_weights(network: Mapping[str, Tensor], inputs: Tensor) -> Tensor:
    """(T, K) weights of the blendshapes for (T, I) inputs; three layers with ReLU between them."""
    return outputs_of(network, linear(inputs, network[WEIGHTS[0]], network[BIASES[0]]), len(WEIGHTS))


def blended(splats: Mapping[str, Tensor], weights: Tensor) -> list[dict[str, Tensor]]:
    """Splats of each of T poses: the neutral ones plus the blendshapes times the (T, K) weights."""
    posed: list[dict[str, Tensor]] = [dict(splats) for _ in range(len(weights))]
    for name, shapes_name in SHAPES.items():
        shapes = splats[shapes_name]
        changes = (weights @ shapes.flatten(1)).view(-1, *shapes.shape[1:])
        for splat, change in zip(posed, changes):
            splat[name] = splat[name] + change
    return posed


def seen_colors(values: Tensor) -> Tensor:
    """(N, 3) colours of harmonics of degree 0, from every direction."""
    return (0.5 + C0 * values).relu()


class StoredShapes(SurfaceSplats[RGBAvatarConfig]):
    """Content of an avatar's file: neutral splats by the names of `PER_SPLAT`, blendshapes by those of `SHAPES`, and the network.

    A splat takes 68 bytes, and 40 for each of its blendshapes. The file also contains the names of the network's inputs and
    the variant of the axes.
    """

    KEY = "inputs"

    @classmethod
    def surface(
        cls, mesh: SubjectMesh, points: SurfacePoints, head: HeadAsset, settings: RGBAvatarConfig
    ) -> PointSurface:
        """The points with the axes of their triangles. Raises the errors of `ChartSurface` for axes along a chart."""
        official = settings.frame_variant == "official"
        return ChartSurface(mesh, points, head) if official else PointSurface(mesh, points)

    def shapes(self, head: HeadAsset) -> dict[str, tuple[int | str, ...]]:
        """Shapes of the tensors by name, for N splats and K blendshapes."""
        splats: dict[str, tuple[int | str, ...]] = {name: ("N", *width) for name, width in PER_SPLAT.items()}
        blendshapes = {shapes: ("K", *splats[name]) for name, shapes in SHAPES.items()}
        network = layer_shapes((input_count(head, self.settings.inputs), "hidden", "hidden 2", "K"))
        return {**splats, **blendshapes, **network}

    def text(self) -> str:
        """The names of the inputs, with commas between them, and the variant of the axes unless it is the default."""
        variant = self.settings.frame_variant
        return ",".join(self.settings.inputs) + (f"{FRAMES}{variant}" if variant != "orthonormal" else "")

    @classmethod
    def settings_of(cls, path: Path, text: str) -> RGBAvatarConfig:
        """Settings of a `text`."""
        inputs, _, variant = text.partition(FRAMES)
        values = {cls.KEY: inputs.split(","), "frame_variant": variant or "orthonormal"}
        return build(RGBAvatarConfig, values, str(path))
