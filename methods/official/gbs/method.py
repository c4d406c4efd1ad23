"""GaussianBlendshapes by its authors' code.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ....bench.contracts import Clip, Frame, FrameKey, HeadAsset, Progress
from ....bench.io.images import read_png
from ...gbs.config import BlendshapeTraining, GBSConfig
from ...shared.avatar_files import SUBJECT_FILE, Subject
from ...shared.loop import Fit
from ...shared.schedule import DensifySchedule, Timeline
from ..checkout import Checkout, Repository
from ..config import GBSOfficialConfig, option_words
from ..ga.export import check_mark
from ..ga.head_files import padding_remarks
from ..ga.method import RENDERED, TRAINED
from ..method import OfficialMethod, read_identity
from ..spec import GBS_OFFICIAL
from ..video import check_masks, on_background
from ..workplace import Listed, Patch, Workplace, copy_file, read_sized
from .export import VideoHead, held_out, write_list, write_training

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
