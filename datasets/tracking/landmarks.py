"""Landmarks in images: sources, and corresponding points of the mesh.

Embedding of a network's landmarks on a head model. Landmarks by MediaPipe's face landmark network, and their places on
a head, found in drawings of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import (
    BoolArray,
    ByteArray,
    Camera,
    FloatArray,
    HeadAsset,
    IntArray,
    Progress,
    no_progress,
)
from ...bench.errors import InputError
from ...bench.experiments.viewpoints import look_at
from ...bench.landmark_network import COUNT, LandmarkNetwork
from ..clip import CaptureClip
from ..head.arrays import region
from ..head.geometry import vertex_normals
from ..head.model import PosedSubject
from ..head.refit.identity import closest_points
from ..mesh_pictures import draw_mesh, rasterize_mesh
from .rig import Occlusion, Views

LEARNING_FRAMES = 120
"""Images of a capture from which an embedding is learnt."""
MOST_SPREAD = 0.004
"""Maximum median sliding of a landmark on the mesh, metres; others are left out."""
FEWEST_LANDMARKS = 10
FACING = 0.5
"""Minimum cosine between the normal of a landmark and the direction to the camera."""
_FEWEST = 0.15  # fraction of images in which a landmark must hit the mesh


_PAIRS = (
    *((13, 14), (82, 87), (81, 178), (80, 88), (312, 317), (311, 402), (310, 318)),  # inner lips
    *((0, 17), (37, 84), (267, 314), (61, 291)),  # outer lips, and corners of the mouth
    *((159, 145), (158, 153), (160, 144), (157, 154), (161, 163)),  # right lids
    *((386, 374), (385, 380), (387, 373), (384, 381), (388, 390)),  # left lids
)
"""Landmarks of MediaPipe whose distance shows how far mouth and eyes are open."""


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
    """Positions of the network's landmarks on the mesh: medians over images."""
    template = np.asarray(head.template, np.float64)
    places: list[FloatArray] = []
    previous: FloatArray | None = None
    last = ""
    for image, camera, mesh in pictures:
        progress(len(places), max(LEARNING_FRAMES, len(places) + 1), "learning landmarks")
        previous = network.find(image, previous if camera.id == last else None)
        last = camera.id
        places.append(np.full((COUNT, 3), np.nan))
        if previous is None:
            continue
        fragments = rasterize_mesh(mesh, head.faces, camera)
        column, line = np.floor(previous).astype(int).T
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


BIAS_MM, NOISE_MM = 2.6, 1.0
"""Error of the landmarks of a known rig: the part that each landmark has in a camera at all timesteps, and the part that
changes, root mean square along each axis of the image. Measured for a landmark network on synthetic heads."""
COMMON = 0.5
"""Part of the variance of the bias that is the same in all cameras, as of a network that places a landmark wrongly on the face."""
SIMULATED = 160
"""Landmarks of a known rig."""
_SHARES = (("lips", 0.2), ("eye_region", 0.3), ("face", 0.5))


class ImageLandmarks(NamedTuple):
    """Landmarks of a clip: points of the mesh, and where cameras saw them."""

    corners: IntArray
    """(L, 3) vertices of the triangle of each landmark."""
    weights: FloatArray
    """(L, 3) barycentric weights."""
    pixels: FloatArray
    """(T, C, L, 2) places, pixels; NaN where a landmark was not found."""
    pairs: IntArray
    """(N, 2) landmarks on opposite lips and lids, whose differences are more exact than the places."""

    def of(self, timesteps: IntArray | BoolArray) -> ImageLandmarks:
        """Those of some timesteps, indices or a mask."""
        return self._replace(pixels=self.pixels[timesteps])

    @property
    def seen(self) -> BoolArray:
        """(T,) whether any landmark was found."""
        return np.asarray(np.isfinite(self.pixels).any(axis=(1, 2, 3)))


def spread_vertices(points: FloatArray, count: int) -> IntArray:
    """(count,) indices of points (n, 3) that are far from one another, greedily."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def rig_vertices(head: HeadAsset) -> IntArray:
    """Vertices that serve as landmarks of a known rig, spread over lips, eye regions and face."""
    region(head, "face")
    taken: list[IntArray] = []
    hidden = [np.asarray(head.regions.get(name, ()), np.int64) for name in ("mouth_socket", "teeth")]
    for name, share in _SHARES:
        members = np.setdiff1d(head.regions.get(name, ()), np.concatenate([*hidden, *taken])).astype(np.int64)
        if len(members):
            taken.append(
                members[spread_vertices(np.asarray(head.template)[members], round(share * SIMULATED))]
            )
    return np.unique(np.concatenate(taken))


def known_rig_landmarks(
    clip: CaptureClip, cameras: Sequence[str], timesteps: Sequence[int], seed: int
) -> ImageLandmarks:
    """Projections of vertices of the clip's own tracked mesh with the error of a landmark network, seeded.

    They replace a network whose file is missing; because of their error, tracking must still be refined. Landmarks
    hidden by the mesh are missing.
    """
    rng = np.random.default_rng([seed, 11, *clip.subject.encode()])  # errors differ by subject
    vertices = rig_vertices(clip.head)
    views = Views([clip.cameras[name] for name in cameras])
    subject = PosedSubject.of(clip)
    occlusion = Occlusion(clip.head, subject.neutral, views)
    size = (len(views.cameras), len(vertices), 2)
    bias = np.sqrt(COMMON) * rng.standard_normal(size[1:]) + np.sqrt(1 - COMMON) * rng.standard_normal(size)
    pixels = np.full((len(timesteps), *size), np.nan)
    for row, (_, mesh) in enumerate(subject.each(clip, timesteps)):
        cosine = occlusion.visible(mesh, vertices)
        projected = views.project(mesh[vertices])
        per_metre = views.intrinsics[:, None, 0, 0] / projected.depth
        error = 1e-3 * (BIAS_MM * bias + NOISE_MM * rng.standard_normal(size))
        detected = projected.pixels + error * per_metre[..., None]
        pixels[row] = np.where(cosine[..., None] > 0.5, detected, np.nan)
    corners = np.repeat(vertices[:, None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(vertices), 1))
    return ImageLandmarks(corners, weights, pixels, np.zeros((0, 2), np.int64))


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
    """Pictures of the mean head from the front and from both sides."""
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

    ``finder``: The network's landmarks, `found_in_images` or those that are known. ``embedding``: Where the network's
    landmarks are on the head model.
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
        place = {number: row for row, number in enumerate(self._embedding.landmarks.tolist())}
        pairs = [[place[one], place[other]] for one, other in _PAIRS if one in place and other in place]
        corners, weights = self._embedding.corners, self._embedding.weights
        return ImageLandmarks(corners, weights, pixels, np.array(pairs, np.int64).reshape(-1, 2))

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
    renderings of the head model."""
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
    ``seed``. ``teacher`` is that of `head_embedding`."""
    if not landmarks:
        if teacher is not None:
            raise InputError("settings of the tracker", "landmarks", "a value beside embedding", "none")
        return partial(known_rig_landmarks, clip, cameras, seed=seed)
    network = LandmarkNetwork(Path(landmarks))
    finder = partial(found_in_images, network, clip)
    return NetworkLandmarks(finder, head_embedding(network, clip.head, teacher, progress), clip, cameras)
