"""GaussianAvatars by its authors' code.

Qian et al., "GaussianAvatars: Photorealistic Head Avatars with Rigged 3D Gaussians", CVPR 2024.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from ....bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    Progress,
)
from ....bench.errors import InputError
from ....bench.io.arrays import MAX_MAGNITUDE, Member, read_arrays
from ....bench.io.files import atomic_path, write_json
from ....bench.io.images import read_png, write_png
from ....datasets.ga import layout
from ....datasets.ga.writer import CANONICAL_JAW, camera_record, save_npz, transforms_document
from ....datasets.head.arrays import HeadArrays
from ....datasets.head.teeth import RING_LENGTH, ROWS
from ...shared.avatar_files import SUBJECT_FILE, TRACKED, RefinedTracking, Subject
from ...shared.config import PAPER_ITERATIONS, SplatTraining
from ...shared.loop import Fit
from ...shared.schedule import DensifySchedule, Timeline
from ..checkout import Checkout, Repository
from ..method import OfficialMethod, read_identity
from ..spec import GA_OFFICIAL, GAOfficialConfig, OfficialConfig, option_words
from ..workplace import Listed, Workplace, copy_file, is_white, opaque, read_sized
from .head_files import (
    OfficialHead,
    OfficialTracking,
    Window,
    around,
    cameras_of,
    check_square_pixels,
    inside,
)

TRAIN, VALIDATION, TEST = layout.SPLIT_FILES.values()
MARK_LEVELS, MARK_STEP = 16, 16
"""A mark is a colour with 16 levels per channel, 16 apart, so that rounding cannot confuse them."""


def write_training(
    clip: Clip, tracking: OfficialTracking, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write only the training frames as a capture: timesteps numbered from 0, other splits empty.

    Returns the key of every image by its path. The loader opens the JSONs of all three splits, takes the static offset
    from timestep 0, and chooses its dynamic reader by the canonical parameters, whose content it never reads.
    """
    timesteps = sorted({key.timestep for key in clip.splits["train"]})
    number = {timestep: index for index, timestep in enumerate(timesteps)}
    windows = {name: inside(camera) for name, camera in cameras_of(clip, "train").items()}
    names = list(windows)
    keys = sorted(clip.splits["train"], key=lambda key: (key.timestep, key.camera))
    records, images = [], {}
    for done, key in enumerate(keys, 1):
        index = names.index(key.camera)
        image = f"images/{layout.frame_name(number[key.timestep], index)}.png"
        write_png(work.input / image, windows[key.camera].cut(clip.image(key)))
        records.append(_record(windows[key.camera], index, number[key.timestep], image))
        images[f"input/{image}"] = key
        progress(done, len(keys), "exporting")
    for timestep, index in number.items():
        tracking.write(work.input / _parameters(index), clip.poses[timestep])
    _write_splits(work.input, {TRAIN: records}, windows[names[-1]].camera)
    _write_canonical(work.input, tracking, clip.poses[timesteps[0]])
    return images


def write_list(frames: Sequence[Listed], tracking: OfficialTracking, work: Workplace) -> list[HeadPose]:
    """Write frames to render as the test split of a capture; return the pose of each of its timesteps.

    The image of each is a mark, a single colour that encodes its number. The loader reads it as ground truth and the
    renderer writes it beside the render, so that `check_mark` can identify the frame of a file. The training split,
    from which the loader takes the scene's size, is the first frame.
    """
    poses: list[HeadPose] = []
    number: dict[int, int] = {}
    records = []
    for frame in frames:
        if id(frame.pose) not in number:
            number[id(frame.pose)] = len(poses)
            tracking.write(work.input / _parameters(len(poses)), frame.pose)
            poses.append(frame.pose)
        window, image = around(frame.camera), f"images/{frame.number:05d}.png"
        size = window.camera.height, window.camera.width, 3
        write_png(work.input / image, np.full(size, mark(frame.number), np.uint8))
        records.append(_record(window, frame.number, number[id(frame.pose)], image))
    _write_splits(work.input, {TRAIN: records[:1], TEST: records}, frames[-1].camera)
    _write_canonical(work.input, tracking, poses[0])
    return poses


def mark(number: int) -> ByteArray:
    """(3,) colour that encodes a frame's number modulo 4,096."""
    digits = [number // MARK_LEVELS**place % MARK_LEVELS for place in range(3)]
    return np.array([MARK_STEP * digit + MARK_STEP // 2 for digit in digits], np.uint8)


def check_mark(image: ByteArray, path: Path, number: int) -> None:
    """Raise `InputError` if pixels of a file are not the frame's mark, which means that another frame was rendered."""
    pixels = image.reshape(-1, 3).astype(int)
    off = int(np.abs(pixels - mark(number).astype(int)).max())
    if off >= MARK_STEP // 2:
        raise InputError(path, "", f"the mark of frame {number}", "that of another: the order has changed")


def read_window(frame: Listed, path: Path) -> ByteArray:
    """A render at the size of its camera."""
    window = around(frame.camera)
    return window.uncut(read_sized(path, frame, window.camera.width, window.camera.height), frame.camera)


def _parameters(timestep: int) -> str:
    return f"flame_param/{layout.parameter_name(timestep)}"


def _record(window: Window, index: int, timestep: int, image: str) -> dict[str, Any]:
    return {
        "timestep_index": timestep,
        **camera_record(window.camera, index, "bottom"),
        "file_path": image,
        "flame_param_path": _parameters(timestep),
    }


def _write_splits(folder: Path, frames: Mapping[str, Sequence[Mapping[str, Any]]], camera: Camera) -> None:
    shared = layout.intrinsics_to_json(camera, "bottom")
    for file in (TRAIN, VALIDATION, TEST):
        write_json(folder / file, transforms_document(frames.get(file, ()), shared))


def _write_canonical(folder: Path, tracking: OfficialTracking, pose: HeadPose) -> None:
    values = tracking.parameters(pose)
    zeros = {k: v if k in ("shape", "static_offset") else np.zeros_like(v) for k, v in values.items()}
    save_npz(folder / layout.CANONICAL_FILE, {**zeros, "jaw_pose": np.array([CANONICAL_JAW])})


PLY_FILE, TRACKING_FILE, ARGUMENTS_FILE = "point_cloud.ply", "driving.npz", "cfg_args"
PARAMETERS_FILE = "flame_param.npz"
TEETH_VERTICES = len(ROWS) * RING_LENGTH
"""Number of vertices that their head model adds to FLAME's."""
TRAINED = r"Training progress:.*?(\d+)/\d+ \[(?:.*?Loss=([\d.]+))?"
RENDERED = r"Rendering progress:.*?(\d+)/\d+ "
"""Progress bars of scripts derived from those of 3D Gaussian Splatting."""
_white = partial(is_white, other=(0.0, 0.0, 0.0), known="white or black")

LOADER_MODULES = ("tqdm", "numpy", "PIL.Image")
LOADER_TRIAL = "import numpy, PIL.Image; PIL.Image.fromarray(numpy.zeros((1, 1, 3), dtype=numpy.byte), 'RGB')"
LOADER_REMEDY = "Their loader hands signed bytes to Pillow, which newer versions refuse: install an older one, such as pillow==9.5."

GA_REPOSITORY = Repository(
    "https://github.com/ShenhanQian/GaussianAvatars",
    GAOfficialConfig().commit,
    ("train.py", "render.py", "scene/dataset_readers.py", "flame_model/flame.py"),
    (
        "torch",
        "diff_gaussian_rasterization",
        "simple_knn._C",
        "nvdiffrast.torch",
        "roma",
        "plyfile",
        "tqdm",
        "PIL",
    ),
)

Config = TypeVar("Config", bound=OfficialConfig)

THEIR_NAMES = {
    "expression": "expr",
    "rotation": "rotation",
    "neck": "neck_pose",
    "jaw": "jaw_pose",
    "eyes": "eyes_pose",
    "translation": "translation",
}
"""Name of each tracked value in the authors' code."""


class GALayoutMethod(OfficialMethod[Config]):
    """Common code for the repositories with GaussianAvatars' loader and head model."""

    shimmed = "bound splats"
    iteration_line, frame_line = TRAINED, RENDERED
    render_folder, render_name = "test/ours_1/renders", "{:05d}.png"
    model_files: ClassVar[tuple[str, ...]] = (PLY_FILE,)
    """The files of the splats."""

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Check that the background is white or black, pixels are square and the head is supported by their code."""
        where = f"clip {clip.subject}"
        _white(clip.background, where)
        for camera in cameras_of(clip).values():
            check_square_pixels(camera, where)
        OfficialHead.of(clip.head, checkout.folder)

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames in GaussianAvatars' layout, and the head model as FLAME's files."""
        return write_training(clip, _write_head(Subject.of(clip), clip.head, work), work, progress)

    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """Their script, with densification and learning rates scaled to the length of the run."""
        iterations = fit.budget.iterations or 0
        white = _white(fit.clip.background, f"clip {fit.clip.subject}")
        schedule = _schedule(iterations)
        options: dict[str, Any] = {
            "--source_path": work.input,
            "--model_path": work.model,
            "--port": free_port(),
            "--resolution": 1,
            "--iterations": iterations,
            "--position_lr_max_steps": iterations,
            "--densify_from_iter": _first_round(schedule),
            "--densification_interval": schedule.every,
            "--densify_until_iter": max(0, schedule.stop),
            "--opacity_reset_interval": schedule.reset_every,
            "--save_iterations": iterations,
            "--test_iterations": -1,  # their own evaluation of held-out frames, which the export lacks
            "--checkpoint_iterations": -1,
        }
        flags = ["--eval", "--bind_to_mesh", *(["--white_background"] if white else [])]
        script = str(work.checkout.folder / "train.py")
        return [*work.checkout.python, script, *option_words(options), *flags]

    def keep(self, fit: Fit, work: Workplace) -> None:
        """Keep their splats and arguments; the subject is stored without the zeros of their file."""
        made = self._made(work, fit.budget.iterations or 0)
        for name in self.model_files:
            copy_file(made / name, fit.out / name)
        copy_file(work.model / ARGUMENTS_FILE, fit.out / ARGUMENTS_FILE)

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Their script for a test split of the frames, with a model folder that has the parameters of the frames."""
        trained_on = (folder / ARGUMENTS_FILE).read_text(errors="replace")
        if _white(background, "render") != ("white_background=True" in trained_on):
            expected = "the background that it was trained on; their renders have no coverage"
            raise InputError(folder, "background", expected, str(tuple(background)))
        tracking = _write_head(*read_identity(folder), work)
        poses = write_list(frames, tracking, work)
        refined = folder / TRACKING_FILE
        if refined.exists():
            poses = [RefinedTracking.read(refined)(pose) for pose in poses]
        made = self._made(work, 1)
        for name in self.model_files:
            copy_file(folder / name, made / name)
        copy_file(folder / ARGUMENTS_FILE, work.model / ARGUMENTS_FILE)
        values = [tracking.parameters(pose) for pose in poses]
        moving = {name: np.concatenate([value[name] for value in values]) for name in THEIR_NAMES.values()}
        # Their training saves offsets with rows for the teeth of their head model, and their renderer expects them.
        offset = np.pad(values[0]["static_offset"], [(0, 0), (0, TEETH_VERTICES), (0, 0)])
        still = {"shape": values[0]["shape"], "static_offset": offset}
        arrays = {**moving, **still, **self._more_parameters(len(poses), still["static_offset"])}
        with atomic_path(made / PARAMETERS_FILE) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)
        options = {"--source_path": work.input, "--model_path": work.model, "--iteration": 1}
        script = str(work.checkout.folder / "render.py")
        return [*work.checkout.python, script, *option_words(options), "--skip_train", "--skip_val"]

    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render; the ground truth written beside it is used to verify the frame."""
        truth = path.parent.parent / "gt" / path.name
        check_mark(read_png(truth), truth, frame.number)
        return opaque(read_window(frame, path))

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Of the export, cameras, eyelids and seed."""
        differences = ["the capture has no held-out frames; cameras and timesteps are renumbered"]
        moved = [
            c
            for c in clip.cameras.values()
            if np.abs(c.K[:2, 2] - np.array([c.width, c.height]) / 2).max() > 1e-6
        ]
        if moved:
            differences.append(
                "their code assumes the principal point in the middle of the image: images are cropped accordingly "
                f"({len(moved)} of {len(clip.cameras)} cameras)"
            )
        if isinstance(clip.head, HeadArrays) and clip.head.eyelid_basis is not None:
            differences.append("their head model has no eyelid bases: eyelids follow the expression alone")
        return differences + self.repeated(seed)

    def _more_parameters(self, count: int, offset: FloatArray) -> Mapping[str, FloatArray]:
        """Further arrays of their parameter file, for a number of timesteps."""
        return {}

    @staticmethod
    def _made(work: Workplace, iterations: int) -> Path:
        return work.model / "point_cloud" / f"iteration_{iterations}"


class GAOfficial(GALayoutMethod[GAOfficialConfig]):
    """See the module docstring."""

    name, version = GA_OFFICIAL.name, GA_OFFICIAL.version
    config_class, repository = GAOfficialConfig, GA_REPOSITORY
    avatar_files = (PLY_FILE, SUBJECT_FILE, ARGUMENTS_FILE)

    def keep(self, fit: Fit, work: Workplace) -> None:
        """Also keep the tracking refined by their training."""
        super().keep(fit, work)
        refined = _refined(fit.clip, self._made(work, fit.budget.iterations or 0))
        refined.save(fit.out / TRACKING_FILE)

    def _more_parameters(self, count: int, offset: FloatArray) -> Mapping[str, FloatArray]:
        return {"dynamic_offset": np.zeros((count, *offset.shape[1:]), np.float32)}


def _write_head(subject: Subject, head: HeadAsset, work: Workplace) -> OfficialTracking:
    """Write a head model as FLAME's files; return the tracking of a subject on it."""
    official = OfficialHead.of(head, work.checkout.folder)
    official.write(work.program)
    return OfficialTracking(official, subject.shape, subject.static_offset)


def _refined(clip: Clip, made: Path) -> RefinedTracking:
    """Their tracking after training, which numbers the training timesteps from 0."""
    timesteps = np.array(sorted({key.timestep for key in clip.splits["train"]}))
    tracked = {
        name: np.stack([np.asarray(getattr(clip.poses[t], name), np.float32) for t in timesteps.tolist()])
        for name in TRACKED
    }
    members = {name: Member("f", (len(timesteps), None), MAX_MAGNITUDE) for name in THEIR_NAMES.values()}
    arrays = read_arrays(made / PARAMETERS_FILE, members)
    refined = {
        name: arrays[theirs][:, : tracked[name].shape[1]].astype(np.float32)
        for name, theirs in THEIR_NAMES.items()
    }
    return RefinedTracking(clip.subject, timesteps, tracked, refined)


def free_port() -> int:
    """A free port; their training opens one for a viewer."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def _schedule(iterations: int) -> DensifySchedule:
    """Densification schedule of a run of this length, with the published fractions, as in the native method."""
    return DensifySchedule.of(SplatTraining(), Timeline(iterations, PAPER_ITERATIONS), white=True)


def _first_round(schedule: DensifySchedule) -> int:
    """Iteration after which their densification begins; on white, their code resets opacities there in runs of any
    length.

    The native methods have no such reset in a short run. If the first round is later anyway, the start is set to 0, so that
    no iteration matches.
    """
    if schedule.first_reset is None and schedule.start < schedule.every:
        return 0
    return schedule.start
