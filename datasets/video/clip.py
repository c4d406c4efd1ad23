"""A video file as a clip that is not tracked yet: frames with a face, cropped and masked, and one camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.images import probe_image
from ...bench.landmark_network import LandmarkNetwork
from ..clip import CaptureClip
from ..head.arrays import HeadArrays
from ..head.subject import resting
from ..images import read_mask, write_image
from ..monocular.clip import check_subject, clip_of_track, subject_of
from ..monocular.track import VIDEO, Track, VideoFrame
from .decode import TimedFrame, VideoInfo, probe_video, video_frames
from .faces import Crop, crop_around, find_faces
from .segmentation import SelfieSegmentation
from .settings import MASKLESS, VideoOptions

IMAGES, MASKS = "images", "masks"
USUAL_FOCAL = 1.0
"""Focal length relative to the longer side of a frame where it is not known: about that of phones' main cameras and of webcams."""
DISTANCE = 1.0  # of the head before it is tracked, metres


class VideoClip(NamedTuple):
    """Frames of a video that are not tracked yet."""

    clip: CaptureClip
    info: VideoInfo
    crop: Crop
    scale: float
    """Pixels of the clip by pixels of the video."""
    without_face: tuple[int, ...]
    """Numbers of the frames that were left out because no face was found."""

    def with_focal(self, focal: float) -> CaptureClip:
        """The clip with a focal length in pixels of the video."""
        (camera,) = self.clip.cameras.values()
        K = np.array(camera.K)
        K[0, 0] = K[1, 1] = focal * self.scale
        changed = Camera(camera.id, camera.width, camera.height, K, camera.world_to_camera)
        return self.clip.derive("focal_length", {"pixels": focal}, cameras={camera.id: changed})


def open_video(
    path: Path,
    options: VideoOptions,
    head: HeadArrays,
    network: LandmarkNetwork,
    out: Path,
    progress: Progress = no_progress,
) -> VideoClip:
    """Read a video, write its frames and masks under ``out``, and return them as a clip in a neutral pose.

    Raises `InputError` for a file that is no video, masks that do not fit, too few frames with a face, and where it is not said
    how to mask, before anything is written.
    """
    subject = options.subject or subject_of(path)
    check_subject(subject, "--subject")
    info = probe_video(path)
    numbers: list[int] = []
    mask_of = _masks(options)
    faces = find_faces(path, _images(path, options, numbers), network, progress)
    check_masks(options, [n for n, found in zip(numbers, faces.found) if found], info)
    crop = crop_around(faces, info.width, info.height)
    scale = min(1.0, options.size / max(crop.width, crop.height))
    width, height = max(1, round(crop.width * scale)), max(1, round(crop.height * scale))
    (out / IMAGES).mkdir(parents=True, exist_ok=True)
    focal = (options.focal or USUAL_FOCAL * max(info.width, info.height)) * scale
    middle = (np.array([info.width, info.height]) / 2 - [crop.left, crop.top]) * scale
    K = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
    camera = Camera("0", width, height, K, np.eye(4))
    frames = []
    for row, (number, _, frame) in enumerate(_frames(path, options)):
        if not faces.found[row]:
            continue
        image = out / IMAGES / f"{number:05d}.png"
        write_image(image, _resized(crop.of(frame), width, height))
        mask = None
        if mask_of is not None:
            mask = out / MASKS / f"{number:05d}.png"
            mask.parent.mkdir(exist_ok=True)
            write_image(mask, _resized(crop.of(mask_of(number, frame)), width, height))
        pose = _neutral(head)
        frames.append(VideoFrame((path, f"frame {number}"), VIDEO, number, image, mask, camera, pose))
        progress(row + 1, len(faces.pixels), "frames")
    identities = np.zeros(head.shape_basis.shape[2], np.float32)
    clip = clip_of_track(
        out,
        Track(frames, identities, None, frozenset()),
        head,
        subject=subject,
        held_out_frames=options.held_out_frames,
        use_cache=False,
        progress=progress,
    )
    lost = tuple(number for number, found in zip(numbers, faces.found) if not found)
    return VideoClip(clip, info, crop, scale, lost)


def _frames(path: Path, options: VideoOptions) -> Iterator[TimedFrame]:
    return islice(video_frames(path, options.rate), options.longest)


def _images(path: Path, options: VideoOptions, numbers: list[int]) -> Iterator[ByteArray]:
    """Images of the frames; appends their numbers."""
    for frame in _frames(path, options):
        numbers.append(frame.number)
        yield frame.image


def check_masks(options: VideoOptions, numbers: Sequence[int], info: VideoInfo) -> None:
    """Raise `InputError` unless the folder of masks has a mask of the video's size for every frame that is used."""
    if options.masks in ("", MASKLESS):
        return
    for number in numbers:
        mask = Path(options.masks) / f"{number:05d}.png"
        found = probe_image(mask)
        if (found.width, found.height) != (info.width, info.height):
            expected = f"{info.width}x{info.height} pixels, the size of the video"
            raise InputError(mask, "", expected, f"{found.width}x{found.height}")


def _masks(options: VideoOptions) -> Callable[[int, ByteArray], ByteArray] | None:
    """What gives the mask of a frame by its number and picture; None to keep the room."""
    if bool(options.segmentation) == bool(options.masks):
        expected = "one of --segmentation FILE, --masks FOLDER and --masks none"
        remedy = (
            "selfie_segmentation.tflite is in the wheel of mediapipe 0.10.21 (Apache-2.0), under "
            "mediapipe/modules/selfie_segmentation: pip download --no-deps mediapipe==0.10.21, and unpack it."
        )
        found = "both" if options.masks else "none of them"
        raise InputError("command line", "masks of a video", expected, found, remedy)
    if options.masks == MASKLESS:
        return None
    if options.segmentation:
        network = SelfieSegmentation(Path(options.segmentation))
        return lambda number, frame: network.mask(frame)
    folder = Path(options.masks)

    def stored(number: int, frame: ByteArray) -> ByteArray:
        return read_mask(folder / f"{number:05d}.png", (frame.shape[1], frame.shape[0]))

    return stored


def _resized(image: ByteArray, width: int, height: int) -> ByteArray:
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _neutral(head: HeadArrays) -> HeadPose:
    """At rest in front of the camera, upright and facing it."""
    return replace(
        resting(head), rotation=np.array([np.pi, 0.0, 0.0]), translation=np.array([0.0, 0.0, DISTANCE])
    )
