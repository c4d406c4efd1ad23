"""The bytes of an avatar in a page: a JSON header and quantised columns, compressed by deflate.

A 32-bit little-endian length, the header as UTF-8, then for each array of the header its columns one after another, N values
each: 8-bit values, or 16-bit ones as a plane of low bytes and a plane of high bytes. A value is ``low + step * q`` of its column.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ....bench.contracts import FloatArray
from ....bench.io.provenance import tool
from ....datasets.head.rotations import matrix_to_quaternion
from ...splats.reference import rotation_matrices
from .model import Slider, WebAvatar

FORMAT = 1
LOWEST_LOG_SCALE = -14.0
"""A micrometre; thinner splats look the same."""
LEAST = {
    "harmonics": 0.006,
    "d_means": 2e-5,
    "d_turns": 0.01,
    "d_log_scales": 0.01,
    "d_logits": 0.04,
    "d_colors": 0.004,
}
"""Minimum steps, in the units of each (metres, radians, powers of e, logits, 1); finer steps would be invisible."""
MOST_OF = 0.9995
"""Fraction of the harmonics of an order that the range of their column has to contain; a few outliers would make all
others coarse."""


def encode(avatar: WebAvatar, view: Mapping[str, Any], more: Mapping[str, Any] | None = None) -> bytes:
    """Quantise and pack. Means have 16 bits, everything else 8.

    ``view`` is the initial view: ``distance`` in metres from ``target``, (3,). ``more`` are further entries of the header,
    for the page alone.
    """
    count = len(avatar.means)
    arrays: list[dict[str, Any]] = []
    planes: list[bytes] = []

    def add(name: str, values: FloatArray, low: FloatArray, step: FloatArray, bits: int = 8) -> None:
        columns = np.asarray(values, np.float64).reshape(count, -1)
        step = np.maximum(step, 1e-12)
        levels = np.round((columns - low) / step).clip(0, 2**bits - 1).astype(np.uint16).T
        arrays.append(
            {
                "name": name,
                "bits": bits,
                "low": [float(f"{v:.7g}") for v in low],
                "step": [float(f"{v:.7g}") for v in step],
            }
        )
        for level in levels:
            planes.append((level & 255).astype(np.uint8).tobytes())
            if bits == 16:
                planes.append((level >> 8).astype(np.uint8).tobytes())

    def add_range(name: str, values: FloatArray, bits: int = 8) -> None:
        columns = values.reshape(count, -1)
        low, high = columns.min(axis=0), columns.max(axis=0)
        add(name, columns, low, (high - low) / (2**bits - 1), bits)

    def add_signed(name: str, values: FloatArray, largest: FloatArray, least: float = 0.0) -> None:
        # Level 128 is exactly 0, since most sliders do not move most splats.
        step = np.maximum(np.asarray(largest) / 127, least)
        add(name, values, -128 * step, step)

    add_range("means", avatar.means, bits=16)
    add_signed("quats", quaternions(avatar.rotations), np.ones(4))
    add_range("log_scales", avatar.log_scales.clip(min=LOWEST_LOG_SCALE))
    add_range("logits", avatar.logits[:, None])
    harmonics = avatar.harmonics.transpose(0, 2, 1)  # (N, K, 3)
    of_order = np.quantile(np.abs(harmonics), MOST_OF, axis=(0, 2))
    add_signed("harmonics", harmonics, np.repeat(of_order, 3), LEAST["harmonics"])
    add("weights", avatar.weights, np.zeros(4), np.full(4, 1 / 255))
    for number in range(len(avatar.sliders)):
        parts = {
            "d_means": avatar.d_means[number],
            "d_turns": avatar.d_turns[number],
            "d_log_scales": avatar.d_log_scales[number],
            "d_logits": avatar.d_logits[number][:, None],
            "d_colors": avatar.d_colors[number],
        }
        for name, part in parts.items():
            largest = (
                np.quantile(np.abs(part), MOST_OF, axis=0) if name != "d_means" else np.abs(part).max(axis=0)
            )
            add_signed(f"{name} {number}", part, np.full(part.shape[1], largest.max()), LEAST[name])
    header = {
        "format": FORMAT,
        "by": tool(),
        "count": count,
        "turned": avatar.turned,
        "joints": np.round(avatar.joints, 6).tolist(),
        "view": dict(view),
        **(more or {}),
        "sliders": [slider._asdict() for slider in avatar.sliders],
        "arrays": arrays,
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(b"".join([struct.pack("<I", len(text)), text, *planes])) + packer.flush()


def decode(content: bytes) -> WebAvatar:
    """Decode the bytes as a page does; the reference for its script."""
    whole = zlib.decompress(content, -15)
    (length,) = struct.unpack_from("<I", whole)
    header = json.loads(whole[4 : 4 + length])
    count, place = header["count"], 4 + length
    arrays = {}
    for array in header["arrays"]:
        columns = []
        for low, step in zip(array["low"], array["step"], strict=True):
            levels = np.frombuffer(whole, np.uint8, count, place).astype(np.float64)
            place += count
            if array["bits"] == 16:
                levels += 256.0 * np.frombuffer(whole, np.uint8, count, place)
                place += count
            columns.append(low + step * levels)
        arrays[array["name"]] = np.stack(columns, axis=1)
    sliders = tuple(
        Slider(**slider | {name: tuple(slider[name]) for name in ("joints", "direction")})
        for slider in header["sliders"]
    )
    morphs = {
        name: np.stack([arrays[f"{name} {number}"] for number in range(len(sliders))])
        for name in ("d_means", "d_turns", "d_log_scales", "d_logits", "d_colors")
    }
    return WebAvatar(
        means=arrays["means"],
        rotations=rotation_matrices(torch.from_numpy(arrays["quats"])).numpy(),
        log_scales=arrays["log_scales"],
        logits=arrays["logits"][:, 0],
        harmonics=arrays["harmonics"].reshape(count, -1, 3).transpose(0, 2, 1),
        turned=header["turned"],
        weights=arrays["weights"],
        joints=np.array(header["joints"]),
        sliders=sliders,
        **{**morphs, "d_logits": morphs["d_logits"][..., 0]},
    )


def quaternions(rotations: FloatArray) -> FloatArray:
    """(N, 4) unit quaternions wxyz of (N, 3, 3) rotations."""
    return matrix_to_quaternion(torch.from_numpy(np.ascontiguousarray(rotations))).numpy()
