"""Frame records and transforms JSONs of the GaussianAvatars/VHAP layout, as its writers share them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Camera
from ...bench.io.files import atomic_path
from . import layout


def camera_record(camera: Camera, index: int, cy: layout.CyConvention) -> dict[str, Any]:
    """The camera's part of a frame record, keys in VHAP's order."""
    return {
        "camera_index": index,
        "camera_id": camera.id,
        **layout.intrinsics_to_json(camera, cy),
        "transform_matrix": layout.extrinsics_to_json(camera.world_to_camera),
    }


def file_record(timestep: int, camera_index: int, prefix: str, *, mask: bool) -> dict[str, str]:
    """Paths of a frame's files, relative to the JSON; ``prefix`` leads to the sequence's folder."""
    name = layout.frame_name(timestep, camera_index)
    masks = {"fg_mask_path": f"{prefix}fg_masks/{name}.png"} if mask else {}
    return {
        "file_path": f"{prefix}images/{name}.png",
        **masks,
        "flame_param_path": f"{prefix}flame_param/{timestep:05d}.npz",
    }


def transforms_document(
    frames: Sequence[Mapping[str, Any]], shared: Mapping[str, float | int]
) -> dict[str, Any]:
    """A transforms JSON: frames, the shared intrinsics (those of the last camera), and the indices in use."""
    return {
        "frames": frames,
        **shared,
        "timestep_indices": sorted({frame["timestep_index"] for frame in frames}),
        "camera_indices": sorted({frame["camera_index"] for frame in frames}),
    }


def split_of(*, test: bool, held_out_camera: bool) -> str:
    """Name of the split a frame belongs to."""
    if test:
        return "self_reenactment"
    return "novel_view" if held_out_camera else "train"


def save_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an uncompressed npz atomically; equal arrays make equal bytes."""
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)
