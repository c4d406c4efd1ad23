"""Landmarks by MediaPipe's face landmark network: what points of a head model they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import BoolArray, FloatArray, HeadAsset, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ...bench.landmark_network import COUNT, LandmarkNetwork
from ..clip import CaptureClip
from ..head.geometry import vertex_normals
from ..head.refit.identity import closest_points
from ..head.subject import PosedSubject
from ..mesh_pictures import rasterize_mesh
from .landmarks import ImageLandmarks, known_rig_landmarks
from .views import Views

LEARNING_FRAMES = 120
"""Images from which an embedding is learnt."""
MOST_SPREAD = 0.004
"""Landmarks that slide on the mesh by more than this, median, are left out, metres."""
MOST_MISFIT = 0.04
"""Largest median distance of landmarks from those of the mean head, relative to the face's size."""
_FACING = 0.5
_FEWEST = 0.3  # part of the images in which a landmark has to hit the mesh


class Embedding(NamedTuple):
    """Points of a head model that landmarks are."""

    landmarks: IntArray
    """(L,) indices of the network's landmarks."""
    corners: IntArray
    """(L, 3) vertices."""
    weights: FloatArray
    """(L, 3) barycentric weights."""


def learn_embedding(
    network: LandmarkNetwork, clip: CaptureClip, progress: Progress = no_progress
) -> Embedding:
    """Where the network's landmarks are on the mesh of a clip with exact tracking: medians over images.

    Raises `InputError` if the network finds hardly any landmark in the images.
    """
    head, subject = clip.head, PosedSubject.of(clip)
    keys = sorted(clip.files, key=lambda key: (key.camera, key.timestep))
    keys = [keys[place] for place in np.unique(np.linspace(0, len(keys) - 1, LEARNING_FRAMES).astype(int))]
    template = np.asarray(head.template, np.float64)
    places = np.full((len(keys), COUNT, 3), np.nan)
    found: FloatArray | None = None
    for row, key in enumerate(keys):
        progress(row, len(keys), "learning landmarks")
        camera = clip.cameras[key.camera]
        near = found if row and keys[row - 1].camera == key.camera else None
        found = network.find(clip.image(key), near)
        if found is None:
            continue
        mesh = subject.meshes([clip.poses[key.timestep]])[0]
        fragments = rasterize_mesh(mesh, head.faces, camera)
        column, line = np.floor(found).astype(int).T
        inside = (column >= 0) & (line >= 0) & (column < camera.width) & (line < camera.height)
        column, line = np.where(inside, column, 0), np.where(inside, line, 0)
        face, weights = fragments.face[line, column], fragments.weights[line, column]
        corners = head.faces[face]
        normals = np.einsum("lk,lki->li", weights, vertex_normals(mesh, head.faces)[corners])
        toward = camera.center - np.einsum("lk,lki->li", weights, mesh[corners])
        facing = (normals * toward).sum(axis=1) > _FACING * np.linalg.norm(toward, axis=1)
        hit = inside & (face >= 0) & facing
        places[row, hit] = np.einsum("lk,lki->li", weights, template[corners])[hit]
    enough = np.flatnonzero(np.isfinite(places[..., 0]).sum(axis=0) > _FEWEST * len(keys) / 2)
    if len(enough) < 10:
        raise InputError(
            f"clip of {clip.subject}", "images", "faces that the network finds", f"{len(enough)} landmarks"
        )
    middle = np.nanmedian(places[:, enough], axis=0)
    spread = np.nanmedian(np.linalg.norm(places[:, enough] - middle, axis=2), axis=0)
    kept = spread < MOST_SPREAD
    on_mesh = closest_points(middle[kept], template, np.asarray(head.faces))
    return Embedding(enough[kept], np.asarray(head.faces)[on_mesh.face], on_mesh.weights)


class NetworkLandmarks:
    """A source of landmarks: the network on the images of some cameras of a clip."""

    def __init__(
        self, network: LandmarkNetwork, embedding: Embedding, clip: CaptureClip, cameras: Sequence[str]
    ):
        self._network, self._embedding, self._clip, self._cameras = network, embedding, clip, [*cameras]
        self._views = Views([clip.cameras[name] for name in cameras])
        self._rest, self._normals = _rest(clip.head, embedding)

    def __call__(self, timesteps: Sequence[int]) -> ImageLandmarks:
        """Landmarks that face their camera, by the pose that fits the landmarks of the image."""
        pixels = np.full((len(timesteps), len(self._cameras), len(self._rest), 2), np.nan)
        for column, name in enumerate(self._cameras):
            near = None
            for row, timestep in enumerate(timesteps):
                image = self._clip.image(self._clip.frame_at[timestep, name])
                trials: list[FloatArray | None] = [None] if near is None else [near, None]
                for tried in trials:
                    near = self._network.find(image, tried)
                    facing = None if near is None else self._facing(near[self._embedding.landmarks], column)
                    if near is not None and facing is not None:
                        found = near[self._embedding.landmarks]
                        pixels[row, column] = np.where(facing[:, None], found, np.nan)
                        break
                    near = None
        return ImageLandmarks(self._embedding.corners, self._embedding.weights, pixels)

    def _facing(self, found: FloatArray, camera: int) -> BoolArray | None:
        """(L,) which landmarks face the camera; None if they do not form a face."""
        K = self._views.intrinsics[camera]
        _, turn, shift = cv2.solvePnP(self._rest, found, K, None, flags=cv2.SOLVEPNP_SQPNP)
        rotation = cv2.Rodrigues(turn)[0]
        seen = self._rest @ rotation.T + shift[:, 0]
        cosine = -(seen * (self._normals @ rotation.T)).sum(axis=1) / np.linalg.norm(seen, axis=1)
        projected = seen @ K.T
        gaps = np.linalg.norm(projected[:, :2] / projected[:, 2:] - found, axis=1)
        upright = -rotation[1, 1] > 0  # the head's y points up, the image's down
        if not upright or np.median(gaps) > MOST_MISFIT * np.ptp(found, axis=0).max():
            return None
        return cosine > _FACING


def _rest(head: HeadAsset, embedding: Embedding) -> tuple[FloatArray, FloatArray]:
    """Landmarks on the mean head, (L, 3) metres, and their normals."""
    template = np.asarray(head.template, np.float64)
    normals = vertex_normals(template, np.asarray(head.faces))
    mixed = [
        np.einsum("lk,lki->li", embedding.weights, values[embedding.corners])
        for values in (template, normals)
    ]
    return mixed[0], mixed[1]


def check_teacher(teacher: CaptureClip, head: HeadAsset) -> None:
    """Raise `InputError` if a clip from which landmarks are learnt has another head model."""
    if teacher.head.version != head.version:
        raise InputError("embedding", "head_model", head.version, teacher.head.version)


def landmark_source(
    clip: CaptureClip,
    cameras: Sequence[str],
    landmarks: str,
    teacher: CaptureClip | None,
    seed: int,
    progress: Progress = no_progress,
) -> Callable[[Sequence[int]], ImageLandmarks]:
    """Landmarks of a clip by timesteps: those of the network in the file ``landmarks``, else of a known rig with an error of
    ``seed``. The network needs a ``teacher``: a clip of another subject with exact tracking in the same head model.

    Raises `InputError` if only one of file and teacher is given, or if the head models differ.
    """
    if bool(landmarks) != (teacher is not None):
        given, other = ("landmarks", "embedding") if landmarks else ("embedding", "landmarks")
        raise InputError("settings of the tracker", other, f"a value beside {given}", "none")
    if teacher is None:
        return partial(known_rig_landmarks, clip, cameras, seed=seed)
    check_teacher(teacher, clip.head)
    network = LandmarkNetwork(Path(landmarks))
    return NetworkLandmarks(network, learn_embedding(network, teacher, progress), clip, cameras)
