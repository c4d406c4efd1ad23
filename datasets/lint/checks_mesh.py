"""HB7xx: the tracked mesh against the images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .checks_cameras import misplaced
from .checks_images import sound_mask
from .evidence import Evidence
from .mesh_views import MeshFacts
from .rules import Hit, Rule, several, spans
from .views import ViewFacts

OUTSIDE = 0.15
"""Share of the face's vertices outside the foreground from which a frame's mesh misses it."""

SMALL = 0.2
"""Area of the mesh over that of the foreground from which the mesh is too small, or the mask shows more."""


def _laid(evidence: Evidence) -> list[tuple[ViewFacts, MeshFacts, float]]:
    """Frames whose mesh can be held against a sound mask, with the share of the face outside."""
    if misplaced(evidence):
        return []
    return [
        (view, view.mesh, view.mesh.face_outside)
        for view in evidence.views
        if view.mesh is not None and view.mesh.face_outside is not None and sound_mask(view)
    ]


def mesh_misses(evidence: Evidence) -> bool:
    """Whether the face of the mesh falls outside the foreground in most frames."""
    laid = _laid(evidence)
    return bool(laid) and float(np.median([outside for _, _, outside in laid])) > OUTSIDE


def _missed(evidence: Evidence) -> Iterator[Hit]:
    if mesh_misses(evidence):
        laid = _laid(evidence)
        outside = float(np.median([share for _, _, share in laid]))
        overlap = float(np.median([mesh.overlap or 0.0 for _, mesh, _ in laid]))
        yield Hit(
            f"{outside:.0%} of the face's vertices fall outside the foreground (median over "
            f"{several(len(laid), 'frame')}; mesh and foreground overlap by {overlap:.2f})",
            evidence.folder,
        )


def _missed_once(evidence: Evidence) -> Iterator[Hit]:
    if mesh_misses(evidence):
        return
    laid = _laid(evidence)
    lost = [(view, outside) for view, _, outside in laid if outside > OUTSIDE]
    if lost:
        timesteps = sorted({view.entry.timestep for view, _ in lost})
        cameras = sorted({view.entry.camera_id for view, _ in lost})
        where = f"camera {cameras[0]}, " if len(cameras) == 1 else ""
        yield Hit(
            f"the mesh misses the face in {len(lost)} of {several(len(laid), 'frame')} looked at ({where}"
            f"timesteps {spans(timesteps)})",
            lost[0][0].entry.image,
        )


def _small(evidence: Evidence) -> Iterator[Hit]:
    sizes = [mesh.size for _, mesh, _ in _laid(evidence) if mesh.size is not None]
    if sizes and np.median(sizes) < SMALL:
        yield Hit(
            f"the mesh covers {np.median(sizes):.0%} of the foreground's area (median over "
            f"{several(len(sizes), 'frame')})",
            evidence.folder,
        )


RULES = (
    Rule(
        "HB701",
        "error",
        "the tracked mesh misses the subject",
        "Look at the overlay (headbench inspect): wrong cameras, intrinsics not scaled with the images, units, "
        "another subject's tracking, or parameters shifted by some timesteps.",
        _missed,
    ),
    Rule(
        "HB702",
        "warning",
        "the tracked mesh misses the subject in some frames",
        "Track these timesteps again, or leave them out with a reason.",
        _missed_once,
    ),
    Rule(
        "HB703",
        "warning",
        "the mesh is small beside the foreground",
        "Make sure of the units; where the mask shows shoulders, cut it below the neck.",
        _small,
    ),
)
