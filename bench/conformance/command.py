"""``headbench doctor check``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, get_args

import numpy as np
import tyro

from ..comparison import DemoConfig
from ..configuration import build_arguments, parse_assignments
from ..contracts import Camera, Clip, FrameKey, HeadAsset, HeadPose, Progress, TaskName, no_progress
from ..engine.adaptation import MethodNeeds, adapt
from ..engine.captures import HARNESS, found_captures
from ..engine.config import ResolvedMethod, RunConfig, resolve_method
from ..errors import InputError
from ..io.files import check_name, to_jsonable
from ..machine import check_device
from ..options import DependentOptions
from ..registry import SPEC_TYPES, Group, discover, get, resolve
from ..specs import CommandResult, DatasetSpec, MethodSpec, MetricSpec, command
from .methods import attempt, check_method, check_metric, refusal

SPLITS = ("train", *get_args(TaskName))
COPIED_BYTES = 256e6
"""Largest capture that is copied to check that its fingerprint does not depend on its location."""
RIGID = 1e-4
Read = Callable[[Path], list[Clip]]
FRAMES = 4
"""Frames of each split that are read, evenly spaced."""


def check_reader(spec: DatasetSpec, path: Path, settings: Mapping[str, Any] | None = None) -> list[str]:
    """Read a capture and return every breach of the contract found; empty means the reader conforms.

    Checks: `find` lists paths that `read` accepts; the clip has the attributes of `Clip` with the stated
    shapes, types and units; keys, cameras and poses refer to each other; splits are disjoint and hold out
    cameras and timesteps; images are 8-bit, of the camera's size, and identical when read again; the
    fingerprint is the same when the capture is read again and from another location; other paths raise an
    `InputError`.

    Parameters
    ----------
    path : Path
        Capture in the reader's layout, or a path that its ``find`` accepts. Small captures are copied
        once.
    """
    if not spec.reads:
        raise InputError("check-plugin", spec.name, "a reader", "one that makes captures")
    if not path.exists():
        raise InputError(path, "--data", "a capture in the reader's layout", "no such file or folder")
    build_arguments(resolve(spec.implementation), settings or {}, "reader_settings", harness=HARNESS)

    def read(root: Path) -> list[Clip]:
        return [read_one(no_progress) for _, read_one in found_captures(spec, root, settings or {})]

    breaches: list[str] = []
    clips: list[Clip] = []
    with attempt(breaches, "reading the capture"):
        paths = resolve(spec.find)(path) if spec.find else [path]
        if not paths:
            return [f"find lists nothing under {path}"]
        breaches += [f"find lists {one}, which is not there" for one in paths if not Path(one).exists()]
        clips = read(path)
    for clip in clips:
        with attempt(breaches, f"checking the clip {getattr(clip, 'subject', '?')!r}"):
            breaches += check_clip(clip)
    if clips and not breaches:
        with attempt(breaches, "reading the capture again"):
            breaches += _repeated(read, path, clips)
    breaches += _refusals(read)
    return breaches


def check_clip(clip: Clip) -> list[str]:
    """Return every breach of `Clip` by one clip."""
    if not isinstance(clip, Clip):
        missing = [name for name in dir(Clip) if not name.startswith("_") and not hasattr(clip, name)]
        return [f"the clip has no {', '.join(missing)}"]
    breaches: list[str] = []
    for check in (_subject, _head, _cameras, _poses, _splits, _excluded, _record, _images):
        with attempt(breaches, f"checking the clip's {check.__name__.strip('_')}"):
            breaches += check(clip)
    return breaches


def _shaped(name: str, array: Any, shape: tuple[int | None, ...], kind: type = np.floating) -> Iterator[str]:
    """Breaches of an array's type, shape (None: any length) and finiteness."""
    if not isinstance(array, np.ndarray):
        yield f"{name} is a {type(array).__name__}, not a numpy array"
    elif array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape)):
        yield f"{name} has shape {array.shape}, expected {shape}".replace("None", "any")
    elif not np.issubdtype(array.dtype, kind):
        yield f"{name} has dtype {array.dtype}, expected {kind.__name__}"
    elif kind is np.floating and not np.isfinite(array).all():
        yield f"{name} is not finite"


def _subject(clip: Clip) -> Iterator[str]:
    sequences = {key.sequence for keys in clip.splits.values() for key in keys}
    for what, names in (("subject", {clip.subject}), ("camera", set(clip.cameras)), ("sequence", sequences)):
        for name in names:
            try:
                check_name(name, "clip", what)
            except (InputError, TypeError) as error:
                yield f"the {what} {name!r} cannot name a folder: {error}"


def _head(clip: Clip) -> Iterator[str]:
    head = clip.head
    if not isinstance(head, HeadAsset):
        yield "head is no HeadAsset: methods that bind to a mesh cannot be trained"
        return
    vertices, directions = len(head.template), head.shape_basis.shape[-1]
    joints = len(head.joint_regressor)
    wanted: dict[str, tuple[tuple[int | None, ...], type]] = {
        "template": ((vertices, 3), np.floating),
        "faces": ((None, 3), np.integer),
        "shape_basis": ((vertices, 3, directions), np.floating),
        "expression_basis": ((vertices, 3, None), np.floating),
        "pose_basis": ((vertices, 3, 9 * (joints - 1)), np.floating),
        "joint_regressor": ((joints, vertices), np.floating),
        "skinning_weights": ((vertices, joints), np.floating),
        "parents": ((joints,), np.integer),
    }
    breaches = [b for name, w in wanted.items() for b in _shaped(f"head.{name}", getattr(head, name), *w)]
    yield from breaches
    yield from _shaped("shape", clip.shape, (directions,))
    yield from _shaped("static_offset", clip.static_offset, (vertices, 3))
    if breaches:
        return
    if head.faces.min() < 0 or head.faces.max() >= vertices:
        yield "head.faces names vertices that are not there"
    if np.abs(head.skinning_weights.sum(1) - 1).max() > 1e-3:
        yield "rows of head.skinning_weights do not add up to 1"
    if head.parents[0] != -1:
        yield "head.parents[0] is not -1, the mark of the root"


def _cameras(clip: Clip) -> Iterator[str]:
    if not clip.cameras:
        yield "there is no camera"
    for name, camera in clip.cameras.items():
        if not isinstance(camera, Camera):
            yield f"camera {name} is a {type(camera).__name__}, not a Camera"
            continue
        where = f"camera {name}"
        if camera.id != name:
            yield f"{where} has the id {camera.id!r}"
        if min(camera.width, camera.height) < 1:
            yield f"{where} has the size {camera.width}x{camera.height}"
        bad = [*_shaped(f"K of {where}", camera.K, (3, 3))]
        bad += _shaped(f"world_to_camera of {where}", camera.world_to_camera, (4, 4))
        yield from bad
        if bad:
            continue
        if min(camera.K[0, 0], camera.K[1, 1]) <= 0 or camera.K[2].tolist() != [0, 0, 1]:
            yield f"K of {where} is no matrix of positive focal lengths with the last row 0 0 1"
        turn = camera.world_to_camera[:3, :3]
        off = np.abs(turn @ turn.T - np.eye(3)).max()
        if off > RIGID or np.linalg.det(turn) < 0 or camera.world_to_camera[3].tolist() != [0, 0, 0, 1]:
            yield f"world_to_camera of {where} is no rigid motion"


def _poses(clip: Clip) -> Iterator[str]:
    versions = {pose.head_model for pose in clip.poses.values()}
    if isinstance(clip.head, HeadAsset) and versions - {clip.head.version}:
        yield f"poses are of {', '.join(map(str, versions))}, the head model is {clip.head.version}"
    for timestep, pose in clip.poses.items():
        if not isinstance(pose, HeadPose):
            yield f"the pose of timestep {timestep} is a {type(pose).__name__}, not a HeadPose"
            return
        where = f"of the pose of timestep {timestep}"
        directions = clip.head.expression_basis.shape[-1] if isinstance(clip.head, HeadAsset) else None
        parts: dict[str, int | None] = {"expression": directions, "rotation": 3, "neck": 3, "jaw": 3}
        parts |= {"eyes": 6, "translation": 3} | ({} if pose.eyelids is None else {"eyelids": 2})
        breaches = [
            b for n, size in parts.items() for b in _shaped(f"{n} {where}", getattr(pose, n), (size,))
        ]
        if (pose.subject, pose.timestep) != (clip.subject, timestep):
            breaches.append(f"subject and timestep {where} are {pose.subject!r} and {pose.timestep}")
        if breaches:
            yield from breaches
            return  # the other parameters are the same


def _splits(clip: Clip) -> Iterator[str]:
    splits = clip.splits
    missing = [name for name in SPLITS if name not in splits]
    if missing:
        yield f"splits lack {', '.join(missing)}"
        return
    if not splits["train"]:
        yield "the split train is empty"
    everything = [key for name in splits for key in splits[name]]
    if not all(isinstance(key, FrameKey) for key in everything):
        yield "splits hold other things than FrameKeys"
        return
    if len(set(everything)) != len(everything):
        yield "a frame is in two splits, or twice in one"
    for what, stray in (
        ("subject", {key.subject for key in everything} - {clip.subject}),
        ("camera", {key.camera for key in everything} - set(clip.cameras)),
        ("timestep", {key.timestep for key in everything} - set(clip.poses)),
    ):
        if stray:
            yield f"splits name a {what} that the clip does not have: {min(map(str, stray))}"
    if len({(key.sequence, key.timestep) for key in everything}) != len({key.timestep for key in everything}):
        yield "a timestep is in two sequences; timesteps are unique within a clip"
    seen, views = ({getattr(key, part) for key in splits["train"]} for part in ("timestep", "camera"))
    if seen & {key.timestep for key in splits["self_reenactment"]}:
        yield "self_reenactment has timesteps that are trained on"
    if views & {key.camera for key in splits["novel_view"]}:
        yield "novel_view has cameras that are trained on"


def _excluded(clip: Clip) -> Iterator[str]:
    used = {key for keys in clip.splits.values() for key in keys}
    if used & set(clip.excluded):
        yield "an excluded frame is in a split"
    if not all(isinstance(reason, str) and reason for reason in clip.excluded.values()):
        yield "a frame is excluded without a reason"


def _record(clip: Clip) -> Iterator[str]:
    yield from _shaped("background", np.asarray(clip.background), (3,))
    if np.min(clip.background) < 0 or np.max(clip.background) > 1:
        yield "background leaves [0, 1]"
    if not isinstance(clip.fingerprint, str) or not clip.fingerprint:
        yield "fingerprint is no text"
    try:
        json.dumps([*clip.steps], default=to_jsonable)
    except TypeError as error:
        yield f"steps cannot be written as JSON: {error}"


def _images(clip: Clip) -> Iterator[str]:
    keys = [keys[i] for keys in clip.splits.values() for i in _spread(len(keys))]
    first = {key: np.array(clip.image(key)) for key in keys}
    has_mask = {clip.mask(key) is not None for key in keys}
    if len(has_mask) > 1:
        yield "some frames have a mask and others none"
    for key in reversed(keys):
        camera, image, mask = clip.cameras[key.camera], clip.image(key), clip.mask(key)
        yield from _shaped(f"image of {key}", image, (camera.height, camera.width, 3), np.uint8)
        if mask is not None:
            yield from _shaped(f"mask of {key}", mask, (camera.height, camera.width), np.uint8)
        if not np.array_equal(image, first[key]):
            yield f"the image of {key} differs when frames are asked for in another order"
        if image.flags.writeable:
            image[:] = 255 - image
            if not np.array_equal(clip.image(key), first[key]):
                yield f"the image of {key} can be changed by who reads it; give a copy or a read-only array"
                return
    unknown = keys[0]._replace(camera="no such camera")
    yield from refusal(lambda: clip.image(unknown), "a frame that the clip does not have", expected=Exception)


def _spread(count: int) -> list[int]:
    return sorted({*np.linspace(0, count - 1, FRAMES).astype(int).tolist()}) if count else []


def _repeated(read: Read, path: Path, clips: Sequence[Clip]) -> Iterator[str]:
    """Violations found by reading the capture again, here and from another location."""
    before = [clip.fingerprint for clip in clips]
    if [clip.fingerprint for clip in read(path)] != before:
        yield "the fingerprint differs when the capture is read again"
        return
    files = [file for file in path.rglob("*") if file.is_file()] if path.is_dir() else [path]
    if sum(file.stat().st_size for file in files) > COPIED_BYTES:
        return
    with TemporaryDirectory() as folder:
        elsewhere = Path(folder) / path.resolve().name
        copy = shutil.copytree if path.is_dir() else shutil.copyfile
        copy(path, elsewhere)
        if [clip.fingerprint for clip in read(elsewhere)] != before:
            yield "the fingerprint differs when the capture lies in another folder"


def _refusals(read: Read) -> Iterator[str]:
    with TemporaryDirectory() as folder:
        root = Path(folder)
        (root / "empty").mkdir()
        (root / "text.txt").write_text("no capture\n")
        cases = {
            "nothing": "a path that does not exist",
            "empty": "an empty folder",
            "text.txt": "a text file",
        }
        for name, what in cases.items():
            yield from refusal(lambda name=name: read(root / name), what)  # type: ignore[misc]


@dataclass(frozen=True)
class CheckPluginSettings:
    """Test a method, a reader or a metric and list every violation of its contract.

    Exit code 0: it conforms; 1: it does not; 2: wrong usage, or the plug-in cannot be imported.
    """

    plugin: tyro.conf.Positional[str]
    """The plug-in: "package.module:SPEC", or a name that `headbench list` shows."""

    kind: Literal["methods", "datasets", "metrics"] | None = None
    """Kind of the plug-in, if several kinds have this name."""

    data: str | None = None
    """Capture: for a reader one in its layout (required); for a method by default a tiny synthetic one, made by the command."""

    reader: str = ""
    """Which reader opens --data for a method; default: the one that finds it."""

    preset: str | None = None
    """Preset of the method; default: smoke if it has that, else its first."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """A setting of the method or reader, such as `budget.iterations=5`; repeatable."""

    device: str = "cpu"
    """Where the method trains."""

    dependent = (DependentOptions(("reader",), "data"),)


KINDS: dict[Group, str] = {"methods": "method", "datasets": "reader", "metrics": "metric"}
TIMESTEPS = 4  # of the generated capture


@command("doctor check", group="validate")
def check_plugin(settings: CheckPluginSettings, progress: Progress = no_progress) -> CommandResult:
    """Check a method, reader or metric against its contract."""
    spec, kind = _find(settings)
    values = parse_assignments(settings.set)
    breaches: list[str] = []
    if isinstance(spec, MethodSpec):
        breaches = _check_method(spec, settings, values, progress)
    elif isinstance(spec, DatasetSpec):
        if settings.data is None:
            raise InputError("command line", "--data", "a capture in the layout of the reader", "none")
        breaches = check_reader(spec, Path(settings.data), values)
    else:
        if values:
            raise InputError("command line", "--set", "no settings: a metric has none", "a setting")
        breaches = check_metric(spec)
    breaches = list(dict.fromkeys(breaches))  # several checks may find the same fault
    verdict = f"{spec.name}: a {kind} that keeps its contract"
    if breaches:
        count = "1 breach" if len(breaches) == 1 else f"{len(breaches)} breaches"
        title = f"{spec.name}: {count} of the contract of a {kind}"
        verdict = "\n".join([title, *(f"- {breach}" for breach in breaches)])
    return CommandResult(verdict, {"name": spec.name, "kind": kind, "breaches": breaches}, not breaches)


def _find(settings: CheckPluginSettings) -> tuple[MethodSpec | DatasetSpec | MetricSpec, str]:
    """The spec named by the settings, and its kind."""
    groups = [group for group in KINDS if settings.kind in (None, group)]
    name = settings.plugin
    if ":" in name:
        spec: Any = resolve(name)
        groups = [group for group in groups if isinstance(spec, SPEC_TYPES[group])]
        if not groups:
            expected = "a MethodSpec, a DatasetSpec or a MetricSpec"
            raise InputError("command line", name, expected, f"a {type(spec).__name__}")
    elif len(groups) > 1:
        groups = [group for group in groups if name in discover(group)]
        if not groups:
            expected = 'a name that `headbench list` shows for methods, datasets or metrics, or "module:SPEC"'
            raise InputError("command line", "plugin", expected, repr(name))
        if len(groups) > 1:
            expected = f"--kind, one of {', '.join(groups)}"
            raise InputError("command line", name, expected, "a name that they share")
    return get(groups[0], name), KINDS[groups[0]]


def _check_method(
    spec: MethodSpec, settings: CheckPluginSettings, values: dict[str, Any], progress: Progress
) -> list[str]:
    preset = settings.preset or ("smoke" if "smoke" in spec.presets else next(iter(spec.presets), "smoke"))
    method = resolve_method(spec, preset, values)
    check_device(settings.device)
    breaches: list[str] = []
    with TemporaryDirectory() as folder:
        clip = _adapted(_clip(settings, Path(folder), progress), method, Path(folder))
        with attempt(breaches, "training or rendering"):
            breaches += check_method(method, clip, Path(folder) / "avatar", device=settings.device)
    return breaches


def _clip(settings: CheckPluginSettings, folder: Path, progress: Progress) -> Clip:
    from ..engine import captures  # slow to import

    data = settings.data
    if data is None:
        tiny = DemoConfig(out=str(folder), preset="smoke", timesteps=TIMESTEPS)
        resolve(get("datasets", "synthetic").implementation)(**tiny.capture_arguments(), progress=progress)
        data = str(tiny.capture_folder)
    reader = settings.reader or captures.reader_of(data)
    return captures.open_clips(RunConfig(data, str(folder / "run"), reader=reader))[0]


def _adapted(clip: Clip, method: ResolvedMethod, folder: Path) -> Clip:
    """The clip adapted to the method, as in a run."""
    return adapt(clip, MethodNeeds.of(method.spec), {}, folder / "adapted").clip
