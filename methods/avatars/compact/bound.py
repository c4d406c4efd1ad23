"""Content of the coded file of splats bound to triangles, with harmonics: avatars of GaussianAvatars."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from ....bench.contracts import FloatArray, HeadAsset
from ....bench.errors import InputError
from ...ours.storage import SPLAT_WIDTHS, splat_columns
from ...shared.avatar_files import Subject
from ...shared.tensor_files import check_sizes
from .container import Arrays, Content, read_content
from .encoding import decode_splats, encode_splats
from .file import decode_subject, encode_subject
from .precision import Precision

TRIANGLES = "binding"


def encode_bound(
    splats: Mapping[str, Tensor],
    binding: Tensor,
    subject: Subject,
    precision: Precision,
    weights: FloatArray | None = None,
    directions: FloatArray | None = None,
) -> Content:
    """Content of a coded file; ``weights`` and ``directions`` as for `encode_splats`.

    Splats are sorted by triangle, stably, since equal depths are drawn in their order.
    """
    precision = precision.scaled
    order = torch.argsort(binding, stable=True)
    columns = {**splats, "opacities": splats["opacities"][:, None], TRIANGLES: binding[:, None].float()}
    table = torch.cat([columns[name] for name in SPLAT_WIDTHS], dim=1)
    tensors = {"splats": table, "sh_dc": splats["sh_dc"], "sh_rest": splats["sh_rest"]}
    tensors = {name: value.index_select(0, order).cpu() for name, value in tensors.items()}
    sorted_weights = None if weights is None else weights[order.cpu().numpy()]
    arrays, steps = encode_splats(tensors, precision, False, sorted_weights, directions)
    person = encode_subject(subject, precision)
    return Content({**arrays, **person.arrays}, person.text, {**steps, **person.steps})


def read_bound(path: Path, head: HeadAsset, device: str) -> tuple[Subject, tuple[dict[str, Tensor], Tensor]]:
    """Subject, and per-splat tensors with their binding, of a file of `encode_bound`. Raises `InputError` for anything else."""
    arrays = Arrays(path, read_content(path))
    subject, tensors = decode_subject(arrays, head), decode_splats(arrays)
    if "sh_dc" not in tensors:
        raise InputError(path, "harmonics", "those of every splat", "none")
    columns = splat_columns(tensors.pop("splats"))
    check_sizes(path, columns["log_scales"])
    splats = {name: value.contiguous().to(device) for name, value in {**columns, **tensors}.items()}
    binding = splats.pop(TRIANGLES)[:, 0].to(torch.int64)
    if len(binding) and int(binding.max()) >= len(head.faces):
        expected = f"triangles 0 to {len(head.faces) - 1}"
        raise InputError(path, "triangles", expected, str(int(binding.max())))
    splats["opacities"] = splats["opacities"][:, 0]
    return subject, (splats, binding)
