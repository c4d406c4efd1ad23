"""INSTA by its authors' code.

Zielonka, Bolkart, Thies, "Instant Volumetric Head Avatars", CVPR 2023. Their program is C++ and CUDA, built on
instant-ngp. It takes a scene and a configuration, trains, records the frames of the scene's test split, and ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ....bench.contracts import Clip, FrameKey, HeadAsset, Progress
from ....bench.io.files import read_bytes, write_bytes, write_json
from ...shared.avatar_files import SUBJECT_FILE, Subject
from ...shared.loop import Fit
from ..checkout import Checkout, Environment, Repository, inspect_program
from ..config import INSTAOfficialConfig
from ..ga.windows import cameras_of
from ..in_parts import PartsMethod, RenderCall
from ..method import read_identity
from ..spec import INSTA_OFFICIAL
from ..video import check_masks, check_no_skew
from ..workplace import Listed, Workplace, copy_file
from .export import (
    CONDITIONS,
    MASK_FOLDER,
    MASKS,
    PART,
    TEST,
    VideoMesh,
    write_list,
    write_training,
)

CONFIGS, MAIN, OURS = Path("configs/nerf"), "main.json", "headbench.json"
INPUT, EXPERIMENTS = "../input", "experiments"
"""Paths relative to the program's working directory. It finds files by parts of their paths ("train", "test") and
passes paths to a shell, so none may be absolute because a run folder can have any name."""
RECORDED = Path("headbench/debug")
"""Folder of its output, named after its configuration."""
SNAPSHOT = "snapshot.msgpack"
LAST_SIZE = 16
"""Side of the unused final render of a training."""
_RECORDED = r"Recording frame \[(\d+)/\d+\]"

INSTA_REPOSITORY = Repository(
    "https://github.com/Zielon/INSTA",
    INSTAOfficialConfig().commit,
    (str(CONFIGS / MAIN), "src/recorder.cu", *(f"{MASK_FOLDER}/{name}.obj" for name in MASKS)),
    (),
)


class INSTAOfficial(PartsMethod[INSTAOfficialConfig]):
    """See the module docstring."""

    name, version = INSTA_OFFICIAL.name, INSTA_OFFICIAL.version
    config_class, repository = INSTAOfficialConfig, INSTA_REPOSITORY
    iteration_line = r"iteration=(\d+) loss=([-+.\de]+|-?nan|inf)"
    avatar_files = (SNAPSHOT, SUBJECT_FILE)

    def inspect_environment(self) -> Environment:
        """Check their program and the GPU."""
        return inspect_program(self.name, self.config, self.repository)

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, a skewed camera, and a head outside their scene."""
        check_masks(clip)
        for camera in cameras_of(clip, "train").values():
            check_no_skew(camera)
        VideoMesh.of(Subject.of(clip), clip.head, checkout)

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames as a tracked video, and the files that the program opens in its working directory."""
        head = _write_program(Subject.of(clip), clip.head, work)
        return write_training(clip, head, work, progress)

    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """Their program without a window; its output folder ``input/experiments`` is a link to ``model``."""
        _write_config(work, max_steps=fit.budget.iterations, max_images_gpu=self.config.images_on_gpu)
        link = work.input / EXPERIMENTS
        link.unlink(missing_ok=True)
        link.symlink_to(Path("..") / work.model.name)
        return [*_program(work.checkout), "--scene", INPUT, *_size(LAST_SIZE, LAST_SIZE)]

    def keep(self, fit: Fit, work: Workplace) -> None:
        """The snapshot."""
        copy_file(work.model / RECORDED / SNAPSHOT, fit.out / SNAPSHOT)

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Write the frames as test splits, each rendered in a separate call."""
        head = _write_program(*read_identity(folder), work)
        _write_config(work, max_images_gpu=PART, max_cached_bvh=PART, render_from_snapshot=True)
        (work.program / SNAPSHOT).symlink_to((folder / SNAPSHOT).absolute())
        calls = []
        for part in write_list(frames, head, work):
            listed = Path(INPUT) / part["folder"] / TEST
            recorded = listed.parent / EXPERIMENTS / RECORDED
            size = _size(part["width"], part["height"])
            call = [*_program(work.checkout), "--snapshot", SNAPSHOT, "--scene", str(listed), *size]
            shown = [str(listed), str(recorded / "transforms_overlay.json")]
            calls.append(RenderCall(call, part["numbers"], str(recorded / "overlay"), shown))
        return self.command_of(calls, _RECORDED, work)

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Of the export, the images in memory, the seed, and the renders."""
        differences = [
            "frames are renumbered; the test split that their program renders at the end is a placeholder of one pixel",
            "depths and classes of pixels (mouth, skin, hair) are those of the head model's mesh, not of a depth map of the "
            + "tracker and of a face parsing network",
            "meshes have no teeth; the static offset is part of them",
            "the background is removed from partly covered pixels",
            "images are read again for each part of the training instead of kept in memory",
            "renders are rounded down to 8 bits by their program",
        ]
        if clip.head.expression_basis.shape[2] < CONDITIONS:
            size = clip.head.expression_basis.shape[2]
            differences.append(f"{size} expression coefficients are padded with zeros to {CONDITIONS}")
        if len(clip.splits["train"]) > self.config.images_on_gpu:
            differences.append(
                f"{self.config.images_on_gpu} of {len(clip.splits['train'])} images are drawn again after every 1,500 "
                + "iterations, as their code does it"
            )
        if seed:
            differences.append(f"their code fixes the seeds; seed {seed} repeats the same training")
        return differences


def _program(checkout: Checkout) -> list[str]:
    return [*checkout.python, "--no-gui", "--config", OURS]


def _size(width: int, height: int) -> list[str]:
    return ["--width", str(width), "--height", str(height)]


def _write_program(subject: Subject, model: HeadAsset, work: Workplace) -> VideoMesh:
    """Write the files that the program opens in its working directory; return the subject's mesh."""
    head = VideoMesh.of(subject, model, work.checkout)
    head.write_masks(work.program)
    content = read_bytes(work.checkout.folder / CONFIGS / MAIN, "a configuration")
    write_bytes(work.program / CONFIGS / MAIN, content)
    return head


def _write_config(work: Workplace, **changes: Any) -> None:
    """Their published settings with the given changes, without further videos."""
    fixed = {"parent": MAIN, "use_dataset_cache": False, "render_novel_trajectory": False}
    write_json(work.program / CONFIGS / OURS, {"render_from_snapshot": False, **fixed, **changes})
