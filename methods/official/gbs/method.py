"""GaussianBlendshapes by its authors' code.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from ....bench.contracts import Camera, Clip, FloatArray, Frame, FrameKey, HeadAsset, HeadPose, Progress
from ....bench.errors import InputError
from ....bench.io.arrays import read_npy
from ....bench.io.files import atomic_path, read_bytes, write_bytes, write_text
from ....bench.io.images import read_png
from ....datasets.head.arrays import faces_in_region
from ....datasets.head.model import PosedSubject
from ....datasets.head.teeth import with_teeth_where_possible
from ....datasets.images import write_image
from ...gbs.spec import BlendshapeTraining, GBSConfig
from ...shared.avatar_files import SUBJECT_FILE, Subject, head_arrays
from ...shared.loop import Fit
from ...shared.schedule import DensifySchedule, Timeline
from ..checkout import Checkout, Repository
from ..ga.head_files import OfficialHead, obj_text, padding_remarks, pickled, write_landmarks
from ..ga.method import RENDERED, TRAINED, check_mark, mark
from ..method import OfficialMethod, read_identity
from ..spec import GBS_OFFICIAL, GBSOfficialConfig, option_words
from ..video import (
    at_rest,
    check_masks,
    flame_values,
    frame_name,
    frame_parts,
    image_name,
    on_background,
    opencv_values,
    write_torch,
    write_video,
)
from ..workplace import Listed, Patch, Workplace, copy_file, read_sized, write_placeholder

SOURCES = ("*.py", "config/*.py", "FLAME/*.py", "utils/*.py")
"""Their program, which is run from a copy because it opens the eyelid bases beside its own file."""
BILLBOARDS = ("data/up_billboard_tri.obj", "data/down_billboard_tri.obj")
MODEL_FILE, LANDMARKS_FILE = "data/FLAME2020/generic_model.pkl", "data/landmark_embedding.npy"
BACK_FILE, NECK_FILE = "data/FLAME2020/back_of_head.txt", "data/FLAME2020/neck_exclude_vertex.txt"
EYELID_FILES = ("FLAME/blendshapes/l_eyelid.npy", "FLAME/blendshapes/r_eyelid.npy")
MEDIAPIPE_FILE, MEDIAPIPE_LANDMARKS = "FLAME/mediapipe/mediapipe_landmark_embedding.npz", 105
LANDMARKS = {"static_lmk": (51,), "dynamic_lmk": (79, 17)}
LOADER, CONFIG = "FLAME/dataset.py", "config/config_blendshapes.py"
TEXTURE_SIZE = 140
"""Number of texture coefficients of a frame, which are loaded and never used."""
GRIDS = {"WeightID_256.pt": "grid_id", "Weight5node_256.pt": "tar_feature"}
"""Files of their look-up grids, and the values looked up."""


def held_out(checkout: Checkout) -> int:
    """Number of last frames of every video that their loader uses as a test."""
    return int(checkout.constant(LOADER, r"self\.n_seg = (\d+)", "n_seg"))


class VideoHead:
    """A head model and one identity for their code: without teeth, with the static offset in the template."""

    def __init__(self, subject: Subject, head: Any, checkout: Checkout):
        self.official = OfficialHead.numbered(head)
        self.identity = subject
        self.posed = PosedSubject(head, subject.shape, subject.static_offset)
        self._checkout = checkout.folder
        eyelids = read_npy(self._checkout / EYELID_FILES[0])
        self.is_flames = len(eyelids) == len(self.official.order)
        """Whether vertices and triangles are FLAME's, so that indices in their code are valid."""
        if not self.is_flames:
            self._back = self._triangles("scalp")
            self._offset = self._mouth() - self._cylinder(checkout)

    def write_program(self, folder: Path) -> None:
        """Write their program and the files that it opens relative to its working directory."""
        for pattern in SOURCES:
            for path in sorted(self._checkout.glob(pattern)):
                name = path.relative_to(self._checkout).as_posix()
                write_bytes(folder / name, read_bytes(path, "a source file"))
        for name in BILLBOARDS:
            write_bytes(folder / name, read_bytes(self._checkout / name, "an OBJ file"))
        write_bytes(folder / MODEL_FILE, pickled(self.official.model(self.identity.static_offset)))
        write_landmarks(folder / LANDMARKS_FILE, LANDMARKS)
        count = MEDIAPIPE_LANDMARKS
        landmarks: dict[str, np.ndarray] = {
            "lmk_face_idx": np.zeros(count, np.int64),
            "lmk_b_coords": np.full((count, 3), 1 / 3, np.float32),
            "landmark_indices": np.arange(count),
        }
        with atomic_path(folder / MEDIAPIPE_FILE) as temporary, temporary.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **landmarks)
        self.official.write_eyelids(*(folder / name for name in EYELID_FILES))
        self._write_lists(folder)

    def write_identity(self, folder: Path) -> None:
        """Write the canonical mesh and, for heads other than FLAME's, the position of the mouth."""
        head, neutral = self.official, self.posed.neutral
        write_text(folder / "canonical.obj", obj_text(head.vertices(neutral), head.faces))
        if not self.is_flames:
            write_text(folder / "offset.txt", "{:.9g} {:.9g} {:.9g}\n".format(*self._offset))

    def frame(self, camera: Camera, pose: HeadPose) -> dict[str, dict[str, np.ndarray]]:
        """Content of a frame's file with the camera in the head's frame: arrays with a leading axis of one."""
        world, K = np.asarray(camera.world_to_camera, np.float64), np.asarray(camera.K, np.float64)
        # PyTorch3D's camera, x to the left and y up, lengths in halves of the image's smaller side. It draws the mesh
        # beside the renders; splats are projected by the OpenCV camera.
        turned = np.diag([-1.0, -1.0, 1.0])
        half = min(camera.width, camera.height) / 2
        middle = np.array([camera.width, camera.height]) / 2
        pytorch3d = {
            "R": (turned @ world[:3, :3]).T[:2].ravel(),
            "t": turned @ world[:3, 3],
            "fl": K[:1, 0] / half,
            "pp": -(K[:2, 2] - middle) / half,
        }
        flame = flame_values(self.identity, pose) | {"tex": np.zeros(TEXTURE_SIZE)}
        return frame_parts(flame=flame, camera=pytorch3d, opencv=opencv_values(camera))

    def _write_lists(self, folder: Path) -> None:
        """Triangles of the back of the head and vertices of the neck: theirs for FLAME, else those of the head's regions."""
        if self.is_flames:
            for name in (BACK_FILE, NECK_FILE):
                content = read_bytes(self._checkout / name, "a list of numbers")
                write_bytes(folder / name, content)
            return
        for name, numbers in ((BACK_FILE, self._back), (NECK_FILE, self.official.region("neck"))):
            write_text(folder / name, "".join(f"{number}\n" for number in numbers))

    def _triangles(self, region: str) -> np.ndarray:
        """Triangles of a region, by their indices in the exported mesh."""
        head = self.official.head
        faces_in_region(head, region)  # its error names what is missing
        inside = np.isin(self.official.order, head.regions[region])
        triangles = np.flatnonzero(inside[self.official.faces].all(axis=1))
        if len(triangles) < 3:
            where = f"head model {head.version!r}"
            raise InputError(
                where, f"regions[{region}]", "a part of the surface", f"{len(triangles)} triangles"
            )
        return triangles

    def _mouth(self) -> FloatArray:
        """(3,) middle of the box around the teeth, metres."""
        head = with_teeth_where_possible(head_arrays(self.official.head))
        if "teeth" not in head.regions:
            expected = "lips, behind which their code places teeth"
            raise InputError(f"head model {head.version!r}", "regions", expected, "none")
        offset = np.zeros((len(head.template), 3))
        offset[: len(self.identity.static_offset)] = self.identity.static_offset
        teeth = PosedSubject(head, self.identity.shape, offset).neutral[head.regions["teeth"]]
        return np.asarray(0.5 * (teeth.min(0) + teeth.max(0)), np.float64)

    @staticmethod
    def _cylinder(checkout: Checkout) -> FloatArray:
        """(3,) middle of the volume to which their teeth are limited, metres."""
        numbers = checkout.constant(CONFIG, r"cylinder_params = \[([^\]]+)\]", "cylinder_params")
        return np.array([float(number) for number in numbers.split(",")[:3]])


def write_training(
    clip: Clip, head: VideoHead, placeholders: int, work: Workplace, progress: Progress
) -> dict[str, FrameKey]:
    """Write the training frames as a video, followed by placeholders for the frames that their loader holds out.

    A placeholder has an image of one pixel, and pose and camera of the first training frame. Returns the key of every
    other image by its path.
    """
    head.write_identity(work.input)
    images, first = write_video(clip, head.posed, work.input, head.frame, progress)
    for number in range(len(images), len(images) + placeholders):
        write_placeholder(work.input / image_name(number))
        write_torch(work.input / frame_name(number), first)
    return {f"input/{name}": key for name, key in images.items()}


def write_list(frames: Sequence[Listed], head: VideoHead, work: Workplace) -> None:
    """Write frames to render as a video whose images are marks, see `..ga.method.mark`.

    Their renderer first fills two look-up grids of 256^3 nodes, which takes minutes, although it reads the required
    values from the checkpoint. Grids of one node in its cache files avoid that.
    """
    head.write_identity(work.input)
    for frame in at_rest(head.posed, frames):
        image = np.full((frame.camera.height, frame.camera.width, 4), 255, np.uint8)
        image[..., :3] = mark(frame.number)
        write_image(work.input / image_name(frame.number), image)
        write_torch(work.input / frame_name(frame.number), head.frame(frame.camera, frame.pose))
    for file, name in GRIDS.items():
        box = {"bbox_min": torch.zeros(3), "bbox_max": torch.ones(3), "grid_size": [1, 1, 1]}
        write_torch(work.input / file, {**box, name: torch.zeros(1, 1, 1, 1)})


CHECKPOINTS = ("fix_chkpnt", "mouth0_chkpnt", "mouth1_chkpnt")
FILES = {**{name: f"{name}.pth" for name in CHECKPOINTS}, "acc": "acc.npy"}
"""Prefixes of the files that their renderer opens, which end in the iteration, and their stored names."""
MODEL_SOURCE, GRID_NODES = "FLAME/face_gs_model.py", 256
"""Places in the authors' code that fill grids of nearest triangles and skinning weights, and nodes per side."""
SHRINK = """
import sys, torch
for path in sys.argv[1:]:
    state, iteration = torch.load(path)
    kept = tuple({} if isinstance(part, dict) and "param_groups" in part else part for part in state)
    torch.save((kept, iteration), path)
"""
"""Removes the optimiser's state, two thirds of their size, from checkpoints, since their renderer ignores it."""
WITHOUT_FIX = "2952da7d246e5790140dbb477d1468214564f092"
"""The commit that the adapter was written for, from before the authors' fix of June 2025."""


class GBSOfficial(OfficialMethod[GBSOfficialConfig]):
    """See the module docstring."""

    name, version = GBS_OFFICIAL.name, GBS_OFFICIAL.version
    config_class = GBSOfficialConfig
    repository = Repository(
        "https://github.com/zjumsj/GaussianBlendshapes",
        GBSOfficialConfig().commit,
        ("train.py", "test.py", "FLAME/dataset.py", "FLAME/FLAME.py", "FLAME/blendshapes/l_eyelid.npy"),
        (
            *("torch", "torch.utils.tensorboard", "pytorch3d.renderer", "diff_gaussian_rasterization"),
            *("simple_knn._C", "point_cloud_utils", "plyfile", "cv2", "tqdm", "numpy"),
        ),
        "from diff_gaussian_rasterization import RotSH3_C3, CompositeBlendShape, InvMat3x3",
        "Its rasteriser and its simple-knn have the same names as others: install those of its submodules folder in a "
        "separate environment.",
    )
    shimmed = "blendshapes"
    iteration_line, frame_line = TRAINED, RENDERED
    avatar_files = (*FILES.values(), SUBJECT_FILE)
    render_folder, render_name = "seq/split_1", "pred_{:05d}.png"
    render_files = "pred_[!m]*"
    """The script also writes ground truth, meshes, masks and mouths into the folder."""
    # The authors' code draws a frame index at random; this takes the next of the given order.
    order_changes = (
        (
            "train.py",
            "viewpoint_stack.pop(random.randint(0, len(viewpoint_stack)-1))",
            "int(images_in_order[iteration - 1])",
        ),
    )
    # Their frames and checkpoints contain more than tensors, which newer versions of torch read only if requested.
    variables: ClassVar[Mapping[str, str]] = {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, and a head that their code does not support."""
        check_masks(clip)
        held_out(checkout)
        VideoHead(Subject.of(clip), clip.head, checkout)

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames as a tracked video, and their program with the files that it opens."""
        head = VideoHead(Subject.of(clip), clip.head, work.checkout)
        head.write_program(work.program)
        return write_training(clip, head, held_out(work.checkout), work, progress)

    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """Their script, with densification and decay of the learning rate scaled to the length of the run."""
        iterations = fit.budget.iterations or 0
        published = BlendshapeTraining()
        timeline = Timeline(iterations, published.schedule_length)
        schedule = DensifySchedule.of(published, timeline, white=False)
        options: dict[str, Any] = {
            "--source_path": work.input,
            "--model_path": work.model,
            "--iterations": iterations,
            "--position_lr_max_steps": max(1, timeline.at(GBSConfig().position_settles)),
            "--densify_from_iter": schedule.start,
            "--densification_interval": schedule.every,
            "--densify_until_iter": max(0, schedule.stop),
            "--opacity_reset_interval": schedule.prune_extent_from,  # opacities are never reset; large splats are removed from then on
            "--checkpoint_iterations": iterations,
            "--test_iterations": 0,  # their own evaluation of held-out frames, which are placeholders
        }
        return [*work.checkout.python, str(work.program / "train.py"), *option_words(options)]

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Coarser look-up grids: their C++ code fills 256^3 nodes in minutes, the stand-ins in hours."""
        return [
            (MODEL_SOURCE, f"N_res{grid} = {GRID_NODES}\n", f"N_res{grid} = {GRID_NODES // 2}\n")
            for grid in (1, 2)
        ]

    def image_name(self, path: str) -> str:
        """The index of a frame."""
        return str(int(Path(path).stem))

    def shrink_command(self, fit: Fit, work: Workplace) -> list[str] | None:
        """Run in their interpreter, on the device to which tensors are loaded."""
        paths = [str(work.model / f"{name}{fit.budget.iterations}.pth") for name in CHECKPOINTS]
        return [*work.checkout.python, "-c", SHRINK, *paths]

    def keep(self, fit: Fit, work: Workplace) -> None:
        """Files that their renderer opens."""
        for name, ours in FILES.items():
            copy_file(work.model / f"{name}{fit.budget.iterations}{Path(ours).suffix}", fit.out / ours)

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Their script for all frames of a video, regardless of their loader's split; the model folder has links to the avatar."""
        head = VideoHead(*read_identity(folder), work.checkout)
        head.write_program(work.program)
        write_list(frames, head, work)
        for name, ours in FILES.items():
            # Linked, since these files have gigabytes and are only read.
            (work.model / f"{name}1{Path(ours).suffix}").symlink_to((folder / ours).absolute())
        options: dict[str, Any] = {
            "--source_path": work.input,
            "--model_path": work.model,
            "--load_iteration": 1,
            "--render_seq": True,
            "--render_test": False,
            "--dump_for_viewer": False,
        }
        return [*work.checkout.python, str(work.program / "test.py"), *option_words(options)]

    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render on black, composited on the background by its coverage, after its frame is verified by the ground truth."""
        number = path.name.removeprefix("pred_")
        truth = path.with_name(f"gt_{number}")
        check_mark(read_png(truth), truth, frame.number)
        rgb, mask = (
            read_sized(file, frame, frame.camera.width, frame.camera.height).astype(np.float32) / 255
            for file in (path, path.with_name(f"pred_mask_{number}"))
        )
        return on_background(rgb, mask[..., 0], background)

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Of the export, the head model, the commit and the seed."""
        differences = [
            "frames are renumbered; those at the end, which their code holds out, are placeholders of one pixel",
            "the background is removed from partly covered pixels, and the static offset is part of the template",
        ]
        differences += padding_remarks(clip.head)
        if self.config.commit and WITHOUT_FIX.startswith(self.config.commit):
            differences.append(
                "a commit before the authors' fix of June 2025 (5017124), which they say matters for multi-view captures"
            )
        return differences + self.repeated(seed)
