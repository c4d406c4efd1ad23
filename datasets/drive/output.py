"""Frames of a driven avatar as a video, or as a capture with their FLAME parameters."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...bench.contracts import Avatar, ByteArray, FloatArray, FrameKey, HeadPose, Progress
from ...bench.engine.adaptation import AdaptedClip
from ...bench.io.images import quantise, write_png
from ...bench.io.provenance import RENDER
from ...bench.io.video import write_browser_video
from ..clip import CaptureClip
from ..ga.writer import CANONICAL_JAW, CapturePlan, CaptureWriter, SequencePlan
from ..head.arrays import HeadArrays
from ..head.subject import resting

REST = "REST"
"""Training sequence of a driven capture, which has to have one: one frame, see `canonical`."""


def canonical(head: HeadArrays) -> HeadPose:
    """The face at rest with an open mouth, as VHAP's canonical parameters have it: unlike the frames of any signal at rest.

    Splits of a capture must not share images.
    """
    return replace(resting(head), jaw=np.array(CANONICAL_JAW))


class Renderer:
    """Renders the frames of a clip in the form required by the avatar's method, and records their times.

    Attributes
    ----------
    seconds : list[float]
        Time of each rendered frame.
    """

    def __init__(self, avatar: Avatar, clip: CaptureClip, adapted: AdaptedClip, progress: Progress):
        self._avatar, self._clip, self._adapted, self._progress = avatar, clip, adapted, progress
        self.seconds: list[float] = []

    def frames(self, keys: Sequence[FrameKey]) -> Iterator[ByteArray]:
        """(H, W, 3) 8-bit images of frames, in order."""
        background = [float(value) for value in self._clip.background]
        for number, key in enumerate(keys, 1):
            seen = self._adapted.key(key)
            camera, pose = self._adapted.clip.cameras[seen.camera], self._adapted.clip.poses[seen.timestep]
            start = time.perf_counter()
            rgb: FloatArray = self._avatar.render(camera, pose, background).rgb
            self.seconds.append(time.perf_counter() - start)
            self._progress(number, len(keys), str(key))
            yield quantise(self._adapted.restore(key, rgb))


def write_driven_video(path: Path, renderer: Renderer, clip: CaptureClip, fps: float) -> None:
    """Write the driven sequence of a clip as a video."""
    keys = [key for key in clip.splits["self_reenactment"] if key.sequence != REST]
    write_browser_video(path, renderer.frames(keys), fps, RENDER)


def write_driven_capture(out: Path, renderer: Renderer, clip: CaptureClip) -> Path:
    """Write the frames and poses of a clip in the GaussianAvatars layout; return the folder for readers.

    The driven sequence is held out for self-reenactment; the sequence `REST` is for training.
    """
    keys = list(clip.splits["self_reenactment"])
    sequences: dict[str, list[HeadPose]] = {}
    places = []
    for key in keys:
        poses = sequences.setdefault(key.sequence, [])
        places.append((key.sequence, len(poses), key.camera))
        poses.append(clip.poses[key.timestep])
    red, green, blue = (float(value) for value in clip.background)
    plan = CapturePlan(
        subject=clip.subject.replace("_", "-"),
        head=clip.head,
        shape=clip.shape,
        static_offset=clip.static_offset,
        cameras=[*clip.cameras.values()],
        sequences=[SequencePlan(name, poses) for name, poses in sequences.items()],
        test_sequences=[name for name in sequences if name != REST],
        novel_view_cameras=[],
        background=(red, green, blue),
    )
    writer = CaptureWriter(out, plan)
    for place, frame in zip(places, renderer.frames(keys)):
        write_png(writer.image_path(*place), frame, RENDER)
    return writer.write_metadata()
