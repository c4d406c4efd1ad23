"""Write a clip as a COLMAP dataset: images, masks, and a sparse model with the tracked mesh as its points.

Layout of ``colmap`` and of radiance-field codes that read it: ``images/``, ``masks/``, ``sparse/0/``.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ...bench.contracts import ByteArray, Camera, Clip, FloatArray, FrameKey, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import atomic_path
from ..clip import CaptureClip
from ..ga import layout
from ..ga.tracking import pose_to_parameters
from ..ga.writer import identity_parameters, save_npz
from ..head.arrays import save_head
from ..head.subject import PosedSubject
from ..images import write_image
from ..mesh_pictures import rasterize_mesh
from .model import pycolmap
from .reader import frame_key

ModelFormat = Literal["bin", "txt"]
Naming = Literal["nested", "flat"]
_DEPTH_TOLERANCE = 2e-3  # metres that a visible vertex may be behind the surface drawn at its pixel
_SKEW_TOLERANCE = 1e-9
_UNSEEN = (128, 128, 128)


class Exported(NamedTuple):
    """Summary of an export."""

    cameras: int
    images: int
    points: int
    observations: int


class _Observation(NamedTuple):
    """Indices, positions and colours of the vertices visible in an image."""

    vertices: np.ndarray
    pixels: FloatArray
    colors: ByteArray


def image_name(key: FrameKey, naming: Naming = "nested") -> str:
    """Name of a frame in the model and its path under ``images/``.

    "nested": subject/sequence/timestep/camera.png; "flat": sequence_timestep_camera.png.
    """
    return f"{key}.png" if naming == "nested" else f"{key.sequence}_{key.timestep:05d}_{key.camera}.png"


def export_model(
    clip: Clip,
    keys: Sequence[FrameKey],
    out: Path,
    *,
    model_format: ModelFormat = "bin",
    naming: Naming = "nested",
    progress: Progress = no_progress,
) -> Exported:
    """Write frames of a clip as a COLMAP dataset.

    The points are the vertices of the mesh at the earliest timestep among ``keys``; images of that timestep observe
    their visible vertices, which get their colours. Images of other timesteps have poses but no points because the
    head has moved.

    Parameters
    ----------
    keys : Sequence[FrameKey]
        Frames to write, at least one; their cameras become the model's.
    naming : Naming
        Naming of images, see `image_name`. "flat" is for readers that expect all images in one folder
        (3D Gaussian splatting and its derivatives); masks are then also written under the image's own
        name.
    """
    if not keys:
        raise InputError("frames to export", "", "at least one", "none")
    ids = sorted({key.camera for key in keys})
    for name in ids:
        if abs(clip.cameras[name].K[0, 1]) > _SKEW_TOLERANCE:
            raise InputError("clip", f"camera {name}, K", "no skew", f"{clip.cameras[name].K[0, 1]:g} pixels")
    names = {key: image_name(key, naming) for key in keys}
    for key, name in names.items():
        if naming == "flat" and frame_key(out, name) != key._replace(subject=""):
            expected = "names of sequence and camera without _NUMBER_ of five digits in them"
            raise InputError("clip", str(key), expected, name, "Export with --names nested.")
    first = min(key.timestep for key in keys)
    vertices = PosedSubject.of(clip).meshes([clip.poses[first]])[0]
    model = pycolmap().Reconstruction()
    for number, name in enumerate(ids, start=1):
        camera = clip.cameras[name]
        params = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
        model.add_camera_with_trivial_rig(
            pycolmap().Camera(
                camera_id=number, model="PINHOLE", width=camera.width, height=camera.height, params=params
            )
        )
    views: dict[int, _Observation] = {}
    for number, key in enumerate(sorted(keys), start=1):
        camera, picture = clip.cameras[key.camera], clip.image(key)
        if key.timestep == first:
            views[number] = _observe(vertices, np.asarray(clip.head.faces), camera, picture)
        pixels = views[number].pixels if number in views else np.zeros((0, 2))
        image = pycolmap().Image(names[key], pixels, ids.index(key.camera) + 1, number)
        model.add_image_with_trivial_frame(image, pycolmap().Rigid3d(camera.world_to_camera[:3]))
        write_image(out / "images" / names[key], picture)
        mask = clip.mask(key)
        if mask is not None:
            # COLMAP's convention: the full name of the image with an additional suffix, 0 for masked pixels.
            write_image(out / "masks" / f"{names[key]}.png", mask)
            if naming == "flat":
                write_image(out / "masks" / names[key], mask)  # as nerfbaselines expects it
        progress(number, len(keys), str(key))
    _add_points(model, vertices, views)
    _write_model(model, out / "sparse" / "0", model_format)
    return Exported(
        model.num_cameras(), model.num_images(), model.num_points3D(), model.compute_num_observations()
    )


def export_tracking(clip: CaptureClip, timesteps: Collection[int], out: Path) -> None:
    """Write the additional files of the reader ``colmap``: parameters by timestep, head model, conventions."""
    identity = identity_parameters(clip.shape, clip.static_offset)
    for timestep in sorted(timesteps):
        path = out / layout.TRACKING_FOLDER / layout.parameter_name(timestep)
        save_npz(path, pose_to_parameters(clip.poses[timestep]) | identity)
    save_head(out / layout.HEAD_FILE, clip.head)
    red, green, blue = clip.background.tolist()
    excluded = {key.timestep: reason for key, reason in clip.excluded.items() if key.timestep in timesteps}
    layout.Declaration(
        clip.subject, clip.head.version, background=(red, green, blue), cy="top", excluded=excluded
    ).write(out)


def _observe(vertices: FloatArray, faces: np.ndarray, camera: Camera, picture: ByteArray) -> _Observation:
    """Find the vertices in the image that are not hidden by the mesh."""
    points = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    before = np.flatnonzero(points[:, 2] > 0)
    pixels = points[before] @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    column, row = np.floor(pixels).astype(int).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    before, pixels, column, row = before[inside], pixels[inside], column[inside], row[inside]
    surface = rasterize_mesh(vertices, faces, camera).depth[row, column]
    seen = points[before, 2] <= surface + _DEPTH_TOLERANCE
    return _Observation(before[seen], pixels[seen], picture[row[seen], column[seen]])


def _add_points(model: Any, vertices: FloatArray, views: dict[int, _Observation]) -> None:
    """Add all vertices, in order, with mean colours and observing images."""
    sums, counts = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    tracks: list[list[Any]] = [[] for _ in vertices]
    for number, view in views.items():
        sums[view.vertices] += view.colors
        counts[view.vertices] += 1
        for index, vertex in enumerate(view.vertices.tolist()):
            tracks[vertex].append(pycolmap().TrackElement(number, index))
    means = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], _UNSEEN)
    colors = np.round(means).astype(np.uint8)
    for vertex, track, color in zip(vertices, tracks, colors):
        model.add_point3D(vertex, pycolmap().Track(track), color)
    model.update_point_3d_errors()


def _write_model(model: Any, folder: Path, model_format: ModelFormat) -> None:
    """Write a model to a temporary folder, then copy its files, so that no file is incomplete.

    Files of the other format are removed first because readers prefer binary files even if they are older.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        if model_format == "bin":
            model.write_binary(temporary)
        else:
            model.write_text(temporary)
        other = ".txt" if model_format == "bin" else ".bin"
        files = sorted(Path(temporary).iterdir())
        for file in files:
            (folder / file.with_suffix(other).name).unlink(missing_ok=True)
        for file in files:
            with atomic_path(folder / file.name) as copy:
                shutil.copyfile(file, copy)
