"""``headbench drive``."""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Progress, no_progress
from ...bench.engine.adaptation import AdaptedClip, MethodNeeds, apply, plan
from ...bench.engine.stored import open_avatar
from ...bench.errors import InputError
from ...bench.io.files import check_kind, check_output_folder, check_writable, write_json
from ...bench.io.lock import locked
from ...bench.io.video import ENCODINGS, browser_encoder
from ...bench.specs import CommandResult
from ..head.subject import resting
from ..video.decode import SUFFIXES
from .formats import read_signal
from .measure import DrivenMeasures
from .output import REST, Renderer, canonical, write_driven_capture, write_driven_video
from .scene import SEQUENCE, AvatarScene, make_scene
from .settings import DriveSettings
from .signal import DrivingSignal, SignalRequest
from .transfer import Transferred, head_motion, smoothed, transfer, window_length

RESULT_FILE = "drive.json"


def drive_avatar(settings: DriveSettings, progress: Progress = no_progress) -> CommandResult:
    """Drive a stored avatar; see the settings.

    Raises `InputError` before any rendering for an avatar, a signal, a map or a capture that cannot be read or do not fit.
    """
    out = Path(settings.out)
    is_video = out.suffix.lower() in ENCODINGS
    with ExitStack() as stack:
        if is_video:
            browser_encoder(out)
            check_writable(out, "--out")
        elif out.suffix.lower() in SUFFIXES:
            raise InputError(
                "command line", "--out", f"a folder, or a file in {', '.join(ENCODINGS)}", out.name
            )
        else:
            check_output_folder(out)
            check_kind(out, "captures")
            stack.enter_context(locked(out))
        stored = open_avatar(Path(settings.avatar), settings.method)
        scene = make_scene(settings, stored, progress)
        sizes = {(camera.width, camera.height) for camera in scene.clip.cameras.values()}
        if is_video and any(side % 2 for size in sizes for side in size):
            remedy = "Write a folder, or leave out --capture."
            shown = " and ".join(f"{width}x{height}" for width, height in sizes)
            raise InputError("command line", "--capture", "a camera of even size, for a video", shown, remedy)
        start = time.perf_counter()
        request = SignalRequest(
            Path(settings.signal),
            scene.head,
            signal_head=settings.signal_head,
            map=settings.map,
            sequence=settings.sequence,
            options=settings,
            progress=progress,
        )
        signal = read_signal(request, settings.form)
        window_length(len(signal.poses), settings.smooth, settings.fps)
        found = transfer(signal, scene.head, settings.neutral, progress)
        moving = head_motion(found.poses, settings.still_head)
        driven = smoothed(moving, settings.smooth, settings.fps)
        transfer_ms = 1e3 * (time.perf_counter() - start) / len(driven)
        data = measured(settings, scene, signal, found, (moving, driven))
        data["transfer_ms"] = round(transfer_ms, 2)
        poses = dict(enumerate(scene.placed([*driven, canonical(scene.head)])))
        sequences = dict.fromkeys(poses, SEQUENCE) | {len(driven): REST}
        if is_video:
            poses.pop(len(driven))
        clip = scene.driven(poses, sequences)
        needs = MethodNeeds.of(stored.method.spec)
        adaptation = plan(clip, needs, stored.heads)
        avatar = stored.load(settings.device)
        kept = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        form = AdaptedClip(clip) if adaptation is None else apply(adaptation, needs, kept, "adapting")
        renderer = Renderer(avatar, clip, form, progress)
        written = out
        if is_video:
            write_driven_video(out, renderer, clip, settings.fps)
        else:
            written = write_driven_capture(out, renderer, clip)
        data |= {
            "render_ms": round(1e3 * float(np.median(renderer.seconds)), 2),
            "written": written.as_posix(),
        }
        if not is_video:
            write_json(out / RESULT_FILE, data)
    return CommandResult(report_text(data), data)


def measured(
    settings: DriveSettings,
    scene: AvatarScene,
    signal: DrivingSignal,
    found: Transferred,
    motion: tuple[Any, Any],
) -> dict[str, Any]:
    """Measures of the driven poses as plain values, and the channels of the signal that drive nothing.

    ``motion`` has the poses before and after smoothing.
    """
    measures = DrivenMeasures(scene.head, scene.clip.shape, scene.clip.static_offset)
    before, after = motion
    reference = settings.neutral or 0
    gaps = measures.lip_distances_mm([resting(scene.head), *after])
    return {
        "signal": settings.signal,
        "format": signal.form,
        "frames": len(after),
        "head_models": [signal.head.version, scene.head.version],
        "refit_residual_mm": _rounded(found.residual_mm),
        "jitter_mm": {
            "before": _rounded(measures.jitter_mm(before)),
            "after": _rounded(measures.jitter_mm(after)),
        },
        "spill_frame": reference,
        "spill_mm": {
            "as_read": _rounded(measures.spill_mm(found.read[reference])),
            "driven": _rounded(measures.spill_mm(after[reference])),
        },
        "lips_mm": None
        if gaps is None
        else {
            "neutral": _rounded(gaps[0]),
            "smallest": _rounded(gaps[1:].min()),
            "largest": _rounded(gaps[1:].max()),
        },
        "unused": {**signal.unused, **found.unused},
    }


def report_text(data: dict[str, Any]) -> str:
    """Text of the measures for a terminal."""
    source, target = data["head_models"]
    jitter, spill, lips = data["jitter_mm"], data["spill_mm"], data["lips_mm"]
    residual = data["refit_residual_mm"]
    fitted = "coefficients as they are" if residual is None else f"refit, {residual:.3f} mm on the face"
    lines = [
        f"{data['written']}: {data['frames']} frames of {data['signal']} ({data['format']})",
        f"  head models     {source} to {target}: {fitted}",
        "  jitter          "
        + (
            "fewer than 3 frames"
            if jitter["before"] is None
            else f"{jitter['before']:.3f} mm, smoothed {jitter['after']:.3f} mm (mean second difference of the face)"
        ),
        f"  identity spill  {spill['as_read']:.3f} mm as read, {spill['driven']:.3f} mm driven (frame {data['spill_frame']})",
        "  lips            "
        + (
            "the head model has no lips"
            if lips is None
            else f"{lips['smallest']:.2f} to {lips['largest']:.2f} mm apart, neutral {lips['neutral']:.2f} mm"
        ),
        f"  latency         {data['transfer_ms']:.1f} ms a frame to read and transfer, {data['render_ms']:.1f} ms to render",
    ]
    reasons: dict[str, list[str]] = {}
    for channel, reason in data["unused"].items():
        reasons.setdefault(reason, []).append(channel)
    lines += [f"  not driven      {', '.join(names)} ({reason})" for reason, names in reasons.items()]
    return "\n".join(lines)


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 4)
