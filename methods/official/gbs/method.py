"""GaussianBlendshapes by its authors' code.

Ma et al., "3D Gaussian Blendshapes for Head Avatar Animation", SIGGRAPH 2024.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ....bench.contracts import Clip, Frame, FrameKey, HeadAsset, Progress
from ....bench.errors import InputError
from ....bench.io.images import read_png
from ...gbs.config import BlendshapeTraining, GBSConfig
from ...shared.avatar_files import (
    SUBJECT_FILE,
    Subject,
    read_shared_head,
    read_subject,
)
from ...shared.loop import Fit
from ...shared.schedule import DensifySchedule, Timeline
from ..checkout import Checkout, Repository
from ..config import GBSOfficialConfig
from ..ga.export import check_mark
from ..ga.head_files import padding_remarks
from ..ga.method import copy_file, rendered, trained
from ..method import Listed, OfficialMethod, Patch, Workplace
from ..spec import GBS_OFFICIAL
from ..video import check_masks, on_background, write_background
from .export import VideoHead, held_out, write_list, write_training

FILES = {
    name: f"{name}{suffix}"
    for name, suffix in {
        "fix_chkpnt": ".pth",
        "mouth0_chkpnt": ".pth",
        "mouth1_chkpnt": ".pth",
        "acc": ".npy",
    }.items()
}
"""Prefixes of the files that their renderer opens, which end in the iteration, and their stored names."""
MODEL_SOURCE, GRID_NODES = "FLAME/face_gs_model.py", 256
"""Places in their code that fill grids of nearest triangles and skinning weights, and number of nodes per side."""
SHRINK = """
import sys, torch
for path in sys.argv[1:]:
    state, iteration = torch.load(path)
    kept = tuple({} if isinstance(part, dict) and "param_groups" in part else part for part in state)
    torch.save((kept, iteration), path)
"""
"""Removes the optimiser's state, two thirds of their size, from checkpoints, since their renderer ignores it."""

WITHOUT_FIX = "2952da7d246e5790140dbb477d1468214564f092"
"""The commit that the adapter was written for."""


class GBSOfficial(OfficialMethod[GBSOfficialConfig]):
    """The method: see the module."""

    name, version = GBS_OFFICIAL.name, GBS_OFFICIAL.version
    config_class = GBSOfficialConfig
    repository = Repository(
        "https://github.com/zjumsj/GaussianBlendshapes",
        WITHOUT_FIX,
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
    # Their frames and checkpoints contain more than tensors, which newer versions of torch read only if requested.
    variables: ClassVar[Mapping[str, str]] = {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, and a head that their code does not support."""
        check_masks(clip)
        held_out(checkout)
        VideoHead(Subject.of(clip), clip.head, checkout)

    def export(
        self, clip: Clip, checkout: Checkout, work: Workplace, progress: Progress
    ) -> dict[str, FrameKey]:
        """Write the training frames as a tracked video, and their program with the files that it opens."""
        head = VideoHead(Subject.of(clip), clip.head, checkout)
        head.write_program(work.program)
        return write_training(clip, head, held_out(checkout), work, progress)

    def train_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str]:
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
        words = [str(word) for pair in options.items() for word in pair]
        return [*checkout.python, str(work.program / "train.py"), *words]

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Coarser look-up grids: their C++ code fills 256^3 nodes in minutes, the stand-ins in hours."""
        return [
            (MODEL_SOURCE, f"N_res{grid} = {GRID_NODES}\n", f"N_res{grid} = {GRID_NODES // 2}\n")
            for grid in (1, 2)
        ]

    def patches_for_order(self) -> list[Patch]:
        """They draw the index of a frame at random; it is replaced by the next of the given order."""
        drawn = "viewpoint_stack.pop(random.randint(0, len(viewpoint_stack)-1))"
        return [("train.py", drawn, "int(images_in_order[iteration - 1])")]

    def image_name(self, path: str) -> str:
        """The index of a frame."""
        return str(int(Path(path).stem))

    def shrink_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str] | None:
        """Run in their interpreter, on the device to which tensors are loaded."""
        names = [
            f"{name}{fit.budget.iterations}.pth" for name, ours in FILES.items() if ours.endswith(".pth")
        ]
        return [*checkout.python, "-c", SHRINK, *(str(work.model / name) for name in names)]

    def done(self, line: str) -> tuple[int, str] | None:
        """Parse the progress bar of their training."""
        return trained(line)

    def keep(self, fit: Fit, work: Workplace) -> dict[str, Any]:
        """Files that their renderer opens."""
        for name, ours in FILES.items():
            copy_file(work.model / f"{name}{fit.budget.iterations}{Path(ours).suffix}", fit.out / ours)
        return {}

    def files(self, folder: Path) -> list[Path]:
        """Splats, initial values of their differences, and the subject."""
        return [folder / name for name in (*FILES.values(), SUBJECT_FILE)]

    def write_list(
        self,
        folder: Path,
        frames: Sequence[Listed],
        background: Sequence[float],
        checkout: Checkout,
        work: Workplace,
    ) -> None:
        """Write the frames as a video, and a model folder with links to the avatar's files."""
        model = read_shared_head(folder)
        head = VideoHead(read_subject(folder / SUBJECT_FILE, model), model, checkout)
        head.write_program(work.program)
        write_list(frames, head, work)
        for name, ours in FILES.items():
            # Gigabytes, which are only read.
            (work.model / f"{name}1{Path(ours).suffix}").symlink_to((folder / ours).absolute())
        write_background(work, background)

    def render_command(self, folder: Path, checkout: Checkout, work: Workplace) -> list[str]:
        """Their script for all frames of a video, regardless of their loader's split."""
        options: dict[str, Any] = {
            "--source_path": work.input,
            "--model_path": work.model,
            "--load_iteration": 1,
            "--render_seq": True,
            "--render_test": False,
            "--dump_for_viewer": False,
        }
        words = [str(word) for pair in options.items() for word in pair]
        return [*checkout.python, str(work.program / "test.py"), *words]

    def drawn(self, line: str) -> int | None:
        """Parse the progress bar of their renderer."""
        return rendered(line)

    def render_folder(self, folder: Path, work: Workplace) -> Path:
        """Renders of the whole video, and the files beside them."""
        return work.model / "seq" / "split_1"

    def render_name(self, number: int) -> str:
        """Render by the frame's number."""
        return f"pred_{number:05d}.png"

    def is_render(self, name: str) -> bool:
        """Excludes the ground truth, meshes, masks and mouths that their script writes into the same folder."""
        return name.startswith("pred_") and not name.startswith("pred_mask_")

    def read_back(self, frame: Listed, path: Path, work: Workplace) -> Frame:
        """A render on black, composited on the background by its coverage, after its frame is verified by the ground truth."""
        number = path.name.removeprefix("pred_")
        check_mark(path.with_name(f"gt_{number}"), frame.number)
        parts = []
        for file in (path, path.with_name(f"pred_mask_{number}")):
            image = read_png(file)
            if image.shape[:2] != (frame.camera.height, frame.camera.width):
                expected = f"{frame.camera.width}x{frame.camera.height} pixels"
                raise InputError(file, str(frame.key), expected, f"{image.shape[1]}x{image.shape[0]}")
            parts.append(image.astype(np.float32) / 255)
        return on_background(parts[0], parts[1][..., 0], work)

    def remarks(self, clip: Clip, seed: int) -> dict[str, list[str]]:
        """Leaks and differences, for readers of results."""
        differences = [
            "frames are renumbered; those at the end, which their code holds out, are placeholders of one pixel",
            "the background is removed from partly covered pixels, and the static offset is part of the template",
        ]
        differences += padding_remarks(clip.head)
        if self.config.commit and WITHOUT_FIX.startswith(self.config.commit):
            differences.append(
                "a commit before the authors' fix of June 2025 (5017124), which they say matters for multi-view captures"
            )
        if seed and self.config.order == "published":
            differences.append(
                f"their code fixes the seed at 0; seed {seed} is a repetition, not another start"
            )
        return {"leaks": [], "differences": differences}
