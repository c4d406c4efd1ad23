"""The last layer of HyperGaussians: Gaussians of every splat over output and latent, whose conditional means are the outputs.

Serifi and Bühler, "HyperGaussians: High-Dimensional Gaussian Splatting for High-Fidelity Animatable Face Avatars", CVPR
2026, arXiv 2507.02803; the stored parts and the initialisation are those of the authors' code,
https://github.com/gserifi/HyperGaussians.

A Gaussian has a mean (mu_o, mu_i) and a precision Lambda = L L^T in blocks of output and input, L = [[A, 0], [B, C]] with a
positive diagonal of A. The mean of the output where the input is x is mu_o - Lambda_oo^-1 Lambda_oi (x - mu_i), which
is mu_o - A^-T B^T (x - mu_i): C is not needed, and the only inverse is that of a small triangular matrix.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from ..shared.tensor_files import check_sizes

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
