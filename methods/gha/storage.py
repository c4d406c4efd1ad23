"""The file of a GHA avatar: float32 tensors by name, checked whole when read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ...bench.configuration import build
from ...bench.errors import InputError
from ...bench.files import atomic_path
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
    with atomic_path(path) as temporary:
        save_file(
            {name: value.detach().to("cpu", torch.float32).contiguous() for name, value in kept.items()},
            temporary,
            {CONFIG: json.dumps(settings)},
        )


def read_avatar(path: Path, expression_size: int, device: str) -> tuple[GaussianHead, dict[str, Tensor]]:
    """Read what `write_avatar` wrote: the networks and their tensors, points apart again.

    Raises
    ------
    InputError
        Where the file is damaged, or a tensor is missing, does not fit the settings, or is not finite float32.
    """
    try:
        with safe_open(path, framework="pt", device=device) as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            text = (file.metadata() or {}).get(CONFIG, "")
    except (SafetensorError, OSError) as error:
        raise InputError(path, "", "a safetensors file", str(error)) from error
    head = GaussianHead.of(_settings(path, text), expression_size)
    expected: dict[str, tuple[int | None, ...]] = {**head.shapes(), "landmarks": (None, 3)}
    expected["table"] = (None, sum(POINTS.values()) + head.config.features)
    of_code = ("expression_scale", "code_low", "code_high")
    expected |= {"origin": (3,), "background": (3,), **dict.fromkeys(of_code, (expression_size,))}
    for name, shape in expected.items():
        value = tensors.get(name)
        if value is None:
            raise InputError(path, name, "a tensor of that name", "none")
        fits = value.ndim == len(shape) and all(s in (None, n) for s, n in zip(shape, value.shape))
        if not fits:
            raise InputError(path, name, f"shape {shape}", f"shape {tuple(value.shape)}")
        if value.dtype != torch.float32 or not torch.isfinite(value).all():
            raise InputError(path, name, "finite float32 numbers", f"{value.dtype} or non-finite numbers")
    if not len(tensors["landmarks"]) or not (tensors["expression_scale"] > 0).all():
        raise InputError(path, "landmarks, expression_scale", "at least one; above 0", "none, or not above 0")
    columns = tensors.pop("table").split([*POINTS.values(), head.config.features], dim=1)
    for name, column in zip((*POINTS, "features"), columns):
        tensors[name] = (column[:, 0] if name == "opacities" else column).contiguous()
    return head, tensors


def _settings(path: Path, text: str) -> GHAConfig:
    try:
        values: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(path, CONFIG, "settings as JSON", repr(text)[:80]) from error
    known = {field.name for field in fields(GHAConfig)}
    if not isinstance(values, dict) or set(values) != set(RENDERING) & known:
        raise InputError(path, CONFIG, f"the settings {', '.join(RENDERING)}", repr(text)[:80])
    return build(GHAConfig, values, str(path))
