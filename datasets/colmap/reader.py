"""Read a COLMAP dataset with a tracked head, and the cameras of a COLMAP sparse model.

COLMAP gives cameras and images. Methods also need the tracked head: parameter files of VHAP beside the model, one for
each timestep, and their head model. `export colmap --tracking` writes such a dataset::

    images/<subject>/<sequence>/<timestep>/<camera>.png     or images/<sequence>_<timestep>_<camera>.png
                                                            or images/<timestep>_<camera>.png
    masks/<the image's name>.png                            optional, 255 is the subject; else the image's alpha
    sparse/0/{cameras,images}.{bin,txt}
    flame_param/<timestep as %05d>.npz                      as in the GaussianAvatars/VHAP layout
    head_model.npz                                          unless given as head=
    headbench.json                                          optional, see `ga.layout.Declaration`

As here, the centre of the top left pixel is at (0.5, 0.5), and the world is mapped to the camera with OpenCV's axes.
Position, orientation and scale of the world are those of the reconstruction, in metres only if it was made from metric
poses; tracking must be in the same world.

Write a clip as a COLMAP dataset: images, masks, and a sparse model with the tracked mesh as its points. Layout of
``colmap`` and of radiance-field codes that read it: ``images/``, ``masks/``, ``sparse/0/``.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    FrameKey,
    Progress,
    StepRecord,
    no_progress,
)
from ...bench.errors import InputError
from ...bench.io.files import atomic_path, check_name, digest, entries
from ...bench.io.images import probe_image
from ..clip import CaptureClip, FrameFiles
from ..ga import layout
from ..ga.layout import DECLARATION_FILE, TRACKING_FOLDER, Declaration, parameter_name
from ..ga.tracking import find_head, pose_to_parameters, read_tracking
from ..ga.validate import digests_below, split_by_holding_out
from ..ga.writer import identity_parameters, save_npz
from ..head.arrays import save_head
from ..head.model import PosedSubject
from ..images import ImageStore, write_image
from ..mesh_pictures import rasterize_mesh
from ..steps.exclude import exclude_given, exclude_timesteps
from ..steps.masks import check_colour
from .model import ColmapModel, Lens, find_model, pycolmap, read_model, undistort_clip

SAME_CAMERA = 1e-4
"""Maximum difference between entries of the world-to-camera matrices of one camera, metres."""

_FLAT_NAME = re.compile(r"(?P<sequence>.+)_(?P<timestep>\d{5,})_(?P<camera>.+)")
_VHAP_NAME = re.compile(r"(?P<timestep>\d+)_(?P<camera>.+)")


def model_cameras(model: ColmapModel) -> dict[str, Camera]:
    """Camera of each image by the image's name, which is also its id; of its undistorted image where the lens distorts."""
    cameras: dict[str, Camera] = {}
    for number, image in sorted(model.images.items()):
        lens = model.cameras[image.camera]
        if image.name in cameras:
            expected = "image names that differ"
            raise InputError(model.folder, f"image {number}", expected, f"{image.name!r} again")
        world_to_camera = np.eye(4)
        w, x, y, z = image.quaternion
        world_to_camera[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        world_to_camera[:3, 3] = image.translation
        cameras[image.name] = Camera(image.name, lens.width, lens.height, lens.K, world_to_camera)
    return cameras


def find_datasets(root: Path) -> list[Path]:
    """The folder itself if it has a sparse model and a folder of images."""
    return [root] if (root / "images").is_dir() and find_model(root) is not None else []


def pose_files(path: str | Path) -> dict[int, Path]:
    """Parameter file of every timestep that has one."""
    files = entries(Path(path) / TRACKING_FOLDER, "*.npz")
    return {int(file.stem): file for file in files if file.stem.isdecimal()}


def read_dataset(
    path: str | Path,
    *,
    head: str | Path | None = None,
    masks: str | Path | None = None,
    regions: str | Path | None = None,
    eyelids: str | Path | None = None,
    subject: str = "",
    background: Sequence[float] | None = None,
    held_out_sequences: Sequence[str] = (),
    held_out_cameras: Sequence[str] = (),
    exclude: Mapping[int, str] | str | Path | None = None,
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Read a COLMAP dataset as a clip; lens distortion is removed from images and masks when they are read.

    Parameters
    ----------
    head, masks, regions, eyelids : str | Path | None
        Head model or its file, and the files that belong to it. None finds them: the head model in the
        capture, the others beside the head model.
    subject : str
        Subject id; "" takes it from the image names, else from the folder's name.
    background : Sequence[float] | None
        Colour that images are composited on, (r, g, b) in [0, 1]; None takes the declared one, else
        white.
    held_out_sequences, held_out_cameras : Sequence[str]
        Splits as for the reader ``ga``. Without them every frame is for training.
    exclude, cache_mb, use_cache : Mapping[int, str] | str | Path | None, float, bool
        As for the reader ``ga``.
    """
    root = Path(os.path.realpath(path))
    model = read_model(root)
    if not (root / TRACKING_FOLDER).is_dir():
        raise InputError(
            root,
            TRACKING_FOLDER,
            f"tracked parameters, {TRACKING_FOLDER}/{parameter_name(0)} and on, one file for each timestep",
            "no such folder: a COLMAP dataset has cameras and no tracked head",
            "Track with VHAP in the model's world, or export with `headbench export colmap --tracking`.",
        )
    declaration = Declaration.read(root)
    keys = {name: frame_key(root, name) for name in sorted(i.name for i in model.images.values())}
    subjects = {
        subject or key.subject or (declaration.subject if declaration else "") for key in keys.values()
    }
    if len(subjects) > 1:
        raise InputError(root, "images", "one subject", ", ".join(sorted(subjects)))
    subject = check_name(next(iter(subjects), "") or root.name, root, "subject")
    keys = {name: key._replace(subject=subject) for name, key in keys.items()}
    timesteps = {key.timestep: root / TRACKING_FOLDER / parameter_name(key.timestep) for key in keys.values()}
    asset = find_head(root, declaration, head, masks=masks, regions=regions, eyelids=eyelids)
    tracking = read_tracking(timesteps, asset, subject)
    cameras, lenses = _rig(model, keys)
    files = {key: _frame_files(root, name) for name, key in keys.items()}
    splits = split_by_holding_out(root, files, held_out_sequences, held_out_cameras)
    if not splits["train"]:
        raise InputError(root, "splits", "training frames left", "none left")
    used = {*timesteps.values()}
    used |= {file for frame in files.values() for file in (frame.image, frame.mask) if file is not None}
    contents = digests_below(root, used, use_cache=use_cache, progress=progress)
    contents["model"] = digest(sorted(model.cameras.items()), sorted(model.images.items()))
    declared = declaration.background if declaration else (1.0, 1.0, 1.0)
    ground = check_colour(declared if background is None else background)
    source = digest(tracking.head.fingerprint(), contents, subject, ground)
    record = {
        "model": model.folder.relative_to(root).as_posix(),
        "held_out_sequences": list(held_out_sequences),
        "held_out_cameras": list(held_out_cameras),
        **tracking.notes,
    }
    clip = CaptureClip(
        subject=subject,
        head=tracking.head,
        shape=tracking.shape,
        static_offset=tracking.static_offset,
        cameras=cameras,
        poses=tracking.poses,
        splits=splits,
        excluded={},
        background=ground,
        steps=(StepRecord("read_colmap", record, source),),
        files=files,
        source_fingerprint=source,
        store=ImageStore(cache_mb),
    )
    clip = undistort_clip(clip, lenses)
    if declaration and declaration.excluded:
        clip = exclude_timesteps(clip, declaration.excluded, source=root / DECLARATION_FILE)
    return exclude_given(clip, exclude)


def frame_key(root: Path, name: str) -> FrameKey:
    """Key of an image by its name; without them in the name, the subject is empty and the sequence "capture"."""
    parts = Path(name).with_suffix("").parts
    if len(parts) == 4 and parts[2].isdecimal():
        return FrameKey(parts[0], parts[1], int(parts[2]), parts[3])
    match = _FLAT_NAME.fullmatch(parts[-1]) or _VHAP_NAME.fullmatch(parts[-1])
    if match and len(parts) == 1:
        sequence = match.groupdict().get("sequence", "capture")
        return FrameKey("", sequence, int(match["timestep"]), match["camera"])
    expected = (
        "<subject>/<sequence>/<timestep>/<camera>, <sequence>_<timestep of five digits>_<camera> or "
        "<timestep>_<camera>, which name timestep and camera"
    )
    raise InputError(root, f"image {name}", expected, name)


def _frame_files(root: Path, name: str) -> FrameFiles:
    image = root / "images" / name
    own_alpha = image if probe_image(image).has_alpha else None
    # COLMAP's convention: the full name of the image with an additional suffix.
    mask = root / "masks" / f"{name}.png"
    return FrameFiles(image, mask if mask.exists() else own_alpha)


def _rig(model: ColmapModel, keys: Mapping[str, FrameKey]) -> tuple[dict[str, Camera], dict[str, Lens]]:
    """Camera and lens by camera id; a camera must be the same in all its images."""
    found = model_cameras(model)
    lens_of = {image.name: model.cameras[image.camera] for image in model.images.values()}
    cameras: dict[str, Camera] = {}
    lenses: dict[str, Lens] = {}
    for name, key in keys.items():
        camera = replace(found[name], id=key.camera)
        first = cameras.setdefault(key.camera, camera)
        lens = lenses.setdefault(key.camera, lens_of[name])
        moved = float(np.abs(first.world_to_camera - camera.world_to_camera).max())
        if moved > SAME_CAMERA or lens != lens_of[name]:
            expected = f"camera {key.camera} as in its other images"
            raise InputError(model.folder, f"image {name}", expected, f"one that differs by {moved:.3g}")
    return cameras, lenses


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
    """Name of a frame in the model and its path under ``images/``. "nested": subject/sequence/timestep/camera.png;
    "flat": sequence_timestep_camera.png."""
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

    ``keys``: Frames to write, at least one; their cameras become the model's. ``naming``: Naming of images, see
    `image_name`. "flat" is for readers that expect all images in one folder (3D Gaussian splatting and its derivatives);
    masks are then also written under the image's own name.
    """
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
    """Write a model to a temporary folder, then copy its files, so that no file is incomplete. Files of the other
    format are removed first because readers prefer binary files even if they are older."""
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
