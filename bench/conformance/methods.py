"""Check that a method fulfils its contract. An exception of a plug-in is reported as a violation, not raised."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..contracts import Avatar, Clip, Frame, HeadPose, no_progress
from ..engine.config import ResolvedMethod
from ..engine.guard import TrainingView
from ..errors import InputError, UnavailableError
from ..io.files import digest_file


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
