"""Baseline of tracking alone: the posed mesh with the median colours of the training images.

Where it is as good as a trained method, the training is at fault; where all are about equal, the tracking is.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import BoolArray, ByteArray, Camera, FloatArray, Frame, HeadPose, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import Member, read_arrays
from ...bench.protocol import evenly_with_ends
from ...datasets.head.model import PosedSubject
from ...datasets.mesh_pictures import rasterize_mesh
from ..shared.avatar_files import (
    SUBJECT_FILE,
    Subject,
    finish_fit,
    read_shared_head,
    read_subject,
    write_arrays,
)
from ..shared.loop import Fit, TrainingSummary
from ..shared.method import TrainedMethod
from .spec import TEXTURED_MESH

TEXTURE_FILE = "texture.npz"
_TEXTURE = {"colors": Member("u", ("F", "T", 3), None, "u1")}

SAMPLES = 2**24
"""Maximum number of pixels of the evenly spaced training images from which the colours are taken, beside one image."""
MOST_ROWS = 16
"""Maximum number of rows of texels in a triangle."""
FOREGROUND = 128
"""Minimum level of the mask of a pixel that is used."""
SUPERSAMPLING = 2


class TexturedMeshAvatar:
    """The posed mesh, drawn with one colour for each texel, without shading.

    A triangle has rows² texels: the parts into which equally spaced parallels to its sides divide it.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        head = read_shared_head(folder)
        subject = read_subject(folder / SUBJECT_FILE, head)
        self._mesh = PosedSubject(head, subject.shape, subject.static_offset)
        self._faces = head.faces
        self._colors = read_arrays(folder / TEXTURE_FILE, _TEXTURE, {"F": len(head.faces)})["colors"]
        self._rows = round(self._colors.shape[1] ** 0.5)
        if not 0 < self._rows**2 == self._colors.shape[1]:
            expected = "a square number of texels in each triangle"
            raise InputError(folder / TEXTURE_FILE, "colors", expected, str(self._colors.shape[1]))

    def files(self) -> Sequence[Path]:
        """The texture and the subject."""
        return [self._folder / TEXTURE_FILE, self._folder / SUBJECT_FILE]

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """The mesh before the background. Raises `InputError` for a pose of another head model."""
        (vertices,) = self._mesh.meshes([pose])
        fine = camera.resized(SUPERSAMPLING * camera.width, SUPERSAMPLING * camera.height)
        fragments = rasterize_mesh(vertices, self._faces, fine)
        hit = fragments.face >= 0
        places = texels(fragments.face[hit], fragments.weights[hit], self._rows)
        layer = np.zeros((*hit.shape, 4), np.float32)
        layer[hit, :3] = self._colors.reshape(-1, 3)[places] / np.float32(255)
        layer[hit, 3] = 1
        layer = cv2.resize(layer, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        alpha: FloatArray = layer[..., 3].astype(np.float32)
        return Frame(layer[..., :3] + (1 - alpha[..., None]) * np.asarray(background, np.float32), alpha)


class TexturedMesh(TrainedMethod[None, TexturedMeshAvatar]):
    """Takes the colours; budget and seed have no effect."""

    name, version = TEXTURED_MESH.name, TEXTURED_MESH.version
    config_class = type(None)
    draws_splats = False

    def load(self, path: Path, *, device: str) -> TexturedMeshAvatar:
        """Read the avatar `fit` wrote."""
        return TexturedMeshAvatar(path)

    def _train(self, fit: Fit, config: None) -> None:
        clip, mesh = fit.clip, PosedSubject.of(fit.clip)
        samples = _samples(fit, mesh)
        if not len(samples.face):
            expected = "training images in which the posed mesh covers pixels of the subject"
            raise InputError(
                f"capture of {clip.subject}", "tracking", expected, "none", "See `headbench lint`."
            )
        count = len(clip.head.faces)
        # As many texels as pixels in the mean visible triangle.
        visible = np.unique(samples.image * count + samples.face)
        rows = int(np.clip(np.ceil((len(samples.face) / len(visible)) ** 0.5), 1, MOST_ROWS))
        places = texels(samples.face, samples.weights, rows)
        colors, seen = _medians(places, samples.colors, count * rows**2)
        if not seen.all():  # the colour of the nearest one
            centres = _centres(mesh.neutral[np.asarray(clip.head.faces)], rows)
            colors[~seen] = colors[seen][cKDTree(centres[seen]).query(centres[~seen])[1]]
        write_arrays(fit.out / TEXTURE_FILE, {"colors": colors.reshape(count, -1, 3)})
        images = int(samples.image[-1]) + 1
        finish_fit(fit, TrainingSummary(images, images, 0.0), Subject.of(clip), clip.head)


class MeshSamples(NamedTuple):
    """N pixels of the subject on the posed mesh: number of the image, triangle, (N, 3) barycentric weights and 8-bit colours."""

    image: IntArray
    face: IntArray
    weights: FloatArray
    colors: ByteArray


def _samples(fit: Fit, mesh: PosedSubject) -> MeshSamples:
    clip = fit.clip
    keys = sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera))
    pixels = max(camera.width * camera.height for camera in clip.cameras.values())
    keys = evenly_with_ends(keys, max(1, SAMPLES // pixels))
    meshes = mesh.each(clip, list(dict.fromkeys(key.timestep for key in keys)))
    timestep, vertices = next(meshes)
    parts: list[MeshSamples] = []
    for number, key in enumerate(keys):
        if key.timestep != timestep:
            timestep, vertices = next(meshes)
        view = rasterize_mesh(vertices, np.asarray(clip.head.faces), clip.cameras[key.camera])
        mask, used = clip.mask(key), view.face >= 0
        if mask is not None:
            used &= mask >= FOREGROUND
        face = view.face[used]
        parts.append(MeshSamples(np.full(len(face), number), face, view.weights[used], clip.image(key)[used]))
        fit.progress(number + 1, len(keys))
    return MeshSamples(*map(np.concatenate, zip(*parts)))


def texels(face: IntArray, weights: FloatArray, rows: int) -> IntArray:
    """(N,) texels of points on triangles ``face`` (N,) with barycentric ``weights`` (N, 3).

    Row i, counted from the first corner's opposite side to that corner, holds 2 (rows - i) - 1 texels, alternately with the
    orientation of the triangle and turned.
    """
    scaled = rows * np.clip(weights[:, :2], 0, 1 - 1e-6)
    row, column = scaled.astype(np.int64).T
    column = np.minimum(column, rows - 1 - row)
    turned = (scaled[:, 0] - row + scaled[:, 1] - column > 1) & (row + column < rows - 1)
    return np.asarray(face, np.int64) * rows**2 + row * (2 * rows - row) + 2 * column + turned


def _centres(corners: FloatArray, rows: int) -> FloatArray:
    """(F rows², 3) centres of the texels of triangles with ``corners`` (F, 3, 3)."""
    weights = []
    for row in range(rows):
        for column in range(rows - row):
            weights.append([row + 1 / 3, column + 1 / 3])
            if row + column < rows - 1:
                weights.append([row + 2 / 3, column + 2 / 3])
    first = np.array(weights) / rows
    return np.einsum("tc,fcx->ftx", np.column_stack([first, 1 - first.sum(axis=1)]), corners).reshape(-1, 3)


def _medians(places: IntArray, values: ByteArray, count: int) -> tuple[ByteArray, BoolArray]:
    """(count, 3) lower median of the values (N, 3) at each of the ``places`` (N,), and which places have any."""
    numbers = np.bincount(places, minlength=count)
    middle = np.cumsum(numbers) - numbers + np.maximum(numbers - 1, 0) // 2
    seen = numbers > 0
    colors = np.zeros((count, 3), np.uint8)
    for channel in range(3):
        ranked = np.sort(places * 256 + values[:, channel])
        colors[seen, channel] = ranked[middle[seen]] % 256
    return colors, seen
