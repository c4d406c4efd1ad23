"""The start of "ours": a splat on each triangle, and shells of further splats where expressions move the face.

Colours are static and follow from canonical position alone, so opacity can change an appearance only where splats of
different colours lie over each other. Densification brings them there within hundreds of thousands of iterations;
a short run has to begin with them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...bench.contracts import Clip
from ...datasets.head.arrays import faces_in_region
from ..shared.binding import NORMAL
from ..shared.bound_training import Start, one_per_triangle
from ..shared.subject_mesh import SubjectMesh, centroid_displacements
from .config import OursConfig


def shell_start(mesh: SubjectMesh, clip: Clip, config: OursConfig, device: str) -> Start:
    """One splat per triangle, and ``config.shells`` more outwards over each of `expressive_triangles`.

    Without lines there is no opacity to change, hence no shells.
    """
    start = one_per_triangle(len(mesh.faces), config.splats.initial_opacity, device)
    if not config.lines or not config.shells:
        return start
    chosen = expressive_triangles(mesh, clip, config.penalty_face_mm, device)
    size = mesh.frames(mesh.canonical).size.index_select(0, chosen)
    parts = [start]
    for shell in range(1, config.shells + 1):
        means = torch.zeros(len(chosen), 3, device=device)
        means[:, NORMAL] = shell * config.shell_gap / size
        parts.append(Start(chosen, means, torch.full((len(chosen),), config.shell_opacity, device=device)))
    return Start(*(torch.cat(column) for column in zip(*parts)))


@torch.no_grad()
def expressive_triangles(mesh: SubjectMesh, clip: Clip, millimetres: float, device: str) -> Tensor:
    """Indices of face triangles whose centroid a training expression moves by ``millimetres`` or more, ascending.

    There, at some time, the penalty lets opacity change (`ours_appearance.penalty_weights`).
    """
    face = torch.from_numpy(faces_in_region(clip.head, "face")).to(device)
    moved = torch.zeros(len(face), dtype=torch.bool, device=device)
    for timestep in sorted({key.timestep for key in clip.splits["train"]}):
        unposed = mesh.unposed(mesh.arguments([clip.poses[timestep]]))
        moved |= 1000 * centroid_displacements(unposed, mesh.canonical, mesh.faces[face]) >= millimetres
    return face[moved]
