"""Read a tracked video as a clip: one camera, the last frames held out for self-reenactment, no novel views.

The layouts are those of `insta` and `imavatar`. VHAP's monocular export has GaussianAvatars' layout and is
read by the reader ``ga``.

Formats read:

- IMavatar's `flame_params.json`. Written by zhengyuf/IMavatar@923b60aa (`preprocess/DECA/optimize.py`). Not checked on a file of the program.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, check_numbers
from ...bench.io.documents import checked, read_json
from ...bench.io.files import check_name, entries, with_slashes
from ...bench.io.images import ImageInfo, probe_image
from ..clip import CaptureClip
from ..ga.layout import DECLARATION_FILE, HEAD_FILE, Declaration
from ..ga.tracking import TeethPolicy, find_head
from ..ga.transforms import read_rigid
from ..head.arrays import HeadArrays
from ..steps.exclude import exclude_given, exclude_timesteps
from .clip import WHITE, Track, VideoFrame, clip_of_track, coefficients, frame_number, ordered
from .insta import is_insta, read_insta

PARAMETERS = "flame_params.json"
SCALE = 4.0
"""Scale of FLAME in IMavatar's world."""
OLD_SIZE = 512
"""Image size of intrinsics in the older form, pixels."""
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class _Frame:
    file_path: str
    expression: tuple[float, ...]
    pose: tuple[float, ...]
    world_mat: Any = None


@dataclass(frozen=True)
class _Document:
    frames: tuple[_Frame, ...]
    shape_params: tuple[float, ...]
    intrinsics: tuple[float, float, float, float]


def videos(root: Path) -> list[Path]:
    """Folders of a subject's videos: the folder itself, or its subfolders."""
    if _lists_frames(root / PARAMETERS):
        return [root]
    return sorted(file.parent for file in root.glob(f"*/{PARAMETERS}") if _lists_frames(file))


def _lists_frames(path: Path) -> bool:
    """Whether a file of that name is IMavatar's, which lists frames, or damaged; LAM's has arrays by name."""
    if not path.is_file():
        return False
    try:
        content = read_json(path)
    except InputError:
        return True
    return not isinstance(content, dict) or "frames" in content or "expr" not in content


def read_imavatar(root: Path, head: HeadArrays, progress: Progress) -> Track:
    """Read all videos of a subject."""
    folders = videos(root)
    frames: list[VideoFrame] = []
    shape: FloatArray | None = None
    for folder in folders:
        path = folder / PARAMETERS
        document = checked(read_json(path), _Document, path, foreign=True)
        own = _vector(path, "shape_params", document.shape_params, head.shape_basis.shape[2])
        if shape is None:
            shape = own
        elif not np.allclose(shape, own, rtol=0, atol=1e-6):
            expected = (
                f"the identity of {folders[0].name}, as IMavatar tracks all videos of a subject with one"
            )
            remedy = "Track it again with --shape_from, or read the videos one by one."
            raise InputError(path, "shape_params", expected, "another", remedy)
        for index, entry in enumerate(document.frames):
            frames.append(_frame(folder, path, f"frames[{index}]", entry, document.intrinsics, head))
            progress(index + 1, len(document.frames), f"reading {folder.name}")
    assert shape is not None, "found by their parameters"
    files = frozenset(folder / PARAMETERS for folder in folders)
    notes = {"layout": "imavatar", "shape_coefficients": int(np.count_nonzero(shape))}
    return Track(ordered(root, frames), shape, None, files, notes, solid=(0.5, 1.0))


def _frame(
    folder: Path,
    path: Path,
    where: str,
    frame: _Frame,
    intrinsics: tuple[float, float, float, float],
    head: HeadArrays,
) -> VideoFrame:
    image = folder / f"{with_slashes(frame.file_path).removesuffix('.png')}.png"
    number = frame_number(path, f"{where}.file_path", image.stem)
    info = probe_image(image)
    mask = image
    if not info.has_alpha:
        mask = folder / "mask" / image.name
        matte = probe_image(mask)
        if (matte.width, matte.height) != (info.width, info.height):
            expected = f"{info.width}x{info.height} pixels, as its image"
            raise InputError(mask, "", expected, f"{matte.width}x{matte.height}")
    if len(frame.pose) != 15:
        expected = "15 numbers: root, neck, jaw, left and right eye"
        raise InputError(path, f"{where}.pose", expected, f"{len(frame.pose)}")
    turns = _vector(path, f"{where}.pose", frame.pose, 15)
    pose = HeadPose(
        head_model=head.version,
        expression=_vector(path, f"{where}.expression", frame.expression, head.expression_basis.shape[2]),
        rotation=turns[:3],
        neck=turns[3:6],
        jaw=turns[6:9],
        eyes=turns[9:],
        translation=np.zeros(3),
    )
    camera = Camera(
        "0", info.width, info.height, _K(path, intrinsics, info), _world_to_camera(path, where, frame)
    )
    return VideoFrame((path, where), folder.name, number, image, mask, camera, pose)


def _K(path: Path, intrinsics: tuple[float, float, float, float], info: ImageInfo) -> FloatArray:
    values = np.array(intrinsics, np.float64)
    size = np.array([info.width, info.height] * 2, np.float64)
    values = values * size / OLD_SIZE if values[3] > 1 else values * size
    if not (values[0] < 0 < values[1]):
        expected = "a negative and a positive focal length, as IMavatar's preprocessing writes them"
        raise InputError(path, "intrinsics", expected, f"{intrinsics[0]:g} and {intrinsics[1]:g}")
    check_numbers(path, "intrinsics", values, 1e6)
    # The centre of a pixel is at its index plus one half.
    return np.array([[-values[0], 0, values[2] + 0.5], [0, values[1], values[3] + 0.5], [0, 0, 1]])


def _world_to_camera(path: Path, where: str, frame: _Frame) -> FloatArray:
    rows = frame.world_mat
    if isinstance(rows, list) and len(rows) == 3:
        rows = [*rows, [0.0, 0.0, 0.0, 1.0]]
    matrix = _FLIP @ read_rigid(path, f"{where}.world_mat", rows)
    matrix[:3, 3] /= SCALE
    return matrix


def _vector(path: Path, entry: str, values: tuple[float, ...], size: int) -> FloatArray:
    numbers = np.array(values, np.float64)
    check_numbers(path, entry, numbers, MAX_MAGNITUDE)
    return coefficients(path, entry, numbers, size)


def find_videos(root: Path) -> list[Path]:
    """Subjects under ``root``: the folder itself, or its subfolders; an IMavatar subject contains its videos."""
    if is_insta(root) or videos(root):
        return [root]
    if not root.is_dir():
        return []
    below = [path for path in entries(root) if path.is_dir()]
    return [path for path in below if is_insta(path) or (not (path / PARAMETERS).exists() and videos(path))]


def read_video(
    path: str | Path,
    *,
    head: HeadArrays | str | Path | None = None,
    masks: str | Path | None = None,
    regions: str | Path | None = None,
    eyelids: str | Path | None = None,
    subject: str = "",
    teeth: TeethPolicy = "auto",
    background: Sequence[float] | None = None,
    held_out_frames: int | None = None,
    held_out_sequences: Sequence[str] = (),
    exclude: Mapping[int, str] | str | Path | None = None,
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Read a tracked video, or all videos of one subject in IMavatar's layout.

    Timesteps number the frames in the order of their names, one video after the other. Held-out frames of a training
    video become a separate sequence, ``video-held-out``.

    Parameters
    ----------
    head, masks, regions, eyelids : HeadArrays | str | Path | None
        Head model that the video was tracked with, usually FLAME 2020, and the files that belong to it, which are
        found beside it.
    subject : str
        Subject id; "" takes it from ``headbench.json`` or the folder's name.
    teeth : TeethPolicy
        As for the reader ``ga``.
    background : Sequence[float] | None
        (r, g, b) in [0, 1] that straight alpha and masked images are composited on; None takes the
        declared one, else white.
    held_out_frames : int | None
        Number of last frames for self-reenactment. None takes the split of the folder, else 350, or a
        quarter of a video with fewer than 700 frames.
    held_out_sequences : Sequence[str]
        Names of the videos for self-reenactment, instead of the last frames.
    exclude, cache_mb, use_cache : Mapping[int, str] | str | Path | None, float, bool
        As for the reader ``ga``.
    """
    root = Path(os.path.realpath(path))
    declaration = Declaration.read(root)
    asset = _find_head(root, declaration, head, masks=masks, regions=regions, eyelids=eyelids)
    track = _read_track(root, asset, progress)
    subject = check_name(subject or (declaration.subject if declaration else root.name), root, "subject")
    clip = clip_of_track(
        root,
        track,
        asset,
        subject=subject,
        teeth=teeth,
        background=(declaration.background if declaration else WHITE) if background is None else background,
        held_out_frames=held_out_frames,
        held_out_sequences=held_out_sequences,
        files={root / DECLARATION_FILE} if declaration else set(),
        cache_mb=cache_mb,
        use_cache=use_cache,
        progress=progress,
    )
    if declaration and declaration.excluded:
        clip = exclude_timesteps(clip, declaration.excluded, source=root / DECLARATION_FILE)
    return exclude_given(clip, exclude)


def _find_head(
    root: Path,
    declaration: Declaration | None,
    head: HeadArrays | str | Path | None,
    **files: str | Path | None,
) -> HeadArrays:
    if head is None and declaration is None and not (root / HEAD_FILE).exists():
        raise InputError(
            root,
            "head",
            f"the head model that the video was tracked with, or {HEAD_FILE} in the folder",
            "none",
            "Give it as head= (`headbench run`: --head): Metrical Tracker and IMavatar track with FLAME 2020, "
            "generic_model.pkl from https://flame.is.tue.mpg.de.",
        )
    return find_head(root, declaration, head, **files)


def _read_track(root: Path, head: HeadArrays, progress: Progress) -> Track:
    if is_insta(root):
        return read_insta(root, head, progress)
    if videos(root):
        return read_imavatar(root, head, progress)
    expected = f"INSTA's folder (transforms_train.json, flame/exp) or IMavatar's ({PARAMETERS})"
    raise InputError(root, "", expected, "neither")
