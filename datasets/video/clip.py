"""A video file as a clip that is not tracked yet: frames with a face, cropped and masked, and one camera.

Masks of a person by background subtraction of the empty room, for a static camera.

Formats read:

- Masks of the frames of a video. Written by PeterL1n/RobustVideoMatting (`inference_utils.py`). Not checked on a file of
  the program.
- Network of a person's mask. Written by google-ai-edge/mediapipe 0.10.21. Checked on
  its wheel, `mediapipe/modules/selfie_segmentation/selfie_segmentation.tflite`.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from ...bench.contracts import ByteArray, Camera, FloatArray, HeadPose, Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import digest, digest_file
from ...bench.io.images import probe_image
from ...bench.io.videos import TimedFrame, VideoInfo, probe_video, video_frames
from ...bench.landmark_network import face_size, fetched_network, open_network
from ...bench.protocol import evenly_with_ends
from ..clip import CaptureClip
from ..ga.validate import content_digests
from ..head.arrays import HeadArrays
from ..head.model import resting
from ..images import read_mask, write_image
from ..monocular.clip import VIDEO, Track, VideoFrame, check_subject, clip_of_track, subject_of
from ..tracking.settings import BACKGROUND, MASKLESS, TRACKER_VERSION, USUAL_FOCAL, VideoOptions
from .faces import BELOW, Crop, FaceFinder, FoundFaces, crop_around, find_faces
from .matting import refined_mask, without_room

SAMPLES, LEAST_EMPTY = 60, 10
"""Maximum and minimum number of frames of the empty room from which the background is learnt."""
LEAST_LEVELS, NOISES = 12.0, 6.0
"""Minimum difference from the background of foreground: levels of 255, and multiples of the pixel's noise."""
MOST_NOISE, MOST_NOISY = 12.0, 0.25
"""Noise above which a pixel's background moves, levels, and fraction of such pixels above which the camera counts as moved."""
MOST_UNSURE = 0.5
"""Maximum of `HeadMask.unsure`, median of `CHECKED` frames."""
CHECKED = 12
BLUR = 1.0  # pixels
_USE = "for --masks background"
_OTHERWISE = "or give --segmentation, or masks of another program by --masks FOLDER."
_REMEDY = f"Film again and leave the picture for a few seconds; {_OTHERWISE}"
_MOVED = f"Film again with a camera that stands still, and leave the picture for a few seconds; {_OTHERWISE}"


class HeadMask(NamedTuple):
    """A mask of a frame."""

    mask: ByteArray
    """(H, W) 255 for the person."""
    unsure: float
    """Ambiguous pixels relative to those of the person: near the outline, those with a difference near the threshold; inside
    the face, those that look like the background."""


class Background(NamedTuple):
    """The room without anyone."""

    colours: FloatArray
    """(H, W, 3) levels."""
    threshold: FloatArray
    """(H, W) minimum difference of foreground, levels."""

    def mask(self, image: ByteArray, face: FloatArray) -> HeadMask:
        """The mask of an (H, W, 3) image of the same view with the landmarks ``face``, (L, 2) pixels. It is the
        connected part of the difference that holds the face, without holes, and ends `BELOW` the chin as crops do."""
        hull = np.zeros(image.shape[:2], np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(face).astype(np.int32)), 1)
        inside, bottom = hull.astype(bool), float(face[:, 1].max())
        above = np.arange(len(hull))[:, None] < bottom + BELOW * (bottom - face[:, 1].min())
        levels = cv2.GaussianBlur(image, (0, 0), BLUR).astype(np.float32)
        # Phones change the exposure; it is estimated from pixels beside the face.
        outside = cv2.distanceTransform(1 - hull, cv2.DIST_L2, 5) > face_size(face) / 2
        outside &= np.arange(len(hull))[:, None] < bottom
        colours = self.colours
        if outside.any():
            colours = (
                colours * (np.median(levels[outside], axis=0) + 1) / (np.median(colours[outside], axis=0) + 1)
            )
        ratio = np.abs(levels - colours).max(axis=2) / self.threshold
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        differs = (((ratio > 1) | inside) & above).astype(np.uint8)
        differs = cv2.morphologyEx(differs, cv2.MORPH_OPEN, kernel)
        differs = cv2.morphologyEx(differs, cv2.MORPH_CLOSE, kernel, iterations=2)
        _, labels = cv2.connectedComponents(differs)
        counts = np.bincount(labels[inside], minlength=2)
        counts[0] = 0
        mask = ndimage.binary_fill_holes(labels == counts.argmax()) & above
        near = cv2.dilate(mask.astype(np.uint8), kernel, iterations=3).astype(bool) & above
        unsure = (near & ~inside & (ratio > 0.5) & (ratio < 2)) | (inside & (ratio < 1))
        return HeadMask(np.where(mask, 255, 0).astype(np.uint8), float(unsure.sum() / max(1, mask.sum())))


def learn_background(path: Path, images: Sequence[ByteArray]) -> Background:
    """The median of each pixel over frames that do not show a face, most of which have to show the empty room.
    ``path``: The video, for messages. ``images``: Images (H, W, 3) of one view."""
    if len(images) < LEAST_EMPTY:
        expected = f"at least {LEAST_EMPTY} frames that show nobody's face, {_USE}"
        raise InputError(path, "", expected, f"{len(images)}", _REMEDY)
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), BLUR) for image in images])
    colours, noise = np.empty(blurred.shape[1:], np.float32), np.empty(blurred.shape[1:3], np.float32)
    for row in range(len(colours)):  # one at a time, to limit memory
        values = blurred[:, row].astype(np.float32)
        colours[row] = np.median(values, axis=0)
        noise[row] = 1.4826 * np.median(np.abs(values - colours[row]).max(axis=2), axis=0)
    moved = float((noise > MOST_NOISE).mean())
    if moved > MOST_NOISY:
        expected = f"the same empty room in most frames that show nobody's face, {_USE}"
        raise InputError(path, "", expected, f"{moved:.0%} of the pixels change in them", _MOVED)
    return Background(colours, np.maximum(LEAST_LEVELS, NOISES * noise))


def check_background(
    path: Path, background: Background, images: Sequence[ByteArray], faces: FloatArray
) -> None:
    """Raise `InputError` if masks of images with landmarks (N, L, 2) are too uncertain: the person may be in the background."""
    unsure = float(np.median([background.mask(image, face).unsure for image, face in zip(images, faces)]))
    if unsure > MOST_UNSURE:
        expected = f"masks in which at most {MOST_UNSURE:.0%} of the person's pixels are unsure, {_USE}"
        raise InputError(path, "", expected, f"{unsure:.0%}", _REMEDY)


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
            expected = "one of --segmentation FILE, --masks FOLDER, --masks background and --masks none"
            raise InputError("command line", "masks of a video", expected, "both")
        self.options = options
        self.unsure: dict[int, float] = {}
        """Of masks by the background, `HeadMask.unsure` by the number of the frame."""
        self._file = None if options.masks else Path(options.segmentation or fetched_network("segmentation"))
        self._network = SelfieSegmentation(self._file) if self._file else None
        self._background: Background | None = None

    def __bool__(self) -> bool:
        """Whether frames are masked."""
        return self.options.masks != MASKLESS

    @property
    def by_background(self) -> bool:
        """Whether masks are computed by background subtraction."""
        return self.options.masks == BACKGROUND

    def prepare(self, numbers: Sequence[int], info: VideoInfo) -> str:
        """Check the inputs of the masks of frames with these numbers; returns a digest of the inputs."""
        if self._file is not None:
            return digest_file(self._file)
        if not self or self.by_background:
            return self.options.masks
        files = [self._mask_file(number) for number in numbers]
        for file in files:
            found = probe_image(file)
            if (found.width, found.height) != (info.width, info.height):
                expected = f"{info.width}x{info.height} pixels, the size of the video"
                raise InputError(file, "", expected, f"{found.width}x{found.height}")
        return digest([*content_digests(files).values()])

    def learn(self, path: Path, frames: Iterable[TimedFrame], faces: FoundFaces, view: FrameView) -> None:
        """Learn the background from the frames of a video that show nobody's face, where masks are made from it."""
        if not self.by_background:
            return
        empty = evenly_with_ends(np.flatnonzero(~faces.found & (faces.others == 0)).tolist(), SAMPLES)
        checked = evenly_with_ends(np.flatnonzero(faces.found).tolist(), CHECKED)
        chosen = {*faces.numbers[[*empty, *checked]].tolist()}
        images = {frame.number: view.image(frame.image) for frame in frames if frame.number in chosen}
        self._background = learn_background(path, [images[number] for number in faces.numbers[empty]])
        pixels = view.points(faces.pixels[checked])
        check_background(
            path, self._background, [images[number] for number in faces.numbers[checked]], pixels
        )

    def mask(self, frame: TimedFrame, view: FrameView, face: FloatArray) -> ByteArray:
        """(H, W) 8-bit coverage of the person in the view of a frame with landmarks ``face``, (L, 2) pixels of the frame.
        Masks of files are not refined."""
        if self._network is None and self._background is None:
            return view.image(
                read_mask(self._mask_file(frame.number), (frame.image.shape[1], frame.image.shape[0]))
            )
        image, points = view.image(frame.image), view.points(face)
        if self._network is not None:
            coarse = self._network.mask(image)  # where the person is larger than in the frame
        else:
            assert self._background is not None
            coarse, self.unsure[frame.number] = self._background.mask(image, points)
        return refined_mask(image, coarse, points)

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
    unsure: tuple[float, ...]
    """`HeadMask.unsure` of the frames of the clip, where masks are made from the background."""

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
    mark = digest(TRACKER_VERSION, digest_file(path), finder.digest, options.rate, options.longest)
    faces = find_faces(path, _frames(path, options), finder, out / FACES, mark, progress)
    numbers = faces.numbers[faces.found].tolist()
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
    unsure = tuple(masks.unsure[number] for number in numbers if masks.unsure)
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
