"""Embedding of a network's landmarks on a head model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadAsset, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.landmark_network import COUNT, LandmarkNetwork
from ..clip import CaptureClip
from ..head.geometry import vertex_normals
from ..head.refit.identity import closest_points
from ..head.subject import PosedSubject
from ..mesh_pictures import rasterize_mesh

LEARNING_FRAMES = 120
"""Images of a capture from which an embedding is learnt."""
MOST_SPREAD = 0.004
"""Maximum median sliding of a landmark on the mesh, metres; others are left out."""
FEWEST_LANDMARKS = 10
FACING = 0.5
"""Minimum cosine between the normal of a landmark and the direction to the camera."""
_FEWEST = 0.15  # fraction of images in which a landmark must hit the mesh


class Embedding(NamedTuple):
    """Points of a head model that correspond to landmarks."""

    landmarks: IntArray
    """(L,) indices of the network's landmarks."""
    corners: IntArray
    """(L, 3) vertices."""
    weights: FloatArray
    """(L, 3) barycentric weights."""


class PicturedMesh(NamedTuple):
    """An image of a head with known mesh."""

    image: ByteArray
    """(H, W, 3) 8-bit."""
    camera: Camera
    mesh: FloatArray
    """(V, 3) vertices, metres."""


def captured_heads(clip: CaptureClip) -> Iterator[PicturedMesh]:
    """Images of a clip with exact tracking, evenly over cameras and time."""
    subject = PosedSubject.of(clip)
    keys = sorted(clip.files, key=lambda key: (key.camera, key.timestep))
    for place in np.unique(np.linspace(0, len(keys) - 1, LEARNING_FRAMES).astype(int)):
        key = keys[place]
        mesh = subject.meshes([clip.poses[key.timestep]])[0]
        yield PicturedMesh(clip.image(key), clip.cameras[key.camera], mesh)


def learn_embedding(
    network: LandmarkNetwork,
    head: HeadAsset,
    pictures: Iterable[PicturedMesh],
    progress: Progress = no_progress,
) -> Embedding:
    """Positions of the network's landmarks on the mesh: medians over images.

    Raises `InputError` if the network finds hardly any landmark in the pictures.
    """
    template = np.asarray(head.template, np.float64)
    places: list[FloatArray] = []
    found: FloatArray | None = None
    last = ""
    for image, camera, mesh in pictures:
        progress(len(places), max(LEARNING_FRAMES, len(places) + 1), "learning landmarks")
        found = network.find(image, found if camera.id == last else None)
        last = camera.id
        places.append(np.full((COUNT, 3), np.nan))
        if found is None:
            continue
        fragments = rasterize_mesh(mesh, head.faces, camera)
        column, line = np.floor(found).astype(int).T
        inside = (column >= 0) & (line >= 0) & (column < camera.width) & (line < camera.height)
        column, line = np.where(inside, column, 0), np.where(inside, line, 0)
        face, weights = fragments.face[line, column], fragments.weights[line, column]
        corners = head.faces[face]
        normals = np.einsum("lk,lki->li", weights, vertex_normals(mesh, head.faces)[corners])
        toward = camera.center - np.einsum("lk,lki->li", weights, mesh[corners])
        facing = (normals * toward).sum(axis=1) > FACING * np.linalg.norm(toward, axis=1)
        hit = inside & (face >= 0) & facing
        places[-1][hit] = np.einsum("lk,lki->li", weights, template[corners])[hit]
    seen = np.stack(places)
    enough = np.flatnonzero(np.isfinite(seen[..., 0]).sum(axis=0) > _FEWEST * len(seen))
    kept = np.zeros(0, bool)
    if len(enough):
        middle = np.nanmedian(seen[:, enough], axis=0)
        spread = np.nanmedian(np.linalg.norm(seen[:, enough] - middle, axis=2), axis=0)
        kept = spread < MOST_SPREAD
    if kept.sum() < FEWEST_LANDMARKS:
        expected = (
            f"pictures in which the network finds faces, with {FEWEST_LANDMARKS} landmarks at fixed places"
        )
        raise InputError(f"head model {head.version}", "landmarks", expected, f"{kept.sum()} landmarks")
    on_mesh = closest_points(middle[kept], template, np.asarray(head.faces))
    return Embedding(enough[kept], np.asarray(head.faces)[on_mesh.face], on_mesh.weights)
