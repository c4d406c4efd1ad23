"""Baselines without learning: the mean image, the nearest training image, and the posed mesh with the median colours.

They put metrics into perspective: a method that does not clearly beat them has learned little.

Where the textured mesh is as good as a trained method, the training is at fault; where all are about equal, the tracking is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from ...bench.contracts import (
    BoolArray,
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadPose,
    IntArray,
)
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, TEXT, Member, read_arrays
from ...bench.io.images import read_pixels
from ...bench.protocol import evenly_with_ends
from ...datasets.head.model import PosedSubject, frontal_key
from ...datasets.images import write_image
from ...datasets.mesh_pictures import rasterize_mesh
from ..shared.avatar_files import (
    HEAD_FILE,
    SUBJECT_FILE,
    TRACKED,
    Subject,
    finish_fit,
    read_shared_head,
    read_subject,
    write_arrays,
    write_record,
)
from ..shared.loop import Fit, TrainingSummary
from ..shared.method import TrainedMethod
from .spec import MEAN_IMAGE, NEAREST_CAMERA, ONE_PICTURE, TEXTURED_MESH, NearestCameraConfig

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

    def shared_files(self) -> Sequence[Path]:
        """The head model."""
        return [self._folder / HEAD_FILE]

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """The mesh before the background."""
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
        samples = _samples(fit, mesh, self._frames(clip))
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
        if not seen.all():
            centres = _centres(mesh.neutral[np.asarray(clip.head.faces)], rows)
            colors[~seen] = colors[seen][self._nearest(centres[seen], centres[~seen])]
        write_arrays(fit.out / TEXTURE_FILE, {"colors": colors.reshape(count, -1, 3)})
        images = int(samples.image[-1]) + 1
        finish_fit(fit, TrainingSummary(images, images, 0.0), Subject.of(clip), clip.head)

    def _frames(self, clip: Clip) -> list[FrameKey]:
        """The training frames whose colours are taken, in temporal order."""
        keys = sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera))
        pixels = max(camera.width * camera.height for camera in clip.cameras.values())
        return evenly_with_ends(keys, max(1, SAMPLES // pixels))

    def _nearest(self, seen: FloatArray, unseen: FloatArray) -> IntArray:
        """Which of the ``seen`` points (N, 3) of the neutral mesh gives each of the ``unseen`` points (M, 3) its colour."""
        return np.asarray(cKDTree(seen).query(unseen)[1])


class OnePicture(TexturedMesh):
    """Takes the colours of one picture: of the first training timestep, from the most frontal camera.

    A texel that the picture does not show has the colour of the nearest one that it shows, where both halves of the face
    are taken to be equal: seen points also count at their mirror images, x being the axis from right to left of every head model.
    """

    name, version = ONE_PICTURE.name, ONE_PICTURE.version

    def _frames(self, clip: Clip) -> list[FrameKey]:
        return [frontal_key(clip, min(key.timestep for key in clip.splits["train"]))]

    def _nearest(self, seen: FloatArray, unseen: FloatArray) -> IntArray:
        return super()._nearest(np.concatenate([seen, seen * [-1, 1, 1]]), unseen) % len(seen)


class MeshSamples(NamedTuple):
    """N pixels of the subject on the posed mesh: number of the image, triangle, (N, 3) barycentric weights and 8-bit colours."""

    image: IntArray
    face: IntArray
    weights: FloatArray
    colors: ByteArray


def _samples(fit: Fit, mesh: PosedSubject, keys: Sequence[FrameKey]) -> MeshSamples:
    clip = fit.clip
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


MEAN_FILE = "mean.npz"
INDEX_FILE = "index.npz"
IMAGE_FOLDER = "images"

_COLOR = Member("f", (3,), 1)
_MEAN = {"rgba": Member("f", ("H", "W", 4), 1, "f4"), "background": _COLOR, "head_model": TEXT}
_INDEX = {
    "head_model": TEXT,
    "background": _COLOR,
    "timesteps": Member("iu", ("T",)),
    "signals": Member("f", ("T", "D"), MAX_MAGNITUDE),
    "scales": Member("f", ("D",), MAX_MAGNITUDE),
    "centers": Member("f", ("C", 3)),
    "images": Member("i", ("T", "C")),
}


def resize(image: FloatArray, width: int, height: int) -> FloatArray:
    """Resize a float32 image: area means when shrinking, bilinear when growing; unchanged at its own size."""
    if image.shape[:2] == (height, width):
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    mode = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=mode), dtype=np.float32)


def recomposite(
    rgb: FloatArray, alpha: FloatArray, was: Sequence[float] | FloatArray, background: Sequence[float]
) -> Frame:
    """Exchange the background under straight-alpha compositing: add (1 - alpha) (new - old)."""
    change = np.asarray(background, np.float32) - np.asarray(was, np.float32)
    exchanged = rgb + (1 - alpha[..., None]) * change if change.any() else rgb
    return Frame(np.clip(exchanged, 0, 1).astype(np.float32), alpha.astype(np.float32))


def _rgba(clip: Clip, key: FrameKey) -> ByteArray:
    """(H, W, 4) image and coverage, which is 1 without a mask."""
    rgb, mask = clip.image(key), clip.mask(key)
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8) if mask is None else mask])


class _ImageAvatar:
    """An avatar that renders one of its stored images at the camera's size.

    ``arrays``: arrays of the images, including ``head_model`` and ``background``.
    """

    def __init__(self, arrays: Mapping[str, np.ndarray]):
        self._head_model, self._background = str(arrays["head_model"]), arrays["background"]

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """The image at the camera's size."""
        if pose.head_model != self._head_model:
            raise InputError("pose", "head_model", repr(self._head_model), repr(pose.head_model))
        rgba = resize(self._image(camera, pose), camera.width, camera.height)
        return recomposite(rgba[..., :3], rgba[..., 3], self._background, background)

    def _image(self, camera: Camera, pose: HeadPose) -> FloatArray:
        """(H, W, 4)."""
        raise NotImplementedError


class MeanImageAvatar(_ImageAvatar):
    """One image for every camera and pose."""

    def __init__(self, folder: Path):
        self._path = folder / MEAN_FILE
        arrays = read_arrays(self._path, _MEAN)
        super().__init__(arrays)
        self._rgba = arrays["rgba"]
        if not self._rgba.size:
            raise InputError(self._path, "rgba", "at least one pixel", f"shape {self._rgba.shape}")

    def files(self) -> Sequence[Path]:
        """The image."""
        return [self._path]

    def _image(self, camera: Camera, pose: HeadPose) -> FloatArray:
        return self._rgba


class MeanImage(TrainedMethod[None, MeanImageAvatar]):
    """Mean of all training images, at the size of the largest; budget and seed have no effect."""

    name, version = MEAN_IMAGE.name, MEAN_IMAGE.version
    config_class = type(None)

    def load(self, path: Path, *, device: str) -> MeanImageAvatar:
        """Read the avatar `fit` wrote."""
        return MeanImageAvatar(path)

    def _train(self, fit: Fit, config: None) -> None:
        clip, keys = fit.clip, fit.clip.splits["train"]
        cameras = [clip.cameras[key.camera] for key in keys]
        largest = max(cameras, key=lambda camera: camera.width * camera.height)
        total = np.zeros((largest.height, largest.width, 4))
        for done, key in enumerate(keys, 1):
            total += resize(_rgba(clip, key).astype(np.float32) / 255, largest.width, largest.height)
            fit.progress(done, len(keys))
        arrays = {
            "rgba": (total / len(keys)).astype(np.float32),
            "background": np.asarray(clip.background, np.float32),
            "head_model": np.array(clip.head.version),
        }
        write_arrays(fit.out / MEAN_FILE, arrays)
        write_record(fit, TrainingSummary(len(keys), len(keys), 0.0))


class NearestCameraAvatar(_ImageAvatar):
    """Renders a training image: nearest timestep by driving signal, then nearest camera by direction.

    The distance of two driving signals is Euclidean with every parameter divided by its standard deviation over the
    training timesteps, so that radians, metres and coefficients are comparable. The direction is that from the head's
    translation to the camera.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._index = read_arrays(folder / INDEX_FILE, _INDEX)
        super().__init__(self._index)
        self._check_index(folder / INDEX_FILE)

    def nearest(self, camera: Camera, pose: HeadPose) -> int:
        """Index of the training image to show."""
        signals, scales = self._index["signals"], self._index["scales"]
        signal = driving_signal(pose)
        if signal.shape != scales.shape:
            raise InputError("pose", "expression", f"{len(scales)} driving values", f"{len(signal)}")
        distances = (((signals - signal) / scales) ** 2).sum(1)
        # Among equally near timesteps the pose's own is preferred, since tracking may be constant.
        same_timestep = self._index["timesteps"] == (-1 if pose.timestep is None else pose.timestep)
        row = int(np.lexsort((~same_timestep, distances))[0])
        available = np.flatnonzero(self._index["images"][row] >= 0)
        origin = np.asarray(pose.translation, np.float64)
        towards = _unit(self._index["centers"][available] - origin)
        wanted = _unit((camera.center - origin)[None])[0]
        return int(self._index["images"][row, available[int(np.argmax(towards @ wanted))]])

    def files(self) -> Sequence[Path]:
        """The index and every image."""
        numbers = sorted(int(number) for number in self._index["images"].ravel() if number >= 0)
        return [self._folder / INDEX_FILE, *(image_path(self._folder, number) for number in numbers)]

    def _check_index(self, path: Path) -> None:
        images = self._index["images"]
        if not len(images) or not (images >= 0).any(axis=1).all():
            raise InputError(path, "images", "an image of each timestep, and a timestep", "none of one")
        if images.min() < -1 or images.max() >= images.size:
            found = f"numbers from {images.min()} to {images.max()}"
            raise InputError(path, "images", f"numbers from -1 to {images.size - 1}", found)
        if not (self._index["scales"] > 0).all():
            raise InputError(path, "scales", "numbers above 0", "others")
        for file in self.files():
            if not file.is_file():
                raise InputError(file, "", f"an image that {INDEX_FILE} names", "no such file")

    def _image(self, camera: Camera, pose: HeadPose) -> FloatArray:
        path = image_path(self._folder, self.nearest(camera, pose))
        pixels = read_pixels(path)
        if pixels.ndim != 3 or pixels.shape[2] != 4:
            raise InputError(path, "", "an 8-bit RGBA image", "something else")
        return pixels[..., [2, 1, 0, 3]].astype(np.float32) / 255


class NearestCamera(TrainedMethod[NearestCameraConfig, NearestCameraAvatar]):
    """Stores the training images and an index of their driving signals and cameras; budget and seed have no effect."""

    name, version = NEAREST_CAMERA.name, NEAREST_CAMERA.version
    config_class = NearestCameraConfig

    def load(self, path: Path, *, device: str) -> NearestCameraAvatar:
        """Read the avatar `fit` wrote."""
        return NearestCameraAvatar(path)

    def _train(self, fit: Fit, config: NearestCameraConfig) -> None:
        clip, timesteps = fit.clip, self._timesteps(fit.clip)
        row = {timestep: number for number, timestep in enumerate(timesteps)}
        keys = [key for key in clip.splits["train"] if key.timestep in row]
        column = {name: number for number, name in enumerate(sorted({key.camera for key in keys}))}
        images = np.full((len(row), len(column)), -1, dtype=np.int64)
        for number, key in enumerate(keys):
            write_image(image_path(fit.out, number), _rgba(clip, key))
            images[row[key.timestep], column[key.camera]] = number
            fit.progress(number + 1, len(keys))
        signals = np.stack([driving_signal(clip.poses[timestep]) for timestep in timesteps])
        spread = signals.std(0)
        arrays = {
            "head_model": np.array(clip.head.version),
            "background": np.asarray(clip.background, np.float32),
            "timesteps": np.array(timesteps),
            "signals": signals,
            # A parameter that is constant in training must not outweigh all others when it changes.
            "scales": np.where(spread > 1e-8, spread, 1.0),
            "centers": np.stack([clip.cameras[name].center for name in column]),
            "images": images,
        }
        write_arrays(fit.out / INDEX_FILE, arrays)
        write_record(fit, TrainingSummary(len(keys), len(keys), 0.0))

    def _timesteps(self, clip: Clip) -> list[int]:
        timesteps = sorted({key.timestep for key in clip.splits["train"]})
        most = self.config.max_timesteps
        return timesteps if most is None else evenly_with_ends(timesteps, max(most, 1))


def driving_signal(pose: HeadPose) -> FloatArray:
    """All driving parameters in one float64 vector."""
    return np.concatenate([np.asarray(getattr(pose, name), np.float64).ravel() for name in TRACKED])


def image_path(folder: Path, number: int) -> Path:
    """File of a kept training image."""
    return folder / IMAGE_FOLDER / f"{number:06d}.png"


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
