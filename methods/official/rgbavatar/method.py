"""RGBAvatar by its authors' code.

Li et al., "RGBAvatar: Reduced Gaussian Blendshapes for Online Modeling of Head Avatars", CVPR 2025. The offline mode
for videos of one camera is run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from ....bench.contracts import Clip, FrameKey, Progress
from ....bench.errors import InputError
from ...rgbavatar.config import RGBAvatarConfig
from ...shared.avatar_files import SUBJECT_FILE, Subject
from ...shared.loop import Fit
from ...shared.schedule import Timeline
from ..checkout import Checkout, Repository
from ..config import RGBAvatarOfficialConfig
from ..ga.head_files import padding_remarks
from ..ga.windows import cameras_of
from ..in_parts import PartsMethod, RenderCall, in_parts, same_intrinsics
from ..method import read_identity
from ..spec import RGBAVATAR_OFFICIAL
from ..video import check_masks, check_no_skew, check_one_camera, write_video
from ..workplace import Listed, Patch, Workplace, copy_file
from .export import (
    CHART_FILE,
    CONFIG,
    EYELID_FILES,
    flame_subject,
    write_config,
    write_list,
    write_program,
)

SUBJECT, WORK = "head", "headbench"
INPUT, OUTPUT = "../input", "../model"
"""Relative to the program's working directory."""
PLY_FILE, CONFIG_FILE = "model.ply", "config.yaml"
RENDERED = "render_image"
PART = 500
"""Maximum number of frames in one call, whose meshes are computed at once in the GPU's memory."""
BATCH = RGBAvatarConfig().batch
"""Images of a step. Their numbers of iterations count images; here an iteration is a step, as in the native method."""
CLIPPED: Patch = ("render.py", "* 255.0).to(dtype=torch.uint8", "* 255.0).clamp(0, 255).to(dtype=torch.uint8")
"""Their renderer converts colours to 8 bits without limits, so that values above 1 are not defined."""
_RENDERED = r"Rendering:.*?(\d+)/\d+ \["

RGBAVATAR_REPOSITORY = Repository(
    "https://github.com/gapszju/RGBAvatar",
    RGBAvatarOfficialConfig().commit,
    (
        *("train_offline.py", "render.py", "dataset/flame_dataset.py", "submodules/flame/flame.py"),
        *(path.as_posix() for path in (CONFIG, CHART_FILE, *EYELID_FILES)),
    ),
    (
        *("torch", "torch.utils.tensorboard", "nvdiffrast.torch", "diff_gaussian_rasterization"),
        *("roma", "lpips", "plyfile", "scipy.sparse", "yaml", "tqdm", "PIL", "numpy"),
    ),
    "from diff_gaussian_rasterization import BatchGaussianRasterizer, linear_blending, mesh_binding",
    "Its rasteriser has the same name as others: install that of its submodules folder in a separate environment.",
)


class RGBAvatarOfficial(PartsMethod[RGBAvatarOfficialConfig]):
    """The method: see the module."""

    name, version = RGBAVATAR_OFFICIAL.name, RGBAVATAR_OFFICIAL.version
    config_class, repository = RGBAvatarOfficialConfig, RGBAVATAR_REPOSITORY
    iteration_line = r"Training:.*?(\d+)/\d+ \["
    avatar_files = (PLY_FILE, CONFIG_FILE, SUBJECT_FILE)
    # Other commits read frames, which contain more than tensors, without asking newer versions of torch for it.
    variables: ClassVar[Mapping[str, str]] = {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, of several intrinsics or too few frames, and a head that is not FLAME's."""
        check_masks(clip)
        check_one_camera(clip)
        for camera in cameras_of(clip).values():
            check_no_skew(camera)
        frames = len(clip.splits["train"])
        if frames < BATCH:
            expected = f"{BATCH} training frames or more, which one step draws without repetition"
            raise InputError(f"clip {clip.subject}", "train", expected, f"{frames}")
        flame_subject(Subject.of(clip), clip.head, checkout)

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames as a tracked video, and the head model where the program opens it."""
        subject = write_program(Subject.of(clip), clip.head, work)
        images, _ = write_video(clip, subject.posed, work.input / SUBJECT, subject.frame, progress)
        return {f"input/{SUBJECT}/{name}": key for name, key in images.items()}

    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """Their script on all exported frames, with their configuration scaled to the length of the run."""
        published = RGBAvatarConfig()
        iterations = fit.budget.iterations or 0
        timeline = Timeline(iterations, published.schedule_length)
        changes = {
            "data_dir": INPUT,
            "output_dir": OUTPUT,
            "batch_size": BATCH,
            "iteration": BATCH * iterations,
            "blend_start_iter": BATCH * timeline.at(published.join),
            "position_lr_max_steps": max(1, BATCH * timeline.at(published.position_settles)),
        }
        write_config(work.program / CONFIG_FILE, work.checkout, changes)
        script = str(work.checkout.folder / "train_offline.py")
        options = ["--subject", SUBJECT, "--work_name", WORK, "--config", CONFIG_FILE, "--split", "all"]
        return [*work.checkout.python, script, *options, "--preload"]

    def done(self, line: str) -> tuple[int, str] | None:
        """Their training counts images."""
        found = super().done(line)
        return None if found is None else (found[0] // BATCH, found[1])

    def keep(self, fit: Fit, work: Workplace) -> None:
        """Splats, blendshapes and network in one file, and the configuration."""
        for name in (PLY_FILE, CONFIG_FILE):
            copy_file(work.model / SUBJECT / WORK / name, fit.out / name)

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Write the frames of each camera's intrinsics as a subject, all rendered with a link to the avatar's splats."""
        for frame in frames:
            check_no_skew(frame.camera)
        subject = write_program(*read_identity(folder), work)
        script = [*work.checkout.python, str(work.checkout.folder / "render.py")]
        command = self.launched(script, work, [CLIPPED])
        calls = []
        for index, part in enumerate(in_parts(frames, same_intrinsics, PART)):
            name = f"part_{index:04d}"
            write_list(part, subject, work.input / name)
            made = work.model / name / WORK
            copy_file(folder / CONFIG_FILE, made / CONFIG_FILE)
            (made / PLY_FILE).symlink_to((folder / PLY_FILE).absolute())
            options = ["--subject", name, "--output_dir", OUTPUT, "--work_name", WORK, "--alpha"]
            calls.append(RenderCall([*command, *options], [f.number for f in part], str(made / RENDERED)))
        return self.command_of(calls, _RENDERED, work)

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Of the export, the head model, the renders and the seed."""
        return [
            "frames are renumbered and all of them are used (--split all); their code holds out the last 350",
            "the background is removed from partly covered pixels, and the static offset is part of the template",
            "eyelids are added before skinning by their code, after it in the capture's head model",
            "colours of renders are limited to 0 to 255 before they are rounded down to 8 bits by their code",
            "their code sets no seed: a run with the same seed is a repetition",
            *padding_remarks(clip.head),
        ]
