"""GaussianAvatars' PLY file."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ..ops.harmonics import coefficient_count
from ..shared.ply import read_names, read_ply, write_ply
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors

PLY_FILE = "point_cloud.ply"

REST = 15  # coefficients of degrees 1 to 3
COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(3 * REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
    "binding_0",
)
"""63 float32 = 252 bytes per splat: local position, zero normals, spherical harmonics (the rest channel by
channel), logit of opacity, log-scales, quaternion wxyz, triangle."""


BINDING = "binding"
SHAPES: dict[str, tuple[int | str | None, ...]] = {
    "means": ("N", 3),
    "log_scales": ("N", 3),
    "quats": ("N", 4),
    "opacities": ("N",),
    "sh_dc": ("N", 3),
    "sh_rest": ("N", 3, None),
}
"""Shapes of the per-splat tensors."""


def write_ga_splats(path: Path, splats: dict[str, Tensor], binding: Tensor) -> None:
    """Write splats in GaussianAvatars' layout, with fewer columns for harmonics of a lower degree.

    Triangle indices are exact in float32 up to 2^24.
    """
    count, rest = len(binding), 3 * splats["sh_rest"].shape[2]
    left_out = {f"f_rest_{i}" for i in range(rest, 3 * REST)}
    columns = [
        splats["means"],
        torch.zeros(count, 3),
        splats["sh_dc"],
        splats["sh_rest"].reshape(count, rest),
        splats["opacities"][:, None],
        splats["log_scales"],
        splats["quats"],
        binding[:, None].to(torch.float32),
    ]
    table = torch.cat([column.detach().to("cpu", torch.float32) for column in columns], dim=1)
    write_ply(path, tuple(name for name in COLUMNS if name not in left_out), table.numpy())


def read_ga_splats(path: Path, face_count: int, device: str) -> tuple[dict[str, Tensor], Tensor]:
    """Read what GaussianAvatars or `write_ga_splats` wrote: per-splat tensors by name, and the binding.

    Harmonics of degree 0 to 2 are padded with zeros.
    """
    normals = ("nx", "ny", "nz")
    rest_names = tuple(name for name in COLUMNS if name.startswith("f_rest_"))
    needed = tuple(name for name in COLUMNS if name not in (*normals, *rest_names))
    degree_rest = _rest_count(path)
    table = torch.from_numpy(read_ply(path, (*needed, *rest_names[: 3 * degree_rest])))
    widths = [3, 3, 1, 3, 4, 1, 3 * degree_rest]
    means, dc, opacity, log_scales, quats, binding, rest = table.split(widths, dim=1)
    filled = rest.new_zeros(len(rest), 3, REST)
    filled[:, :, :degree_rest] = rest.reshape(len(rest), 3, degree_rest)
    geometry = {"means": means, "log_scales": log_scales, "quats": quats, "opacities": opacity[:, 0]}
    tensors = {**geometry, "sh_dc": dc, "sh_rest": filled, BINDING: binding[:, 0].to(torch.int64)}
    return checked_splats(path, tensors, face_count, device)


def checked_splats(
    path: Path, tensors: dict[str, Tensor], face_count: int, device: str
) -> tuple[dict[str, Tensor], Tensor]:
    """Per-splat tensors and the binding. Raises `InputError` for tensors that do not fit each other or the mesh."""
    members = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in SHAPES.items()}
    check_tensors(path, tensors, members | {BINDING: Member("i", ("N",))})
    check_sizes(path, tensors["log_scales"])
    binding = tensors[BINDING]
    if len(binding) and not (0 <= int(binding.min()) and int(binding.max()) < face_count):
        found = f"{int(binding.min())} to {int(binding.max())}"
        raise InputError(path, BINDING, f"triangles 0 to {face_count - 1}", found)
    return {name: tensors[name].contiguous().to(device) for name in members}, binding.to(device)


def _rest_count(path: Path) -> int:
    """Number of coefficients per channel above degree 0 in a file of degree 0, 1, 2 or 3."""
    found = sum(name.startswith("f_rest_") for name in read_names(path))
    counts = [3 * (coefficient_count(degree) - 1) for degree in range(4)]
    if found not in counts:
        raise InputError(path, "f_rest", f"{', '.join(map(str, counts))} columns", str(found))
    return found // 3
