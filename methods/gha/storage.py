"""The file of a GHA avatar: float32 tensors by name, checked whole when read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from ...bench.configuration import build
from ...bench.errors import InputError
from ...bench.io.arrays import Member
from ...bench.io.documents import parse_json
from ...bench.io.files import write_bytes
from ..shared.tensor_files import MAX_MAGNITUDE, check_sizes, check_tensors, read_safetensors
from .config import GHAConfig
from .gaussian_head import POINTS, GaussianHead

AVATAR_FILE = "avatar.safetensors"
CONFIG = "config"
"""Key of the file's metadata: the settings that decide how the tensors are used, as JSON."""

RENDERING = (
    "unit",
    "near_squared",
    "far_squared",
    "features",
    "channels",
    "expression_color_hidden",
    "pose_color_hidden",
    "expression_deform_hidden",
    "pose_deform_hidden",
    "expression_attribute_hidden",
    "pose_attribute_hidden",
    "sr_widths",
    "residual",
    "displacement_scale",
    "attribute_scale",
)
"""Settings that rendering depends on."""

FRAME = ("origin", "background", "expression_scale", "code_low", "code_high")
"""Small tensors: (3,) metres, (3,) colour that was trained on, (E,) divisors of the expression code, (E,) bounds of it
that colour and attributes follow."""


def write_avatar(path: Path, config: GHAConfig, tensors: Mapping[str, Tensor]) -> None:
    """Write the tensors of points, networks, landmarks and `FRAME`. Points with features are one (N, 11 + F) table."""
    table = torch.cat(
        [tensors[name].reshape(len(tensors["points"]), -1) for name in (*POINTS, "features")], 1
    )
    kept = {name: value for name, value in tensors.items() if name not in (*POINTS, "features")}
    kept["table"] = table
    settings = {name: value for name, value in asdict(config).items() if name in RENDERING}
    stored = {name: value.detach().to("cpu", torch.float32).contiguous() for name, value in kept.items()}
    write_bytes(path, save(stored, {CONFIG: json.dumps(settings)}))


def read_avatar(path: Path, expression_size: int, device: str) -> tuple[GaussianHead, dict[str, Tensor]]:
    """Read what `write_avatar` wrote: the networks and their tensors, points apart again.

    Raises
    ------
    InputError
        Where the file is damaged, or a tensor is missing, does not fit the settings, or is not finite float32.
    """
    tensors, metadata = read_safetensors(path)
    head = GaussianHead.of(_settings(path, metadata.get(CONFIG, "")), expression_size)
    columns = sum(POINTS.values()) + head.config.features
    shapes: dict[str, tuple[int | None, ...]] = {
        **head.shapes(),
        "landmarks": (None, 3),
        "table": (None, columns),
    }
    of_code = ("expression_scale", "code_low", "code_high")
    shapes |= {"origin": (3,), "background": (3,), **dict.fromkeys(of_code, (expression_size,))}
    members = {name: Member("f", shape, MAX_MAGNITUDE, "f4") for name, shape in shapes.items()}
    # Where nothing bounds the code, these are float32's largest numbers.
    members |= dict.fromkeys(("code_low", "code_high"), Member("f", (expression_size,), dtype="f4"))
    check_tensors(path, tensors, members)
    if not len(tensors["landmarks"]) or not (tensors["expression_scale"] > 0).all():
        raise InputError(path, "landmarks, expression_scale", "at least one; above 0", "none, or not above 0")
    tensors = {name: tensors[name].to(device) for name in shapes}
    table = tensors.pop("table").split([*POINTS.values(), head.config.features], dim=1)
    for name, column in zip((*POINTS, "features"), table):
        tensors[name] = (column[:, 0] if name == "opacities" else column).contiguous()
    check_sizes(path, tensors["log_scales"])
    return head, tensors


def _settings(path: Path, text: str) -> GHAConfig:
    values = parse_json(text, path, CONFIG)
    known = {field.name for field in fields(GHAConfig)}
    if set(values) != set(RENDERING) & known:
        raise InputError(path, CONFIG, f"the settings {', '.join(RENDERING)}", repr(text)[:80])
    return build(GHAConfig, values, str(path))
