"""FLAME as the smplx package computes it, for a head of ours: an independent implementation to time and compare."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ....bench.errors import UnavailableError
from ....datasets.head.arrays import HeadArrays

Forward = Callable[[Tensor, Mapping[str, Tensor]], Tensor]


class SmplxForward(NamedTuple):
    """Two ways through smplx, each from identity (B, S) and pose arguments to vertices (B, V, 3)."""

    model: Forward
    """Its FLAME class, as one uses it: landmarks and bookkeeping included."""
    skinning: Forward
    """Its function ``lbs`` alone, with both bases joined beforehand."""


def smplx_forward(head: HeadArrays) -> SmplxForward:
    """Make smplx's FLAME from a head.

    Raises
    ------
    UnavailableError
        Where smplx is not installed.
    """
    try:
        import smplx
        from smplx.lbs import lbs
    except ImportError as error:
        raise UnavailableError("The package smplx is not installed.", "pip install smplx") from error
    parents = head.parents.astype(np.int64)
    content = {
        "v_template": head.template,
        "f": head.faces.astype(np.uint32),
        "shapedirs": np.concatenate([head.shape_basis, head.expression_basis], axis=2),
        "posedirs": head.pose_basis,
        "J_regressor": head.joint_regressor,
        "kintree_table": np.stack([parents, np.arange(len(parents))]),
        "weights": head.skinning_weights,
    }
    landmarks = {"lmk_face_idx": np.zeros(51, np.int64), "lmk_b_coords": np.full((51, 3), 1 / 3)}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "FLAME_NEUTRAL.pkl").write_bytes(pickle.dumps(content))
        (Path(folder) / "flame_static_embedding.pkl").write_bytes(pickle.dumps(landmarks))
        sizes = {
            "num_betas": head.shape_basis.shape[2],
            "num_expression_coeffs": head.expression_basis.shape[2],
        }
        flame = smplx.FLAME(folder, **sizes, batch_size=1)
    directions = torch.cat([flame.shapedirs, flame.expr_dirs], dim=-1)

    def model(shape: Tensor, pose: Mapping[str, Tensor]) -> Tensor:
        vertices: Tensor = flame(
            betas=shape,
            expression=pose["expression"],
            global_orient=pose["rotation"],
            neck_pose=pose["neck"],
            jaw_pose=pose["jaw"],
            leye_pose=pose["eyes"][:, :3],
            reye_pose=pose["eyes"][:, 3:],
            transl=pose["translation"],
        ).vertices
        return vertices

    def skinning(shape: Tensor, pose: Mapping[str, Tensor]) -> Tensor:
        angles = torch.cat([pose[name] for name in ("rotation", "neck", "jaw", "eyes")], dim=1)
        template = flame.v_template.expand(len(shape), -1, -1)
        arguments = (flame.posedirs, flame.J_regressor, flame.parents, flame.lbs_weights)
        vertices: Tensor = lbs(
            torch.cat([shape, pose["expression"]], 1), angles, template, directions, *arguments
        )[0]
        return vertices + pose["translation"][:, None]

    return SmplxForward(model, skinning)
