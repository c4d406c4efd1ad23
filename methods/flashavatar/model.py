"""The model of FlashAvatar: splats on a mesh, the network that translates, rotates and scales them, and the avatar's file.

The last layer may be one of HyperGaussians: Serifi and Bühler, "HyperGaussians: High-Dimensional Gaussian Splatting for High-Fidelity
Animatable Face Avatars", CVPR 2026, arXiv 2507.02803; the stored parts and the initialisation are those of the authors' code,
https://github.com/gserifi/HyperGaussians. Gaussians of every splat over output and latent have conditional means, the outputs: a
Gaussian has a mean (mu_o, mu_i) and a precision Lambda = L L^T in blocks of output and input, L = [[A, 0], [B, C]] with a positive
diagonal of A. The mean of the output where the input is x is mu_o - Lambda_oo^-1 Lambda_oi (x - mu_i), which is
mu_o - A^-T B^T (x - mu_i): C is not needed, and the only inverse is that of a small triangular matrix.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import linear

from ...bench.contracts import HeadAsset
from ..ops.planes import coefficient_count
from ..ops.splats import apply_matrices, left_products
from ..shared.avatar_files import settings_of_text, settings_text
from ..shared.optimisation import input_count, layer_names, layer_shapes, outputs_of
from ..shared.surface_points import SubjectMesh, SurfacePoints
from ..shared.surface_splats import HeadSurface, SurfaceSplats
from ..shared.tensor_files import check_sizes
from .spec import FlashAvatarConfig

WIDTHS = {"offset": 3, "turn": 4, "size": 3}
"""Columns of the outputs; each output has a separate Gaussian."""


def gaussian_shapes(latent: int) -> dict[str, tuple[int]]:
    """Shapes of the tensors for each splat, by name: none without a ``latent`` size.

    For an output of o columns these are the mean (o + latent), the lower triangle of A (o (o + 1) / 2, by rows, with the
    logarithms of the diagonal), and B (latent x o).
    """
    shapes: dict[str, tuple[int]] = {}
    for part, width in WIDTHS.items() if latent else ():
        mean, upper, lower = gaussian_names(part)
        shapes |= {mean: (width + latent,), upper: (width * (width + 1) // 2,), lower: (latent * width,)}
    return shapes


def gaussian_names(part: str) -> tuple[str, str, str]:
    """Names of mean, A and B of an output."""
    return f"gaussian_mean_{part}", f"gaussian_upper_{part}", f"gaussian_lower_{part}"


def initial_gaussians(count: int, latent: int) -> dict[str, Tensor]:
    """Tensors of ``count`` splats whose outputs are 0 at every latent: zeros, so that A is the identity."""
    return {name: torch.zeros(count, *shape) for name, shape in gaussian_shapes(latent).items()}


def conditional_means(tensors: Mapping[str, Tensor], latents: Tensor) -> Tensor:
    """(N, 10) conditional means of the outputs, one after the other, at the (N, latent) latents of the splats."""
    means = []
    for part, width in WIDTHS.items():
        mean, upper, lower = (tensors[name] for name in gaussian_names(part))
        rows, columns = torch.tril_indices(width, width, device=mean.device)
        diagonal = rows == columns
        entries = torch.where(diagonal, torch.where(diagonal, upper, 0).exp(), upper)
        factor = upper.new_zeros(len(upper), width, width)
        factor[:, rows, columns] = entries
        away = (latents - mean[:, width:])[:, None]
        moved = torch.bmm(away, lower.view(len(lower), -1, width)).mT
        means.append(mean[:, :width] - torch.linalg.solve_triangular(factor.mT, moved, upper=True)[:, :, 0])
    return torch.cat(means, 1)


def check_diagonals(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Raise `InputError`, naming ``path``, for logarithms of the diagonals beyond `MAX_LOGARITHM`."""
    for part, width in WIDTHS.items():
        name = gaussian_names(part)[1]
        rows, columns = torch.tril_indices(width, width)
        check_sizes(path, tensors[name][:, rows == columns].abs(), name)


INPUTS = ("expression", "jaw", "eyes", "eyelids")
"""Tracked parameters that the network takes, besides the encoded points."""
PER_SPLAT = {"log_scales": (3,), "quats": (4,), "opacities": (), "sh_dc": (3,)}
"""Shape of a splat's attributes besides the harmonics above degree 0."""
OPTIONAL = ("hyper_gaussians",)
RENDERING = ("frequencies", "layers", "hidden", *OPTIONAL, "offset_m", "scale_variant", "sh_degree")
"""Settings that affect rendering; those in `OPTIONAL` are not stored if they are 0."""
(FIRST,), (FIRST_BIAS,) = layer_names(1)
OUTPUTS = (*WIDTHS.values(),)
"""Columns of the network's outputs: offset, rotation, change of scale."""


def network_sizes(config: FlashAvatarConfig, conditions: int) -> tuple[int, ...]:
    """Inputs, hidden widths and outputs of the network, or its latents, for a number of tracked inputs."""
    encoded = 3 + 6 * config.frequencies
    return (encoded + conditions, *config.layers * (config.hidden,), config.hyper_gaussians or sum(OUTPUTS))


def layer_of_points(network: Mapping[str, Tensor], encoded: Tensor) -> Tensor:
    """(N, H) part of the first layer's sums that depends on the encoded points alone: the same in every pose."""
    return linear(encoded, network[FIRST][:, : encoded.shape[1]], network[FIRST_BIAS])


def network_outputs(
    network: Mapping[str, Tensor], of_points: Tensor, inputs: Tensor, config: FlashAvatarConfig
) -> Tensor:
    """(N, 10) in [-1, 1]: the network's outputs at the points, after tanh.

    The inputs of the network are the encoded point and the tracked parameters, one after the other; the first layer is linear, so the
    parts of both are added. With ``hyper_gaussians`` the outputs are conditional means of the splats' Gaussians, also in ``network``.

    ``of_points`` (N, H) is from `layer_of_points`, and ``inputs`` (I,) are the `tracked_inputs` of the pose.
    """
    of_inputs = network[FIRST][:, -len(inputs) :] @ inputs
    values = outputs_of(network, of_points + of_inputs, config.layers + 1)
    if config.hyper_gaussians:
        values = conditional_means(network, values)
    return values.tanh()


def changed(splats: Mapping[str, Tensor], outputs: Tensor, config: FlashAvatarConfig) -> dict[str, Tensor]:
    """Splats in the axes of the head with the (N, 10) outputs of the network applied.

    Returns means, (N, 3) offsets from the surface in metres; log_scales; and quats of any length: the splat's own, multiplied
    from the right by the network's, whose real part is exp(tanh).
    """
    offset, turn, scale = outputs.split(OUTPUTS, dim=1)
    turned = torch.cat([turn[:, :1].exp(), turn[:, 1:]], dim=1)
    quats = apply_matrices(left_products(splats["quats"]).flatten(1), turned)
    sizes = splats["log_scales"]
    log_scales = sizes * scale.exp() if config.scale_variant == "official" else sizes + scale
    return {"means": config.offset_m * offset, "log_scales": log_scales, "quats": quats}


class TrainedSplats(SurfaceSplats[FlashAvatarConfig]):
    """Content of an avatar's file: splats by the names of `PER_SPLAT`, `gaussian_shapes` and the network.

    Sizes are logarithms of metres, rotations wxyz, opacities logits. A splat takes 56 bytes, 12 for each of its harmonics above
    degree 0, and with ``hyper_gaussians`` of L another 128 + 52 L.
    """

    KEY = "settings"

    @classmethod
    def surface(
        cls, mesh: SubjectMesh, points: SurfacePoints, head: HeadAsset, settings: FlashAvatarConfig
    ) -> HeadSurface:
        """The points with the axes of the head at each."""
        return HeadSurface(mesh, points)

    def shapes(self, head: HeadAsset) -> dict[str, tuple[int | str, ...]]:
        """Shapes of the tensors by name, for N splats."""
        config = self.settings
        rest = {"sh_rest": (3, coefficient_count(config.sh_degree) - 1)}
        widths = {**PER_SPLAT, **rest, **gaussian_shapes(config.hyper_gaussians)}
        network = layer_shapes(network_sizes(config, input_count(head, INPUTS)))
        return {**{name: ("N", *width) for name, width in widths.items()}, **network}

    def text(self) -> str:
        """The settings that affect rendering, as JSON."""
        return settings_text(self.settings, RENDERING, OPTIONAL)

    @classmethod
    def settings_of(cls, path: Path, text: str) -> FlashAvatarConfig:
        """Settings with those of a `text`."""
        return settings_of_text(FlashAvatarConfig, RENDERING, text, path, cls.KEY, OPTIONAL)

    def checked(self, path: Path, head: HeadAsset, device: str) -> TrainedSplats:
        """See `SurfaceSplats.checked`; also bounds the sizes that the network can produce, and the inverses of Gaussians."""
        tensors = super().checked(path, head, device)
        check_sizes(path, math.e * self.tensors["log_scales"])
        if self.settings.hyper_gaussians:
            check_diagonals(path, self.tensors)
        return tensors
