"""Landmarks by MediaPipe's face landmark network, and their places on a head, found in drawings of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from ...bench.contracts import BoolArray, Camera, FloatArray, HeadAsset, Progress, no_progress
from ...bench.errors import InputError
from ...bench.experiments.viewpoints import look_at
from ...bench.landmark_network import LandmarkNetwork
from ..clip import CaptureClip
from ..head.arrays import region
from ..head.geometry import vertex_normals
from ..mesh_pictures import draw_mesh
from .embedding import FACING, Embedding, PicturedMesh, captured_heads, learn_embedding
from .landmarks import ImageLandmarks, known_rig_landmarks
from .views import Views

AZIMUTHS = (-40, -30, -20, -10, 0, 10, 20, 30, 40)
ELEVATIONS = (-10, 5, 20)
"""Directions from which the face is drawn, degrees."""
SIDE, SPAN, DISTANCE = 384, 2.2, 5.0
"""Pixels of a picture; its width and the distance of the camera, relative to the face's height."""
BACKGROUND, SKIN = (0.75, 0.78, 0.80), (0.80, 0.62, 0.52)
PAINT = {
    "lips": (0.66, 0.34, 0.33),
    "left_eyeball": (0.93, 0.93, 0.92),
    "right_eyeball": (0.93, 0.93, 0.92),
    "scalp": (0.25, 0.18, 0.13),
}
IRIS, IRIS_SHARE = (0.20, 0.15, 0.10), 0.15
"""Colour of the front of an eyeball, and the fraction of its vertices with this colour."""


def drawn_head(head: HeadAsset) -> Iterator[PicturedMesh]:
    """Pictures of the mean head from the front and from both sides. Raises `InputError` for a head model without a face."""
    mesh = np.asarray(head.template, np.float64)
    face = mesh[region(head, "face")]
    middle, height = (face.min(axis=0) + face.max(axis=0)) / 2, float(np.ptp(face[:, 1]))
    focal = SIDE * DISTANCE / SPAN
    K = np.array([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    colours = _painted(head, mesh)
    for number, (elevation, azimuth) in enumerate(product(np.radians(ELEVATIONS), np.radians(AZIMUTHS))):
        towards = np.array(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
        )
        motion = look_at(middle + DISTANCE * height * towards, middle, np.array([0.0, 1.0, 0.0]))
        camera = Camera(str(number), SIDE, SIDE, K, motion)
        yield PicturedMesh(draw_mesh(mesh, head.faces, camera, colours, background=BACKGROUND), camera, mesh)


def _painted(head: HeadAsset, mesh: FloatArray) -> FloatArray:
    """(V, 3) colours of the vertices; regions that the head model does not have are skin."""
    colours = np.tile(SKIN, (len(mesh), 1))
    for name, colour in PAINT.items():
        members = np.asarray(head.regions.get(name, ()), np.int64)
        colours[members] = colour
        if name.endswith("eyeball") and len(members):
            forward = mesh[members, 2]
            colours[members[forward > np.quantile(forward, 1 - IRIS_SHARE)]] = IRIS
    return colours


MOST_MISFIT = 0.04
"""Largest median distance of landmarks from those of the mean head, relative to the face's size."""


Finder = Callable[[int, str, FloatArray | None], Iterable[FloatArray | None]]
"""From a timestep, a camera's id and the landmarks of the image before, if any: (COUNT, 2) landmarks in pixels, or None where there is no
face, in the order in which they are tried."""


def found_in_images(
    network: LandmarkNetwork, clip: CaptureClip, timestep: int, camera: str, near: FloatArray | None
) -> Iterator[FloatArray | None]:
    """Landmarks around those of the image before, then those of the whole image; a `Finder` for a network and a clip."""
    image = clip.image(clip.frame_at[timestep, camera])
    if near is not None:
        yield network.find(image, near)
    yield network.find(image)


class NetworkLandmarks:
    """Landmark source: detections of the network in the images of some cameras of a clip.

    Parameters
    ----------
    finder : Finder
        The network's landmarks, `found_in_images` or those that are known.
    embedding : Embedding
        Where the network's landmarks are on the head model.
    """

    def __init__(
        self,
        finder: Finder,
        embedding: Embedding,
        clip: CaptureClip,
        cameras: Sequence[str],
    ):
        self._find, self._embedding, self._cameras = finder, embedding, [*cameras]
        self._views = Views([clip.cameras[name] for name in cameras])
        self._rest, self._normals = _rest(clip.head, embedding)

    def __call__(self, timesteps: Sequence[int]) -> ImageLandmarks:
        """Landmarks that face their camera, by the pose that fits the landmarks of the image."""
        pixels = np.full((len(timesteps), len(self._cameras), len(self._rest), 2), np.nan)
        for column, name in enumerate(self._cameras):
            near = None
            for row, timestep in enumerate(timesteps):
                trials, near = self._find(timestep, name, near), None
                for found in trials:
                    points = None if found is None else found[self._embedding.landmarks]
                    facing = None if points is None else self._facing(points, column)
                    if points is not None and facing is not None:
                        pixels[row, column] = np.where(facing[:, None], points, np.nan)
                        near = found
                        break
        return ImageLandmarks(self._embedding.corners, self._embedding.weights, pixels)

    def _facing(self, found: FloatArray, camera: int) -> BoolArray | None:
        """(L,) mask of landmarks that face the camera; None if they do not form a face."""
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
        return cosine > FACING


def _rest(head: HeadAsset, embedding: Embedding) -> tuple[FloatArray, FloatArray]:
    """Landmarks on the mean head, (L, 3) metres, and their normals."""
    template = np.asarray(head.template, np.float64)
    normals = vertex_normals(template, np.asarray(head.faces))
    mixed = [
        np.einsum("lk,lki->li", embedding.weights, values[embedding.corners])
        for values in (template, normals)
    ]
    return mixed[0], mixed[1]


def head_embedding(
    network: LandmarkNetwork,
    head: HeadAsset,
    teacher: CaptureClip | None,
    progress: Progress = no_progress,
) -> Embedding:
    """Embedding of the network's landmarks on a head model, learnt from a clip of another subject with exact tracking or from
    renderings of the head model.

    Raises `InputError` if the clip has another head model.
    """
    if teacher is None:
        return learn_embedding(network, head, drawn_head(head), progress)
    if teacher.head.version != head.version:
        raise InputError("embedding", "head_model", head.version, teacher.head.version)
    return learn_embedding(network, head, captured_heads(teacher), progress)


def landmark_source(
    clip: CaptureClip,
    cameras: Sequence[str],
    landmarks: str,
    teacher: CaptureClip | None,
    seed: int,
    progress: Progress = no_progress,
) -> Callable[[Sequence[int]], ImageLandmarks]:
    """Landmarks of a clip by timesteps: those of the network in the file ``landmarks``, else of a known rig with an error of
    ``seed``. ``teacher`` is that of `head_embedding`.

    Raises `InputError` if a teacher is given without a file, or if its head model differs.
    """
    if not landmarks:
        if teacher is not None:
            raise InputError("settings of the tracker", "landmarks", "a value beside embedding", "none")
        return partial(known_rig_landmarks, clip, cameras, seed=seed)
    network = LandmarkNetwork(Path(landmarks))
    finder = partial(found_in_images, network, clip)
    return NetworkLandmarks(finder, head_embedding(network, clip.head, teacher, progress), clip, cameras)
