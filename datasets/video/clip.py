"""A video file as a clip that is not tracked yet: frames with a face, cropped and masked, and one camera."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...bench.contracts import Camera, FloatArray, HeadPose, Progress, no_progress
from ...bench.io.files import digest, digest_file
from ...bench.landmark_network import LandmarkNetwork
from ..clip import CaptureClip
from ..head.arrays import HeadArrays
from ..head.subject import resting
from ..images import write_image
from ..monocular.clip import check_subject, clip_of_track, subject_of
from ..monocular.track import VIDEO, Track, VideoFrame
from ..tracking.work import TRACKER_VERSION
from .decode import TimedFrame, VideoInfo, probe_video, video_frames
from .faces import FoundFaces, crop_around, find_faces
from .masks import FrameView, MaskSource
from .settings import VideoOptions

FACES, IMAGES, MASKS = "faces.npz", "images", "masks"
USUAL_FOCAL = 1.0
"""Default focal length relative to the longer side of a frame: about that of phones' main cameras and webcams."""
DISTANCE = 1.0  # of the head before it is tracked, metres


class VideoClip(NamedTuple):
    """Frames of a video that are not tracked yet."""

    clip: CaptureClip
    info: VideoInfo
    view: FrameView
    faces: FoundFaces
    pixels: FloatArray
    """(T, L, 2) landmarks of the frames of the clip, pixels of the clip."""
    unsure: tuple[float, ...]
    """`HeadMask.unsure` of the frames of the clip, where masks are made from the background."""

    @property
    def without_face(self) -> tuple[int, ...]:
        """Numbers of the frames that were left out because the person's face was not found."""
        return tuple(self.faces.numbers[~self.faces.found].tolist())

    def found(self, timestep: int, camera: str, near: FloatArray | None) -> Iterator[FloatArray]:
        """(L, 2) landmarks of a frame of the clip, pixels of the clip: a `tracking.network.Finder`."""
        yield self.pixels[timestep]

    def with_focal(self, focal: float) -> CaptureClip:
        """The clip with a focal length in pixels of the video."""
        (camera,) = self.clip.cameras.values()
        K = np.array(camera.K)
        K[0, 0] = K[1, 1] = focal * self.view.scale
        changed = Camera(camera.id, camera.width, camera.height, K, camera.world_to_camera)
        return self.clip.derive("focal_length", {"pixels": focal}, cameras={camera.id: changed})


def open_video(
    path: Path,
    options: VideoOptions,
    head: HeadArrays,
    network: LandmarkNetwork,
    network_digest: str,
    out: Path,
    progress: Progress = no_progress,
) -> VideoClip:
    """Read a video, write its frames and masks under ``out``, and return them as a clip in a neutral pose.

    Files that an earlier call with the same video and options wrote there are reused.

    Raises `InputError` before images are written for a file that is not a video, masks that do not fit, too few frames with a
    face, and an unspecified source of masks.
    """
    subject = options.subject or subject_of(path)
    check_subject(subject, "--subject")
    info = probe_video(path)
    masks = MaskSource(options)
    mark = digest(TRACKER_VERSION, digest_file(path), network_digest, options.rate, options.longest)
    faces = find_faces(path, _frames(path, options), network, out / FACES, mark, progress)
    shown = faces.numbers[faces.found].tolist()
    mark = digest(mark, options.size, masks.prepare(shown, info))
    folder = out / f"{IMAGES}-{mark[:16]}"
    for other in out.glob(f"{IMAGES}-*"):
        if other != folder:
            shutil.rmtree(other)
    view = FrameView.of(crop_around(faces, info.width, info.height), options.size)
    _write_frames(path, options, faces, masks, view, folder, progress)
    focal = (options.focal or USUAL_FOCAL * max(info.width, info.height)) * view.scale
    middle = view.points(np.array([info.width, info.height]) / 2)
    K = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    camera = Camera("0", view.width, view.height, K, np.eye(4))
    frames = []
    for number in shown:
        mask = folder / MASKS / f"{number:05d}.png" if masks else None
        image, where = folder / f"{number:05d}.png", (path, f"frame {number}")
        frames.append(VideoFrame(where, VIDEO, number, image, mask, camera, _neutral(head)))
    clip = clip_of_track(
        folder,
        Track(frames, np.zeros(head.shape_basis.shape[2], np.float32), None, frozenset()),
        head,
        subject=subject,
        held_out_frames=options.held_out_frames,
        use_cache=False,
        progress=progress,
    )
    unsure = tuple(masks.unsure[number] for number in shown if masks.unsure)
    return VideoClip(clip, info, view, faces, view.points(faces.pixels[faces.found]), unsure)


def _write_frames(
    path: Path,
    options: VideoOptions,
    faces: FoundFaces,
    masks: MaskSource,
    view: FrameView,
    folder: Path,
    progress: Progress,
) -> None:
    """Write the images and masks that are missing in a folder."""
    seen = dict(zip(faces.numbers[faces.found].tolist(), faces.pixels[faces.found]))
    files = {
        number: [folder / f"{number:05d}.png", *([folder / MASKS / f"{number:05d}.png"] if masks else [])]
        for number in seen
    }
    left = {number for number, paths in files.items() if not all(file.exists() for file in paths)}
    if masks.by_background:
        left = set(seen)  # all frames, for the fractions of ambiguous pixels
    if not left:
        return
    masks.learn(path, _frames(path, options), faces, view)
    for done, frame in enumerate(_frames(path, options)):
        progress(done, len(faces.numbers), "frames")
        if frame.number not in left:
            continue
        pictures = [view.image(frame.image)]
        if masks:
            pictures.append(masks.mask(frame, view, seen[frame.number]))
        for file, picture in zip(files[frame.number], pictures):
            if not file.exists():
                write_image(file, picture)


def _frames(path: Path, options: VideoOptions) -> Iterator[TimedFrame]:
    return islice(video_frames(path, options.rate), options.longest)


def _neutral(head: HeadArrays) -> HeadPose:
    """Neutral pose in front of the camera, upright and facing it."""
    return replace(
        resting(head), rotation=np.array([np.pi, 0.0, 0.0]), translation=np.array([0.0, 0.0, DISTANCE])
    )
