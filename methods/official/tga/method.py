"""The method of `ours` by its authors' code.

Wang et al., "3D Gaussian Head Avatars with Expressive Dynamic Appearances by Compact Tensorial Representations",
CVPR 2025. Their loader, head model and files are GaussianAvatars', see `..ga.method`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ....bench.contracts import Clip, FloatArray, FrameKey, HeadAsset, Progress
from ....bench.errors import InputError
from ....datasets.ga.writer import save_npz
from ....datasets.head.teeth import RING_LENGTH
from ....datasets.steps.clusters import DEFAULT_COUNT, cluster_expressions, jaw_bases
from ...shared.avatar_files import SUBJECT_FILE, read_shared_head
from ...shared.config import PAPER_ITERATIONS
from ...shared.loop import Fit
from ...shared.schedule import Timeline
from ..checkout import Checkout, Repository
from ..ga.head_files import OfficialHead
from ..ga.method import (
    ARGUMENTS_FILE,
    LOADER_MODULES,
    LOADER_REMEDY,
    LOADER_TRIAL,
    PLY_FILE,
    TEETH_VERTICES,
    GALayoutMethod,
)
from ..spec import TGA_OFFICIAL, TGAOfficialConfig
from ..workplace import Listed, Patch, Workplace, copy_file

JAW_FILE, CLUSTER_FILE = "sorted_jaw_poses.npz", "train_cluster_16.npz"
NETWORKS = ("triplane.pth", "feat_line.pth")
_MODEL_SOURCE, _TRAIN_SOURCE = "scene/flame_gaussian_model.py", "train.py"


class TGAOfficial(GALayoutMethod[TGAOfficialConfig]):
    """See the module docstring.

    Their preprocessing draws the jaw bases from validation and test poses. It is not run: bases and expression
    clusters are those of `datasets.steps`, from training frames only, in the files that their training opens.
    """

    name, version = TGA_OFFICIAL.name, TGA_OFFICIAL.version
    config_class = TGAOfficialConfig
    repository = Repository(
        "https://github.com/ant-research/TensorialGaussianAvatar",
        TGAOfficialConfig().commit,
        ("train.py", "render.py", "scene/dataset_readers.py", "flame_model/flame.py"),
        ("torch", "diff_gaussian_rasterization", "simple_knn._C", "roma", "plyfile", *LOADER_MODULES),
        LOADER_TRIAL,
        LOADER_REMEDY,
    )
    model_files = (PLY_FILE, *NETWORKS)
    avatar_files = (*model_files, SUBJECT_FILE, ARGUMENTS_FILE, JAW_FILE)
    # Their renderer appends its speed to a file of its author after all images of a split are written.
    excused = r"FileNotFoundError.*fps\.txt"

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Also refuse a mesh of another size than the fixed one of their code, and a head without a face."""
        super().check_clip(clip, checkout)
        where = f"head model {clip.head.version!r}"
        head = OfficialHead.of(clip.head, checkout.folder)
        found = _sizes(head)
        fixed = _fixed_sizes(checkout)
        if found != fixed and self.config.device == "cuda":
            expected = (
                f"{fixed[0]} vertices and {fixed[1]} triangles with teeth, as {_MODEL_SOURCE} fixes them"
            )
            remedy = "Refit the capture to FLAME (headbench prepare refit), or compare with the native method ours."
            raise InputError(where, "template, faces", expected, f"{found[0]} and {found[1]}", remedy)
        if "face" not in clip.head.regions:
            raise InputError(where, "regions", "a region face", "none", "Load the head model with its masks.")

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Also write jaw bases and expression clusters of the training timesteps."""
        images = super().export(clip, work, progress)
        bases = jaw_bases(clip, DEFAULT_COUNT)
        # Their code has 16 lines: a duplicate base shares the weight with its copy.
        filled = bases[np.arange(DEFAULT_COUNT) % len(bases)]
        save_npz(work.input / JAW_FILE, {"jaw_poses": filled.astype(np.float32)})
        clusters = cluster_expressions(clip)
        # By timestep, in the order in which the export numbers them.
        labels = [label for _, label in sorted(clusters.by_timestep.items())]
        save_npz(work.input / CLUSTER_FILE, {"labels": np.array(labels, np.int64)})
        return images

    def check_length(self, iterations: int, checkout: Checkout) -> None:
        """Refuse a run too short for their feature lines to start."""
        begin = _lines_begin(checkout)
        if iterations <= begin and self.config.device == "cuda":
            expected = f"more than {begin}, where {_TRAIN_SOURCE} begins to train its feature lines"
            raise InputError(f"settings.{self.name}", "budget.iterations", expected, f"{iterations}")

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Replace sizes for another head, and the start of their lines in a shorter run."""
        begin = _lines_begin(checkout)
        moved = Timeline(iterations, PAPER_ITERATIONS).at(begin)
        lines = (_TRAIN_SOURCE, f"offset_start_iter = {begin}", f"offset_start_iter = {moved}")
        return [*self._sizes_of(head, checkout), *([lines] if begin != moved else [])]

    def patches_to_render(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """Sizes of another head."""
        return self._sizes_of(read_shared_head(folder), checkout)

    def _sizes_of(self, head: HeadAsset, checkout: Checkout) -> list[Patch]:
        fixed, sizes = _fixed_sizes(checkout), _sizes(OfficialHead.of(head, checkout.folder))
        return [
            (_MODEL_SOURCE, f"torch.zeros([T, {theirs}, ", f"torch.zeros([T, {ours}, ")
            for theirs, ours in zip(fixed, sizes)
            if theirs != ours
        ]

    def keep(self, fit: Fit, work: Workplace) -> None:
        """Also keep the jaw bases, which their renderer reads."""
        super().keep(fit, work)
        copy_file(work.input / JAW_FILE, fit.out / JAW_FILE)

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Besides, the jaw bases are written."""
        command = super().render_command(folder, frames, background, work)
        copy_file(folder / JAW_FILE, work.input / JAW_FILE)
        return command

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Also the replacement of their preprocessing."""
        return super().differences(clip, seed) + [
            "jaw bases from training poses, first the identity; published: validation and test poses, first a half turn",
            "expression clusters without random starts",
        ]

    def _more_parameters(self, count: int, offset: FloatArray) -> Mapping[str, FloatArray]:
        return {"jaw_quat_weight": np.zeros((count, DEFAULT_COUNT), np.float32)}


def _sizes(head: OfficialHead) -> tuple[int, int]:
    """Number of vertices and triangles of a head in their code, including teeth."""
    return len(head.order) + TEETH_VERTICES, len(head.faces) + 12 * (RING_LENGTH - 1)


def _fixed_sizes(checkout: Checkout) -> tuple[int, int]:
    """The numbers fixed in their code."""
    vertices, triangles = (
        int(checkout.constant(_MODEL_SOURCE, rf"self\.{name} = torch\.zeros\(\[T, (\d+), 3\]", name))
        for name in ("mesh_lst", "face_center_lst")
    )
    return vertices, triangles


def _lines_begin(checkout: Checkout) -> int:
    """Iteration at which their code begins to train its feature lines."""
    return int(checkout.constant(_TRAIN_SOURCE, r"offset_start_iter = (\d+)", "offset_start_iter"))
