"""Check that a method fulfils its contract. An exception of a plug-in is reported as a violation, not raised."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..contracts import Avatar, ByteArray, Camera, Clip, Frame, HeadPose, Measurement, no_progress
from ..engine.config import ResolvedMethod
from ..engine.scoring import TrainingView, compared_over_time, make_metric
from ..errors import InputError, UnavailableError
from ..io.files import check_name, digest_file
from ..specs import MetricSpec


@contextmanager
def attempt(breaches: list[str], what: str) -> Iterator[None]:
    """Record an exception of the block as a breach: ``what``, the exception and the line that raised it.

    `UnavailableError` is not caught: the plug-in needs something that is not installed.
    """
    try:
        yield
    except UnavailableError:
        raise
    except Exception as error:  # noqa: BLE001 - a plug-in may fail in any way
        breaches.append(f"{what} raised {described(error)}")


def described(error: Exception) -> str:
    """The exception in one line, with the line of code that raised it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message} ({Path(last.filename).name}, line {last.lineno})"


def refusal(call: Callable[[], Any], what: str, *, expected: type[Exception] = InputError) -> Iterator[str]:
    """Record a breach unless ``call`` raises ``expected``."""
    try:
        call()
    except expected:
        return
    except Exception as error:  # noqa: BLE001
        yield f"{what} raised {described(error)} instead of {expected.__name__}"
    else:
        yield f"{what} was accepted instead of raising {expected.__name__}"


def check_method(method: ResolvedMethod, clip: Clip, out: Path, *, device: str = "cpu") -> list[str]:
    """Train a method briefly on ``clip`` and return every breach of the contract found; empty means it conforms.

    Checks: `fit` reads only training images, reports progress, and does not change a finished avatar when
    repeated; `load` returns a bit-identical avatar; frames have the camera's size, finite float32 colours in
    [0, 1] and coverage in [0, 1]; the background is visible where coverage is 0; rendering does not depend on
    earlier renders; files exist; a pose of another head model is refused.

    Parameters
    ----------
    method : ResolvedMethod
        Method with a small budget; the kit fits it once and resumes it once.
    clip : Clip
        Capture with all three splits.
    out : Path
        Empty output folder.
    """
    calls: list[tuple[int, int]] = []

    def record(done: int, total: int, note: str = "") -> None:
        calls.append((done, total))

    settings: dict[str, Any] = {"device": device, "seed": 0}
    instance = method.create()
    avatar: Avatar = instance.fit(TrainingView(clip), out, method.budget, progress=record, **settings)
    breaches: list[str] = []
    if method.spec.presets and not calls:
        breaches.append("fit never reported progress")
    if any(done > total for done, total in calls) or sorted(calls) != calls:
        breaches.append("progress ran backwards or past its total")
    loaded = instance.load(out, device=device)
    breaches += _file_breaches(avatar, out)
    breaches += _render_breaches(avatar, loaded, clip)
    before = {path: digest_file(path) for path in avatar.files()}
    again = method.create().fit(TrainingView(clip), out, method.budget, progress=no_progress, **settings)
    if {path: digest_file(path) for path in again.files()} != before:
        breaches.append("fitting a finished avatar again changed its files")
    return breaches


def _file_breaches(avatar: Avatar, out: Path) -> Iterator[str]:
    files = list(avatar.files())
    if not files:
        yield "files() names no file"
    for path in files:
        if not path.is_file():
            yield f"files() names {path}, which is not there"
        elif out.resolve() not in path.resolve().parents:
            yield f"files() names {path}, which lies outside the avatar's folder"


def _render_breaches(avatar: Avatar, loaded: Avatar, clip: Clip) -> Iterator[str]:
    keys = [*clip.splits["train"][:1], *clip.splits["novel_view"][:1], *clip.splits["self_reenactment"][:1]]
    views = [(clip.cameras[key.camera], clip.poses[key.timestep]) for key in keys]
    first = [avatar.render(camera, pose) for camera, pose in views]
    for (camera, _), frame in zip(views, first):
        yield from _frame_breaches(frame, camera.height, camera.width)
    for (camera, pose), frame in zip(reversed(views), reversed(first)):
        again = loaded.render(camera, pose)
        if not (np.array_equal(again.rgb, frame.rgb) and np.array_equal(again.alpha, frame.alpha)):
            yield "a loaded avatar renders different images if frames are requested in another order"
            break
    camera, pose = views[0]
    black = avatar.render(camera, pose, (0.0, 0.0, 0.0))
    uncovered = black.alpha < 1e-3
    if uncovered.any() and np.abs(black.rgb[uncovered]).max() > 0.01:
        yield "the requested background is not visible where alpha is 0"
    # An avatar without a head model (an image, a folder of frames) has nothing to refuse.
    if hasattr(avatar, "splats"):
        other = replace(pose, head_model="some other model")
        yield from refusal(lambda: avatar.render(camera, other), "a pose of another head model")
    unseen: HeadPose = replace(pose, subject="", timestep=None)
    yield from _frame_breaches(avatar.render(camera, unseen), camera.height, camera.width)


def _frame_breaches(frame: Frame, height: int, width: int) -> Iterator[str]:
    for name, array, shape in (
        ("rgb", frame.rgb, (height, width, 3)),
        ("alpha", frame.alpha, (height, width)),
    ):
        if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != np.float32:
            yield f"{name} is not a float32 numpy array of shape {shape}"
        elif not np.isfinite(array).all():
            yield f"{name} is not finite"
        elif array.min() < 0 or array.max() > 1:
            yield f"{name} leaves [0, 1]: {array.min():.4g} to {array.max():.4g}"


SIZE = (96, 80)
"""Height and width of the test images."""
NOISE = (4.0, 16.0, 64.0)
"""Standard deviations, in levels, of increasing noise."""
TOLERANCE = 1e-4
"""Relative tolerance between single and batched values, since the order of sums may differ."""

Compare = Callable[[ByteArray, ByteArray], float]


def check_metric(spec: MetricSpec) -> list[str]:
    """Try a metric on generated images and return every breach of the contract found.

    Checks for frame metrics: values are finite; equal images have the best value; more noise gives a worse
    one, in the direction that ``higher_is_better`` states; a value depends only on its pair (repeated, in
    threads, in a batch, in another memory layout); inputs are not changed; images of different sizes or
    another type are refused. Regional, temporal, avatar and training metrics are checked by their own
    protocols.

    Raises `UnavailableError` if the metric needs something that is not installed.
    """
    breaches: list[str] = []
    check_name(spec.name, "metric", "name")
    if spec.digits < 0 or not spec.label or not spec.tables:
        breaches.append("label and tables must not be empty, digits not negative")
    metric = make_metric(spec)
    if not callable(metric):
        return [*breaches, f"{spec.implementation} is not callable"]
    if not spec.per_frame:
        check = _training_breaches if spec.kind == "training" else _avatar_breaches
        with attempt(breaches, "measuring"):
            breaches += check(metric, spec)
        return breaches
    compare = compared_over_time(metric, spec.kind)
    for part in (_value_breaches, _repeat_breaches, _input_breaches):
        with attempt(breaches, "comparing two images"):
            breaches += part(compare, spec)
    if hasattr(metric, "batched"):
        with attempt(breaches, "comparing a batch"):
            breaches += _batch_breaches(metric)
    if spec.kind == "regional":
        with attempt(breaches, "comparing regions"):
            breaches += _region_breaches(metric, spec)
    if spec.kind == "face":
        with attempt(breaches, "comparing a face"):
            breaches += _face_breaches(metric)
    return breaches


def picture(seed: int = 0, size: tuple[int, int] = SIZE) -> ByteArray:
    """An (H, W, 3) image with soft shapes and fine structure on white, read-only as those of the harness."""
    generator = np.random.default_rng(seed)
    rows, columns = np.mgrid[0 : size[0], 0 : size[1]] / max(size)
    value = np.ones((*size, 3))
    for _ in range(12):
        centre, radius = generator.uniform(0.1, 0.8, 2), generator.uniform(0.05, 0.25)
        inside = (rows - centre[0]) ** 2 + (columns - centre[1]) ** 2 < radius**2
        stripes = 0.15 * np.sin(2 * np.pi * generator.uniform(4, 20) * (rows + columns))
        value[inside] = (generator.uniform(0.2, 0.8, 3) + stripes[..., None])[inside]
    return _frozen(value * 255)


def _frozen(value: Any) -> ByteArray:
    image = np.rint(np.clip(value, 0, 255)).astype(np.uint8)
    image.setflags(write=False)
    return image


def _noisy(image: ByteArray, sigma: float, seed: int = 1) -> ByteArray:
    return _frozen(image + np.random.default_rng(seed).normal(0, sigma, image.shape))


def _value_breaches(compare: Compare, spec: MetricSpec) -> Iterator[str]:
    truth = picture()
    images = {"equal images": truth} | {f"noise of {s:g} levels": _noisy(truth, s) for s in NOISE}
    images["another image"] = picture(7)
    values = {name: compare(image, truth) for name, image in images.items()}
    for name, value in values.items():
        if not isinstance(value, (int, float, np.number)) or isinstance(value, bool):
            yield f"the value of {name} is a {type(value).__name__}, not a number"
            return
        if not math.isfinite(value):
            yield f"the value of {name} is {value}; a metric must be finite"
            return
    sign = 1 if spec.higher_is_better else -1
    best = values["equal images"]
    for name, value in values.items():
        worse = sign * (best - float(value))
        if worse < 0 or (worse == 0 and name == "another image"):  # a metric may be blind to a little noise
            yield f"higher_is_better is {spec.higher_is_better}, but {name} gives {value:.6g} and equal images {best:.6g}"
            return
    steps = [sign * float(values[f"noise of {s:g} levels"]) for s in NOISE]
    if sorted(steps, reverse=True) != steps:
        yield f"more noise does not give a worse value: {', '.join(f'{sign * s:.6g}' for s in steps)}"


def _repeat_breaches(compare: Compare, spec: MetricSpec) -> Iterator[str]:
    pairs = [(_noisy(picture(seed), 8.0, seed), picture(seed)) for seed in range(6)]
    before = [compare(*pair) for pair in pairs]
    if [compare(*pair) for pair in reversed(pairs)][::-1] != before:
        yield "a value depends on what was compared before"
    with ThreadPoolExecutor(4) as pool:
        if list(pool.map(lambda pair: compare(*pair), pairs * 4)) != before * 4:
            yield "a value differs if several threads compute the metric at the same time"
    image, truth = pairs[0]
    other = np.asfortranarray(np.concatenate([image, image], axis=1))[:, : image.shape[1]]
    if not math.isclose(compare(other, truth), before[0], rel_tol=TOLERANCE):
        yield "a value depends on the memory layout of the image"


def _input_breaches(compare: Compare, spec: MetricSpec) -> Iterator[str]:
    truth = picture()
    image = np.array(_noisy(truth, 8.0))
    kept = image.copy()
    compare(image, truth)
    if not np.array_equal(image, kept):
        yield "the metric changes its input"
    narrow = truth[:, :-8]
    for a, b in ((narrow, truth), (truth, narrow)):
        sizes = f"images of {a.shape[1]}x{a.shape[0]} and {b.shape[1]}x{b.shape[0]} pixels"
        yield from refusal(lambda a=a, b=b: compare(a, b), sizes, expected=Exception)  # type: ignore[misc]
    unfit: Any = np.full(truth.shape, np.nan, np.float32)
    for a, b, name in ((unfit, truth, "image"), (truth, unfit, "ground truth")):
        value = math.nan
        with suppress(Exception):  # any exception is a refusal
            value = float(compare(a, b))
        if math.isfinite(value):
            yield f"a float {name} of NaN gives {value:.6g} instead of an error"


def _batch_breaches(metric: Any) -> Iterator[str]:
    pairs = [(_noisy(picture(seed), 8.0 * seed, seed), picture(seed)) for seed in range(5)]
    values = list(metric.batched(pair for pair in pairs))
    if len(values) != len(pairs):
        yield f"batched gives {len(values)} values for {len(pairs)} pairs"
    elif not np.allclose(values, [metric(*pair) for pair in pairs], rtol=TOLERANCE, atol=1e-6):
        yield "batched gives other values than one pair at a time"


def _region_breaches(metric: Any, spec: MetricSpec) -> Iterator[str]:
    truth = picture()
    image = _noisy(truth, 8.0)
    left = np.zeros(SIZE, np.bool_)
    left[16:64, :40] = True
    masks = {"left": left, "everything": np.ones(SIZE, np.bool_), "nothing": np.zeros(SIZE, np.bool_)}
    values = metric.in_regions(image, truth, masks)
    if set(values) != {"left", "everything"}:
        yield f"in_regions names {', '.join(sorted(values))}; it must name the masks with pixels: left and everything"
        return
    if not all(math.isfinite(value) for value in values.values()):
        yield "a region's value is not finite"
    elif not math.isclose(values["everything"], metric(image, truth), rel_tol=0.05):
        yield "a region that covers the frame is far from the value of the frame"
    fault = np.array(truth)
    fault[16:64, :40] = _noisy(truth, 32.0)[16:64, :40]
    wrong = metric.in_regions(fault, truth, {"left": left, "everything": masks["everything"]})
    sign = 1 if spec.higher_is_better else -1
    if sign * (wrong["everything"] - wrong["left"]) <= 0:
        yield "a fault inside a region does not make it worse than the frame"
    small = {"left": left[:, :-8]}
    call: Callable[[], Any] = lambda: metric.in_regions(image, truth, small)
    yield from refusal(call, "a mask of another size", expected=Exception)


def _face_breaches(metric: Any) -> Iterator[str]:
    truth = picture()
    face = np.zeros(SIZE, np.bool_)
    face[16:64, 8:64] = True
    inside, outside = (np.where(part[..., None], _noisy(truth, 32.0), truth) for part in (face, ~face))
    equal, wrong, beside = (metric(image, truth, face) for image in (truth, inside, outside))
    if abs(wrong - equal) <= abs(beside - equal):
        yield "a fault in the face does not change the value more than one beside it"
    yield from refusal(
        lambda: metric(truth, truth, face[:, :-8]), "a mask of another size", expected=Exception
    )


class _GreyAvatar:
    """Renders one grey level, as input for metrics."""

    def __init__(self, folder: Path):
        self._file = folder / "level.txt"
        self._file.write_text("0.5")

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        rgb = np.full((camera.height, camera.width, 3), 0.5, np.float32)
        return Frame(rgb, np.ones(rgb.shape[:2], np.float32))

    def files(self) -> Sequence[Path]:
        return [self._file]


def _avatar_breaches(metric: Any, spec: MetricSpec) -> Iterator[str]:
    zero = np.zeros(3)
    poses = [HeadPose("kit", np.full(4, i), zero, zero, zero, np.zeros(6), zero) for i in range(2)]
    cameras = [Camera(str(i), 32, 24, np.diag([30.0, 30.0, 1.0]), np.eye(4)) for i in range(2)]
    with TemporaryDirectory() as folder:
        try:
            measured = metric(_GreyAvatar(Path(folder)), list(zip(cameras, poses)))
        except UnavailableError:
            return  # the metric does not apply to this minimal avatar, and gives the reason
        yield from _measurement_breaches(measured, spec, detail_may_lack=True)


def _training_breaches(metric: Any, spec: MetricSpec) -> Iterator[str]:
    record = {"seconds": 90.0, "interruptions": 0, "peak_memory_bytes": 2e9, "memory_before_bytes": 1e9}
    try:
        yield from _measurement_breaches(metric(record), spec)
    except UnavailableError:
        pass  # needs values that only its own method records
    yield from refusal(lambda: metric({}), "a record without any entry", expected=UnavailableError)


def _measurement_breaches(measured: Any, spec: MetricSpec, detail_may_lack: bool = False) -> Iterator[str]:
    if not isinstance(measured, Measurement) or not isinstance(measured.details, Mapping):
        yield f"the metric returns a {type(measured).__name__}, not a Measurement"
        return
    numbers = {"value": measured.value, **measured.details}
    for name, value in numbers.items():
        if not isinstance(value, (int, float, np.number)) or not math.isfinite(value):
            yield f"{name} of the measurement is {value!r}, not a finite number"
    if spec.detail and spec.detail not in measured.details and not detail_may_lack:
        yield f"the measurement has no detail {spec.detail!r}, which the specification names"
