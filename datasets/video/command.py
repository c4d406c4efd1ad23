"""Video files in ``headbench track``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...bench.contracts import HeadAsset, Progress
from ...bench.errors import InputError
from ...bench.io.arrays import Member, cached_arrays
from ...bench.io.files import digest
from ...bench.landmark_network import COUNT, fetched_network
from ...bench.progress import counted
from ..clip import CaptureClip
from ..head.refit.command import target_head
from ..tracking.focal import FocalLength, estimate_focal
from ..tracking.landmarks import Embedding, NetworkLandmarks, head_embedding
from ..tracking.settings import TRACKER_VERSION, make_work_folder
from .clip import FrameView, VideoClip, open_video
from .faces import LEAST_SEEN, REMEDY, FaceFinder

if TYPE_CHECKING:
    from ..tracking.settings import TrackSettings

EMBEDDED = "2023"
"""Default head model of a video."""
_FOCAL = {"pixels": Member("f", ()), "residuals": Member("f", ("N",))}


class OpenedVideo(NamedTuple):
    """A video to be tracked: its clip, the part of its frames there, its landmarks, and information as data and lines of text."""

    clip: CaptureClip
    view: FrameView
    landmarks: NetworkLandmarks
    network: str
    """Name of the file of the landmark network."""
    numbers: list[int]
    """Numbers in the file of the frames of the clip."""
    times: dict[int, float]
    """Seconds at which the timesteps of the clip are."""
    data: dict[str, Any]
    lines: list[str]


def video_to_track(settings: TrackSettings, folder: Path, progress: Progress) -> OpenedVideo:
    """The clip of a video with its focal length. Its frames and results are stored in ``folder``, from which a later
    call resumes."""
    path = Path(settings.capture)
    named = settings.head or EMBEDDED
    head = target_head(named, "--head")
    network = Path(settings.landmarks or fetched_network("landmarks"))
    finder = FaceFinder(network)
    own = replace(
        settings, head=named if Path(named).exists() else None
    )  # the name of a head is not passed to a reader
    teacher = own.open(settings.embedding, progress) if settings.embedding else None
    make_work_folder(folder)
    video = open_video(path, settings, head, finder, folder, progress)
    mark = digest(TRACKER_VERSION, finder.digest, head.fingerprint(), teacher.fingerprint if teacher else "")
    embedding = Embedding(
        **cached_arrays(
            folder / "embedding.npz",
            mark,
            _embedding_arrays(head),
            lambda: head_embedding(finder.network, head, teacher, progress)._asdict(),
        )
    )
    clip, focal = video.clip, None
    landmarks = NetworkLandmarks(video.found, embedding, clip, [*clip.cameras])
    detected = landmarks(sorted(clip.poses))
    if (count := int(detected.seen.sum())) < LEAST_SEEN * len(detected.seen):
        expected = f"a face whose landmarks fit the head model in at least {LEAST_SEEN:.0%} of the frames"
        raise InputError(path, "", expected, f"it in {count} of {len(detected.seen)}", REMEDY)
    if settings.focal is None:
        (camera,) = clip.cameras.values()
        side = max(video.info.width, video.info.height) * video.view.scale
        stored = cached_arrays(
            folder / "focal.npz",
            digest(mark, camera.K, side, detected.pixels),
            _FOCAL,
            lambda: {
                name: np.asarray(value)
                for name, value in estimate_focal(clip.head, camera, detected, side)._asdict().items()
            },
        )
        focal = FocalLength(float(stored["pixels"]), stored["residuals"])
        clip = video.with_focal(focal.pixels / video.view.scale)
        landmarks = NetworkLandmarks(video.found, embedding, clip, [*clip.cameras])
    numbers = video.faces.numbers[video.faces.found].tolist()
    return OpenedVideo(
        clip,
        video.view,
        landmarks,
        network.name,
        numbers,
        {timestep: number / video.info.rate for timestep, number in enumerate(numbers)},
        _data(video, settings.focal, focal),
        _lines(video, settings.focal, focal),
    )


def _embedding_arrays(head: HeadAsset) -> dict[str, Member]:
    return {
        "landmarks": Member("i", ("L",), most=COUNT - 1, least=0),
        "corners": Member("iu", ("L", 3), most=len(head.template) - 1, least=0),
        "weights": Member("f", ("L", 3)),
    }


def _data(video: VideoClip, given: float | None, focal: FocalLength | None) -> dict[str, Any]:
    return {
        "video": {
            **video.info._asdict(),
            "crop": [*video.view.crop],
            "scale": video.view.scale,
            "without_face": [*video.without_face],
            "found_again": [one._asdict() for one in video.faces.again],
            "other_faces": video.faces.numbers[video.faces.others > 0].tolist(),
            "focal": dict(zip(("pixels", "source"), _focal(video, given, focal))),
        }
    }


def _focal(video: VideoClip, given: float | None, focal: FocalLength | None) -> tuple[float, str]:
    """Focal length in pixels of the video, and its source."""
    if focal is None:
        return given or 0.0, "given"
    return focal.pixels / video.view.scale, focal.source


def _lines(video: VideoClip, given: float | None, focal: FocalLength | None) -> list[str]:
    (camera,) = video.clip.cameras.values()
    pixels, source = _focal(video, given, focal)
    lines = [
        f"{len(video.clip.files)} frames of {camera.width}x{camera.height} pixels around the head",
        f"  video      {video.info.width}x{video.info.height} pixels, {video.info.rate:.3g} frames a second",
        f"  focal      {pixels:.0f} pixels of the video, {source}",
    ]
    faces = video.faces
    if video.without_face:
        lines.append(f"  left out   {listed(video.without_face)}, where the person's face is missing")
    if elsewhere := [one.number for one in faces.again if one.elsewhere]:
        lines.append(
            f"  again      the face was found again at another place in {listed(elsewhere)}; check that it is the same person"
        )
    if faces.others.any():
        lines.append(
            f"  others     {listed(faces.numbers[faces.others > 0].tolist())} with a second face. The face that is largest in "
            f"frame {faces.numbers[faces.found][0]} is followed."
        )
    return lines


def listed(numbers: Sequence[int]) -> str:
    """How many frames, and which."""
    text = ", ".join(map(str, numbers[:8])) + (" ..." if len(numbers) > 8 else "")
    return f"{counted(len(numbers), 'frame')} ({text})"
