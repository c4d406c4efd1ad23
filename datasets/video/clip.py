"""A video file as a clip that is not tracked yet: frames with a face, cropped and masked, and one camera.

Formats read:

- Masks of the frames of a video. Written by PeterL1n/RobustVideoMatting (`inference_utils.py`). Not checked on a file of
  the program.
- Network of a person's mask. Written by google-ai-edge/mediapipe 0.10.21. Checked on
  its wheel, `mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite`.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import digest, digest_file
from ...bench.io.images import probe_image
from ...bench.io.videos import TimedFrame, VideoInfo, probe_video, video_frames
from ...bench.landmark_network import fetched_network, open_network
from ..clip import CaptureClip
from ..ga.validate import content_digests
from ..head.arrays import HeadArrays
from ..head.model import resting
from ..images import read_mask, write_image
from ..monocular.clip import (
    VIDEO,
    Track,
    VideoFrame,
    check_frame_count,
    check_subject,
    clip_of_track,
    subject_of,
)
from ..tracking.settings import MASKLESS, TRACKER_VERSION, USUAL_FOCAL, VideoOptions
from .faces import Crop, FaceFinder, FoundFaces, crop_around, find_faces
from .matting import refined_mask, without_room


class SelfieSegmentation:
    """The network of a file."""

    def __init__(self, path: Path):
        expected = "a network that segments a person"
        self._network: Any = open_network(path, expected)
        (self._input,), (self._output,) = (
            self._network.get_input_details(),
            self._network.get_output_details(),
        )
        _, self._height, self._width, _ = map(int, self._input["shape"])
        shape = tuple(map(int, self._output["shape"]))
        if shape != (1, self._height, self._width, 1):
            raise InputError(path, "", expected, f"an output of shape {shape}")

    def mask(self, image: ByteArray) -> ByteArray:
        """(H, W) 8-bit coverage of the person in an (H, W, 3) image."""
        size = (self._width, self._height)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        self._network.set_tensor(self._input["index"], small[None])
        self._network.invoke()
        probability: FloatArray = self._network.get_tensor(self._output["index"])[0, :, :, 0]
        large = cv2.resize(probability, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
        return np.asarray(np.rint(255 * large.clip(0, 1)), np.uint8)


class FrameView(NamedTuple):
    """The part of a video's frames that a clip shows, and its size in the clip."""

    crop: Crop
    width: int
    height: int

    @classmethod
    def of(cls, crop: Crop, size: int) -> FrameView:
        """The view of a crop whose longer side becomes ``size`` pixels, unless it is shorter."""
        scale = min(1.0, size / max(crop.width, crop.height))
        return cls(crop, max(1, round(crop.width * scale)), max(1, round(crop.height * scale)))

    @property
    def scale(self) -> float:
        """Pixels of the view by pixels of the frames."""
        return self.width / self.crop.width

    def image(self, frame: ByteArray) -> ByteArray:
        """The view of a frame or a mask of its size."""
        cropped = self.crop.of(frame)
        if cropped.shape[:2] == (self.height, self.width):
            return cropped
        return np.asarray(
            cv2.resize(cropped, (self.width, self.height), interpolation=cv2.INTER_AREA), np.uint8
        )

    def points(self, pixels: FloatArray) -> FloatArray:
        """(..., 2) pixels of the view from those of a frame."""
        scale = [self.width / self.crop.width, self.height / self.crop.height]
        return (pixels - [self.crop.left, self.crop.top]) * scale


class MaskSource:
    """Masks according to the options."""

    def __init__(self, options: VideoOptions):
        if options.segmentation and options.masks:
            expected = "one of --segmentation FILE, --masks FOLDER and --masks none"
            raise InputError("command line", "masks of a video", expected, "both")
        self.options = options
        self._file = None if options.masks else Path(options.segmentation or fetched_network("segmentation"))
        self._network = SelfieSegmentation(self._file) if self._file else None

    def __bool__(self) -> bool:
        """Whether frames are masked."""
        return self.options.masks != MASKLESS

    def prepare(self, numbers: Sequence[int], info: VideoInfo) -> str:
        """Check the inputs of the masks of frames with these numbers; returns a digest of the inputs."""
        if self._file is not None:
            return digest_file(self._file)
        if not self:
            return MASKLESS
        files = [self._mask_file(number) for number in numbers]
        for file in files:
            found = probe_image(file)
            if (found.width, found.height) != (info.width, info.height):
                expected = f"{info.width}x{info.height} pixels, the size of the video"
                raise InputError(file, "", expected, f"{found.width}x{found.height}")
        return digest([*content_digests(files).values()])

    def mask(self, frame: TimedFrame, view: FrameView, face: FloatArray) -> ByteArray:
        """(H, W) 8-bit coverage of the person in the view of a frame with landmarks ``face``, (L, 2) pixels of the frame.
        Masks of files are not refined."""
        if self._network is None:
            return view.image(
                read_mask(self._mask_file(frame.number), (frame.image.shape[1], frame.image.shape[0]))
            )
        image = view.image(frame.image)  # where the person is larger than in the frame
        return refined_mask(image, self._network.mask(image), view.points(face))

    def _mask_file(self, number: int) -> Path:
        names = [f"{number:0{digits}d}{suffix}" for digits in (5, 4) for suffix in (".png", ".jpg")]
        paths = [Path(self.options.masks, name) for name in names]
        return next((path for path in paths if path.exists()), paths[0])


FACES, IMAGES, MASKS = "faces.npz", "images", "masks"
DISTANCE = 1.0  # of the head before it is tracked, metres


class VideoClip(NamedTuple):
    """Frames of a video that are not tracked yet."""

    clip: CaptureClip
    info: VideoInfo
    view: FrameView
    faces: FoundFaces
    pixels: FloatArray
    """(T, L, 2) landmarks of the frames of the clip, pixels of the clip."""

    @property
    def without_face(self) -> tuple[int, ...]:
        """Numbers of the frames that were left out because the person's face was not found."""
        return tuple(self.faces.numbers[~self.faces.found].tolist())

    def found(self, timestep: int, camera: str, near: FloatArray | None) -> Iterator[FloatArray]:
        """(L, 2) landmarks of a frame of the clip, pixels of the clip: a `tracking.landmarks.Finder`."""
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
    finder: FaceFinder,
    out: Path,
    progress: Progress = no_progress,
) -> VideoClip:
    """Read a video, write its frames and masks under ``out``, and return them as a clip in a neutral pose. Files that
    an earlier call with the same video and options wrote there are reused."""
    subject = options.subject or subject_of(path)
    check_subject(subject, "--subject")
    info = probe_video(path)
    masks = MaskSource(options)
    count = min(options.longest or info.frames, info.frames)
    check_frame_count(path, count, options.held_out_frames, tolerance=2)  # of what the file says
    mark = digest(TRACKER_VERSION, digest_file(path), finder.digest, options.rate, options.longest)
    faces = find_faces(path, _frames(path, options), finder, out / FACES, mark, progress)
    numbers = faces.numbers[faces.found].tolist()
    check_frame_count(path, len(numbers), options.held_out_frames)
    mark = digest(mark, options.size, masks.prepare(numbers, info))
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
    for number in numbers:
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
    return VideoClip(clip, info, view, faces, view.points(faces.pixels[faces.found]))


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
    if not left:
        return
    for done, frame in enumerate(_frames(path, options)):
        progress(done, len(faces.numbers), "frames")
        if frame.number not in left:
            continue
        pictures = [view.image(frame.image)]
        if masks:
            mask = masks.mask(frame, view, seen[frame.number])
            pictures = [without_room(pictures[0], mask), mask]
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
