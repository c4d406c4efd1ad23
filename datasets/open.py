"""Opens captures of any layout; the reader is found in the registry by name or by the folder's content.

Recognise other formats than captures and suggest a conversion, for error messages.
"""

from __future__ import annotations

import inspect
import os
import shlex
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from ..bench.contracts import Progress, no_progress
from ..bench.errors import InputError
from ..bench.registry import finds, get, readers, resolve
from ..bench.specs import DatasetSpec
from .clip import CaptureClip, as_capture
from .ga.layout import ALL_FRAMES_FILE, SPLIT_FILES

VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
ARCHIVES = (".7z", ".bz2", ".gz", ".rar", ".tar", ".tgz", ".xz", ".zip", ".zst")
IMAGES = (".bmp", ".exr", ".heic", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
HEADS = (".npz", ".pkl")
LOOKED_AT = 2000
"""Maximum number of entries of a folder that are inspected."""

RIG = (
    "`headbench track` makes a capture of a video of one camera; for several cameras fit FLAME with VHAP, and give the "
    "folder of its export in GaussianAvatars' layout."
)
MONOCULAR = (
    "The reader monocular reads complete folders: the output of INSTA's generate.sh for Metrical Tracker "
    "(transforms_train.json, flame/exp, meshes, canonical.obj), and IMavatar's flame_params.json with its list of frames. "
    "A motion of LAM (flame_params.json of arrays) is for `headbench drive`."
)


class Foreign(NamedTuple):
    """The format found instead of a capture, and the remedy."""

    found: str
    remedy: str


def describe(path: Path) -> Foreign:
    """Recognise the format at an existing ``path`` by file names; no file is opened."""
    return _folder(path) if path.is_dir() else _file(path)


def frame_route(frame: Mapping[str, Any]) -> str:
    """Remedy for a frame of a transforms JSON without tracked parameters; "" for a frame with them."""
    if "flame_param_path" in frame:
        return ""
    if "mesh_path" in frame or "exp_path" in frame:
        return "Frames with meshes and coefficients are INSTA's: with flame/exp beside them the reader monocular reads them."
    return f"It has only cameras, like the JSONs of nerfstudio and instant-ngp. {RIG}"


def _file(path: Path) -> Foreign:
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        return Foreign("a video", _track(_quoted(path)))
    if suffix in IMAGES:
        return Foreign(
            "an image", "An avatar needs a video of the person: `headbench track` makes a capture of one."
        )
    if suffix in ARCHIVES:
        return Foreign("an archive", "Unpack it and give the folder.")
    if path.name in (*SPLIT_FILES.values(), ALL_FRAMES_FILE):
        return Foreign("one of its files", f"Give its folder: {_quoted(path.parent)}")
    if suffix in HEADS:
        return Foreign("a file", "A head model is given as --head, beside the folder of a capture.")
    return Foreign("a file", "")


def _folder(path: Path) -> Foreign:
    with os.scandir(path) as listing:
        names = sorted(entry.name for entry in islice(listing, LOOKED_AT) if not entry.name.startswith("."))
    if not names:
        return Foreign("an empty folder", "")
    for recognise in (_run, _captures_below, _nersemble, _tracked, _cameras_only, _unprepared, _nested):
        layout = recognise(path, names)
        if layout is not None:
            return layout
    some = ", ".join(name[:40] for name in names[:5])
    return Foreign(some + (", ..." if len(names) > 5 else ""), "")


def _run(path: Path, names: list[str]) -> Foreign | None:
    if "run.json" not in names:
        return None
    inside = path / "capture"
    remedy = f"Give its capture: {_quoted(inside)}" if inside.is_dir() else "Its run.json names the capture."
    return Foreign("the folder of a run", remedy)


def _captures_below(path: Path, names: list[str]) -> Foreign | None:
    files = (*SPLIT_FILES.values(), ALL_FRAMES_FILE)
    below = [name for name in names if any((path / name / file).is_file() for file in files)]
    if below:
        return Foreign(
            "captures one folder below",
            f"Give one of them, such as {_quoted(path / below[0])}; several subjects are read together as UNION... folders.",
        )
    parents = [name for name in names if any((path / name).glob(f"UNION*/{SPLIT_FILES['train']}"))]
    return Foreign("captures two folders below", f"Give {_quoted(path / parents[0])}") if parents else None


def _nersemble(path: Path, names: list[str]) -> Foreign | None:
    from .nersemble.names import is_subject  # only for what is no capture

    marks = ("sequences", "calibration", "camera_params.json")
    if any(mark in names for mark in marks) and is_subject(path.resolve().name):
        root, subjects = path.resolve().parent, [path.resolve().name]
    else:
        root, subjects = path, [name for name in names if is_subject(name)]
        shared = "camera_params" in names or any(name.startswith("sequence_") for name in names)
        if not shared and not any((path / name / mark).exists() for name in subjects for mark in marks):
            return None
    some = ",".join(subjects[:3])
    command = f"headbench prepare nersemble --root {_quoted(root)} --tracking VHAP --out captures"
    command += f" --subjects {some}" if some else ""
    return Foreign("a raw NeRSemble recording", f"Make captures from it: {command}")


def _nested(path: Path, names: list[str]) -> Foreign | None:
    """A folder that contains only a folder, as extracted archives often do."""
    inside = path / names[0]
    if len(names) > 1 or not inside.is_dir():
        return None
    return Foreign(f"one folder, {names[0][:40]}", f"Give the folder that holds {SPLIT_FILES['train']}.")


def _tracked(path: Path, names: list[str]) -> Foreign | None:
    """Tracking results of other toolkits, and trained models."""
    known: tuple[tuple[str, str, Callable[[str], bool]], ...] = (
        (
            "VHAP's tracking before its export",
            "Export it in GaussianAvatars' layout and give the folder of the export.",
            lambda name: name.startswith("tracked_flame_params") or name == "keyframes_loop",
        ),
        (
            "a model trained by 3D Gaussian splatting or GaussianAvatars",
            "Give the capture it was trained on; `headbench import ga` reads a GaussianAvatars PLY.",
            lambda name: name in ("point_cloud", "point_cloud.ply", "cfg_args"),
        ),
        (
            "flame_params.json of IMavatar, PointAvatar or LAM",
            MONOCULAR,
            lambda name: name == "flame_params.json" or (path / name / "flame_params.json").is_file(),
        ),
        (
            "the files of Metrical Tracker or Pixel3DMM (checkpoint/*.frame)",
            f"Make a capture from them: headbench import tracking {_quoted(path)} --head FLAME2020/generic_model.pkl --out capture",
            lambda name: name == "checkpoint" and any((path / name).glob("*.frame")),
        ),
        (
            "a capture of INSTA or its Metrical Tracker",
            MONOCULAR,
            lambda name: name in ("canonical.obj", "checkpoint", "meshes"),
        ),
        (
            "a capture of Gaussian Head Avatar",
            "No reader reads it; prepare the NeRSemble recording from which it was made.",
            lambda name: name == "params" and {"images", "cameras"} <= set(names),
        ),
    )
    return next((Foreign(what, way) for what, way, fits in known if any(map(fits, names))), None)


def _cameras_only(path: Path, names: list[str]) -> Foreign | None:
    models = {"cameras.bin", "cameras.txt", "database.db"}
    if not models & set(names) and "sparse" not in names and not (path / "colmap").is_dir():
        return None
    remedy = f"COLMAP gives cameras and no tracked head; the reader colmap reads images and model with flame_param beside them. {RIG}"
    return Foreign("a COLMAP dataset", remedy)


def _unprepared(path: Path, names: list[str]) -> Foreign | None:
    for what, suffixes in (("videos", VIDEOS), ("images", IMAGES), ("archives", ARCHIVES)):
        count = sum(name.lower().endswith(suffixes) or name == what for name in names)
        if 2 * count > len(names):
            inside = path / what if (path / what).is_dir() else path
            first = next((n.name for n in sorted(inside.iterdir()) if n.name.lower().endswith(suffixes)), "")
            if what == "archives":
                way = "Unpack them and give the folder."
            elif what == "videos":
                way = f"Of one camera: {_track(_quoted(inside / first))} {RIG}"
            else:
                pattern = _quoted(inside / f"*{Path(first).suffix}")
                join = f"ffmpeg -framerate 25 -pattern_type glob -i {pattern} -c:v libx264 -qp 0 video.mp4"
                way = f"Frames of one camera: {join}, then {_track('video.mp4')} {RIG}"
            return Foreign(f"a folder of {what}", way)
    return None


def _track(video: str) -> str:
    return f"headbench track {video} --out capture makes a capture of one person."


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def find_reader(path: str | PathLike[str], name: str = "") -> DatasetSpec:
    """The reader ``name``, see `registry.get`; without a name ga, unless only another one finds captures under ``path``."""
    if name:
        spec: DatasetSpec = get("datasets", name)
        return spec
    root = Path(path)
    specs = readers()
    expected = f"a capture that a reader knows ({', '.join(specs)})"
    if not root.exists():
        raise InputError(root, "", expected, "no such file or folder")
    ga = specs.get("ga")
    fitting = [ga] if ga and finds(ga, root) else [spec for spec in specs.values() if finds(spec, root)]
    if not fitting:
        raise InputError(root, "", expected, *describe(root))
    if len(fitting) > 1:
        names = ", ".join(spec.name for spec in fitting)
        found = f"one for {names}"
        raise InputError(root, "", "a capture that one reader knows", found, "Choose with --reader.")
    return fitting[0]


def open_clips(
    path: str | PathLike[str],
    reader: str = "",
    *,
    wishes: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress = no_progress,
) -> Iterator[CaptureClip]:
    """Read every capture under a folder, one after the other.

    ``reader``: See `find_reader`. ``wishes``: Settings such as ``leaks`` that are passed to readers that have them and
    ignored otherwise. ``settings``: Settings of the reader.
    """
    from ..bench.engine.captures import found_captures  # slow to import

    spec = find_reader(path, reader)
    parameters = inspect.signature(resolve(spec.implementation)).parameters
    given = {key: value for key, value in (wishes or {}).items() if key in parameters}
    given |= settings or {}
    for _, read in found_captures(spec, Path(path), given):
        yield as_capture(read(progress))


def open_clip(path: str | PathLike[str], reader: str = "", **options: Any) -> CaptureClip:
    """Read the one capture at ``path``; parameters and errors as of `open_clips`."""
    spec = find_reader(path, reader)
    captures = resolve(spec.find)(Path(path)) if spec.find else [Path(path)]
    if len(captures) > 1:
        names = ", ".join(Path(one).name for one in captures)
        raise InputError(path, "", "one capture", names, "Name one capture.")
    return next(open_clips(path, reader, **options))
