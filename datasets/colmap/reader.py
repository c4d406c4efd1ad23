"""The cameras of a COLMAP sparse model as ours.

Both put the centre of the top left pixel at (0.5, 0.5), and both map the world to the camera with OpenCV's axes,
so that numbers are taken over as they are. A model's world is its own: position, orientation and scale are those
of the reconstruction, metres only where it was made from metric poses.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ...bench.contracts import Camera
from ...bench.errors import InputError
from ..steps.undistort import Lens
from .binary import read_cameras_binary, read_images_binary
from .records import ColmapModel
from .text import read_cameras_text, read_images_text

_PLACES = (".", "sparse/0", "sparse")


def read_model(path: str | PathLike[str]) -> ColmapModel:
    """Read cameras and images of the model in a folder, or in its ``sparse/0`` or ``sparse``; bin before txt.

    Raises
    ------
    InputError
        Where there is no model, a file is cut short or damaged, or an image's camera is missing.
    """
    root = Path(path)
    for place in _PLACES:
        folder = root / place
        for suffix, cameras_of, images_of in (
            (".bin", read_cameras_binary, read_images_binary),
            (".txt", read_cameras_text, read_images_text),
        ):
            files = folder / f"cameras{suffix}", folder / f"images{suffix}"
            if not all(file.is_file() for file in files):
                continue
            model = ColmapModel(folder, cameras_of(files[0]), images_of(files[1]))
            for number, image in model.images.items():
                if image.camera not in model.cameras:
                    expected = "one of the model's cameras"
                    raise InputError(files[1], f"image {number}, camera", expected, str(image.camera))
            return model
    expected = "a COLMAP model: cameras.bin and images.bin, or cameras.txt and images.txt"
    raise InputError(root, "", expected, "none in it, in sparse/0 or in sparse")


def model_cameras(
    model: ColmapModel, *, distortion: Literal["refuse", "left to the images"] = "refuse"
) -> dict[str, Camera]:
    """Camera of each image by the image's name, which is its id too.

    Parameters
    ----------
    distortion : `Camera` has none. "refuse" raises where a camera of the model has some; "left to the images" gives
        the cameras of the undistorted images, which `undistort_clip` makes with `model_lenses`.

    Raises
    ------
    InputError
        Where a lens distorts or is not known, or two images have one name.
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
            raise InputError(
                model.folder, f"image {number}", "image names that differ", f"{image.name!r} again"
            )
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
        raise InputError(
            model.folder, f"camera {number}", error.expected, error.found, error.remedy
        ) from error
