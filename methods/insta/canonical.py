"""The canonical mesh: the subject without expression, its jaw a little open."""

from __future__ import annotations

import numpy as np
import torch

from ...bench.contracts import HeadAsset, HeadPose
from ..shared.subject_mesh import SubjectMesh
from .config import InstaConfig
from .marching import Backend, Surface


@torch.no_grad()
def canonical_surface(
    head: HeadAsset, mesh: SubjectMesh, config: InstaConfig, backend: Backend = "auto"
) -> Surface:
    """The canonical surface of a subject; ``mesh`` lies on the CPU."""
    still = np.zeros(3)
    pose = HeadPose(
        mesh.version,
        expression=np.zeros(mesh.model.expression_size),
        rotation=still,
        neck=still,
        jaw=np.array([config.jaw_opening, 0, 0]),
        eyes=np.zeros(6),
        translation=still,
    )
    vertices = mesh.posed(mesh.arguments([pose]))
    return Surface(head, vertices, config.warp_compatibility, backend)
