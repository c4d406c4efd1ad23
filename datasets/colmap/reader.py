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
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import Camera, FrameKey, Progress, StepRecord, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_name, digest, entries
from ...bench.io.images import probe_image
from ..clip import CaptureClip, FrameFiles
from ..ga.content_digests import digests_below
from ..ga.layout import DECLARATION_FILE, TRACKING_FOLDER, Declaration, parameter_name
from ..ga.tracking import find_head, read_tracking
from ..ga.validate import split_by_holding_out
from ..images import ImageStore
from ..steps.exclude import exclude_given, exclude_timesteps
from ..steps.masks import check_colour
from ..steps.undistort import Lens, undistort_clip
from .model import ColmapModel, find_model, read_model

SAME_CAMERA = 1e-4
"""Maximum difference between entries of the world-to-camera matrices of one camera, metres."""

_FLAT_NAME = re.compile(r"(?P<sequence>.+)_(?P<timestep>\d{5,})_(?P<camera>.+)")
_VHAP_NAME = re.compile(r"(?P<timestep>\d+)_(?P<camera>.+)")


def model_cameras(
    model: ColmapModel, *, distortion: Literal["refuse", "left to the images"] = "refuse"
) -> dict[str, Camera]:
    """Camera of each image by the image's name, which is also its id.

    Parameters
    ----------
    distortion : Literal['refuse', 'left to the images']
        How to treat distortion, which `Camera` lacks. "refuse" raises if a camera of the model is
        distorted; "left to the images" gives the cameras of the undistorted images, which
        `undistort_clip` makes with `model_lenses`.
    """
    lenses = {number: _lens(model, number) for number in model.cameras}
    found: dict[str, Camera] = {}
    for number, image in sorted(model.images.items()):
        lens = lenses[image.camera]
        if lens.distorts and distortion == "refuse":
            raise InputError(
                model.folder,
                f"camera {image.camera}",
                "a camera without lens distortion (PINHOLE or SIMPLE_PINHOLE)",
                f"{lens.model} with parameters {', '.join(f'{value:g}' for value in lens.parameters)}",
                "Undistort images and model together (`colmap image_undistorter`), or the clip by undistort_clip.",
            )
        if image.name in found:
            expected = "image names that differ"
            raise InputError(model.folder, f"image {number}", expected, f"{image.name!r} again")
        world_to_camera = np.eye(4)
        w, x, y, z = image.quaternion
        world_to_camera[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        world_to_camera[:3, 3] = image.translation
        found[image.name] = Camera(image.name, lens.width, lens.height, lens.K, world_to_camera)
    return found


def model_lenses(model: ColmapModel) -> dict[str, Lens]:
    """Lens of each image by the image's name; raises `InputError` for a camera model that is not known."""
    return {image.name: _lens(model, image.camera) for image in model.images.values()}


def _lens(model: ColmapModel, number: int) -> Lens:
    camera = model.cameras[number]
    try:
        return Lens(camera.model, camera.params, camera.width, camera.height)
    except InputError as error:
        key = f"camera {number}"
        raise InputError(model.folder, key, error.expected, error.found, error.remedy) from error


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
    found = model_cameras(model, distortion="left to the images")
    lens_of = model_lenses(model)
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
