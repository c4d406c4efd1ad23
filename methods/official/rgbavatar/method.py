"""RGBAvatar by its authors' code.

Li et al., "RGBAvatar: Reduced Gaussian Blendshapes for Online Modeling of Head Avatars", CVPR 2025. The offline mode
for videos of one camera is run.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ....bench.contracts import Clip, FloatArray, FrameKey, HeadAsset, Progress
from ....bench.errors import InputError
from ....bench.io.arrays import read_npy, read_npz
from ....bench.io.files import read_bytes, write_bytes, write_text
from ...rgbavatar.spec import RGBAvatarConfig
from ...shared.avatar_files import SUBJECT_FILE, Subject, read_shared_head
from ...shared.loop import Fit
from ...shared.schedule import GroupedBatches, Timeline
from ...shared.surface_points import chart_resolution, texel_points
from ..checkout import Checkout, Repository
from ..ga.head_files import OfficialHead, SparseMatrix, cameras_of, padding_remarks, pickled
from ..method import read_identity
from ..spec import RGBAVATAR_OFFICIAL, RGBAvatarOfficialConfig
from ..video import (
    FlameSubject,
    PartsMethod,
    RenderCall,
    at_rest,
    check_masks,
    check_no_skew,
    check_one_camera,
    frame_name,
    image_name,
    in_parts,
    same_intrinsics,
    write_torch,
    write_video,
)
from ..workplace import Listed, Patch, Workplace, copy_file, write_placeholder

DATA = Path("data/FLAME2020")
MODEL_FILE, CHART_FILE = DATA / "generic_model.pkl", DATA / "flame_uv.npz"
EYELID_FILES = (DATA / "l_eyelid.npy", DATA / "r_eyelid.npy")
CONFIG = Path("config/offline.yaml")


def has_their_topology(head: HeadAsset, checkout: Checkout) -> bool:
    """Whether a head without its teeth has as many vertices as an eyelid basis of a checkout."""
    return len(OfficialHead.numbered(head).order) == len(read_npy(checkout.folder / EYELID_FILES[0]))


def chart_of(head: HeadAsset) -> FloatArray:
    """(F, 3, 2) float64 texture coordinates of a head."""
    uv = getattr(head, "uv", None)
    if uv is None:
        remedy = (
            "Refit the capture to FLAME 2020 (headbench prepare refit), or use the condition packed-chart."
        )
        expected = "texture coordinates, or FLAME's topology"
        raise InputError(f"head model {head.version!r}", "uv", expected, "none", remedy)
    return np.asarray(uv, np.float64)


def flame_subject(subject: Subject, head: HeadAsset, checkout: Checkout, *, own_chart: bool) -> FlameSubject:
    """The head model, with its teeth if its own chart is used, and one identity."""
    if own_chart:
        chart_of(head)
        return FlameSubject.whole(head, subject)
    lid = EYELID_FILES[0]
    flame = FlameSubject.of(head, subject, len(read_npy(checkout.folder / lid)), lid)
    chart = read_npz(checkout.folder / CHART_FILE)
    triangles = np.asarray(chart.get("ft", ()))
    if triangles.shape != flame.official.faces.shape:
        expected = f"{len(triangles)} triangles, as {CHART_FILE} has"
        count = str(len(flame.official.faces))
        raise InputError(f"head model {head.version!r}", "faces", expected, count)
    return flame


def write_program(identity: Subject, head: HeadAsset, work: Workplace, *, own_chart: bool) -> FlameSubject:
    """Write the files that the program opens relative to its working directory: head model, chart and eyelids.

    Returns the identity on the head model; raises the errors of `flame_subject`.
    """
    subject, folder = flame_subject(identity, head, work.checkout, own_chart=own_chart), work.program
    model = subject.model()
    sparse = SparseMatrix(model["J_regressor"])
    write_bytes(folder / MODEL_FILE, pickled({**model, "J_regressor": sparse}))
    subject.official.write_eyelids(*(folder / name for name in EYELID_FILES))
    if own_chart:
        uv = chart_of(head)
        corners = np.arange(3 * len(uv)).reshape(-1, 3)
        content = io.BytesIO()
        np.savez(content, vt=uv.reshape(-1, 2), ft=corners)
        write_bytes(folder / CHART_FILE, content.getvalue())
    else:
        chart = read_bytes(work.checkout.folder / CHART_FILE, "a texture chart")
        write_bytes(folder / CHART_FILE, chart)
    return subject


def write_config(path: Path, checkout: Checkout, changes: Mapping[str, Any]) -> None:
    """Write their published configuration with other values of some entries."""
    source = checkout.folder / CONFIG
    text = read_bytes(source, "a configuration").decode(errors="replace")
    for name, value in changes.items():
        text, count = re.subn(rf"^(\s*{name}:).*$", rf"\g<1> {value}", text, flags=re.MULTILINE)
        if count != 1:
            remedy = "Check out the commit that the adapter was written for."
            raise InputError(source, name, "one entry", f"{count}", remedy)
    write_text(path, text)


def write_list(frames: Sequence[Listed], subject: FlameSubject, folder: Path) -> None:
    """Write frames of one camera's intrinsics as a video.

    Images have one pixel: the renderer loads but does not use them, and takes the size from the first frame's file.
    """
    for index, frame in enumerate(at_rest(subject.posed, frames)):
        write_placeholder(folder / image_name(index))
        write_torch(folder / frame_name(index), subject.frame(frame.camera, frame.pose))


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
"""The authors' renderer converts colours to 8 bits without clipping, so values above 1 are undefined."""
ORDER: tuple[Patch, ...] = (
    (
        "dataset/dataloader.py",
        "np.random.choice(range(len(self.dataset)), self.batch_size, replace=False).tolist()",
        "[int(index) for index in images_in_order.pop(0).split()]",
    ),
    ("model/reconstruction.py", "self.iteration += batch_size", "self.iteration += self.batch_size"),
    (
        "train_offline.py",
        "range((iteration + batch_size - 1) // batch_size)",
        "range((iteration - 1) // batch_size)",
    ),
)
"""The authors' code draws the frames of a step at random; this takes the next of the given order. As in the native method,
steps of
fewer frames count as whole ones in their schedule, and no step follows the last batch."""
IN_TORCH: tuple[Patch, ...] = (
    (
        "model/binding.py",
        "from diff_gaussian_rasterization import matrix_to_quaternion, quaternion_multiply, compute_face_tbn, fast_forward, mesh_binding",
        "from utils import matrix_to_quaternion, quaternion_multiply",
    ),
    (
        "model/binding.py",
        "gs = self.get_batch_attributes(batch_size",
        "gs = self.get_batch_attributes_torch(batch_size",
    ),
    (
        "model/gaussian.py",
        "from diff_gaussian_rasterization import linear_blending",
        "linear_blending = None",
    ),
)
TRAINING_IN_TORCH: tuple[Patch, ...] = (
    *IN_TORCH,
    ("model/reconstruction.py", "model.gaussian_deform_batch(", "model.gaussian_deform_batch_torch("),
    ("model/reconstruction.py", "model.fast_forward(", "model.fast_forward_torch("),
)
RENDERING_IN_TORCH: tuple[Patch, ...] = (
    *IN_TORCH,
    ("render.py", "model.gaussian_deform_batch(", "model.gaussian_deform_batch_torch("),
)
"""For the CPU shim: axes, binding, blending and initial colours by the PyTorch functions that their code has beside its kernels."""
OWN_CHART: tuple[Patch, ...] = (
    ("submodules/flame/config.py", "add_mouth = True", "add_mouth = False"),
    (
        "model/gaussian.py",
        "assert linear_module.shape[0] <= num_gs",
        "f_rest.ravel()[:len(linear_module)] = linear_module[:, 0]; linear_module = linear_module[:num_gs]",
    ),
    (
        "model/gaussian.py",
        'linear_module = np.asarray(plydata.elements[0]["weight_module"], dtype=np.float32)',
        'linear_module = np.stack([plydata.elements[0]["f_rest_%d" % i] for i in range(45)], axis=1).ravel()',
    ),
)
"""For heads of another topology. Their teeth are attached to vertices of FLAME; such a head has its own. Their file has a number of
the network in each splat, which are too few; here the network is in the 45 numbers of each splat that are 0 otherwise."""
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
    """See the module docstring."""

    name, version = RGBAVATAR_OFFICIAL.name, RGBAVATAR_OFFICIAL.version
    config_class, repository = RGBAvatarOfficialConfig, RGBAVATAR_REPOSITORY
    shimmed, order_changes = "blended splats", ORDER
    iteration_line = r"Training:.*?(\d+)/\d+ \["
    avatar_files = (PLY_FILE, CONFIG_FILE, SUBJECT_FILE)
    # Other commits read frames, which contain more than tensors, without asking newer versions of torch for it.
    variables: ClassVar[Mapping[str, str]] = {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, of several intrinsics or too few frames, and a head that is not FLAME's or, with the CPU shim, has
        no chart either."""
        check_masks(clip)
        check_one_camera(clip)
        for camera in cameras_of(clip).values():
            check_no_skew(camera)
        frames = len(clip.splits["train"])
        if frames < BATCH:
            expected = f"{BATCH} training frames or more, which one step draws without repetition"
            raise InputError(f"clip {clip.subject}", "train", expected, f"{frames}")
        own_chart = self._has_own_chart(clip.head, checkout)
        flame_subject(Subject.of(clip), clip.head, checkout, own_chart=own_chart)

    def _has_own_chart(self, head: HeadAsset, checkout: Checkout) -> bool:
        return self.config.device != "cuda" and not has_their_topology(head, checkout)

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames as a tracked video, and the head model where the program opens it."""
        own_chart = self._has_own_chart(clip.head, work.checkout)
        subject = write_program(Subject.of(clip), clip.head, work, own_chart=own_chart)
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
        if self.config.motion == "root":
            changes["dataset"] = (
                "\n  retarget_neck: False"  # an argument of the authors' loader missing in the published file
            )
        if self._has_own_chart(fit.clip.head, work.checkout):
            changes |= _as_native(fit.clip.head, self.config.samples)
        changes |= dict(each.split("=", 1) for each in self.config.values)
        write_config(work.program / CONFIG_FILE, work.checkout, changes)
        script = str(work.checkout.folder / "train_offline.py")
        options = ["--subject", SUBJECT, "--work_name", WORK, "--config", CONFIG_FILE, "--split", "all"]
        return [*work.checkout.python, script, *options, "--preload"]

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """PyTorch in place of their kernels, and the changes for another topology."""
        return [*TRAINING_IN_TORCH, *self._of_head(head, checkout)]

    def patches_to_render(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """The same."""
        return [*RENDERING_IN_TORCH, *self._of_head(read_shared_head(folder), checkout)]

    def _of_head(self, head: HeadAsset, checkout: Checkout) -> list[Patch]:
        return [*OWN_CHART] if self._has_own_chart(head, checkout) else []

    def image_name(self, path: str) -> str:
        """The index of a frame in their loader."""
        return str(int(Path(path).stem))

    def batches(self, fit: Fit) -> Iterator[Sequence[int]]:
        """Indices of the training frames of each batch of the native method; the last, after which it takes no step, is read ahead."""
        keys, native = fit.clip.splits["train"], RGBAvatarConfig()
        drawn = GroupedBatches([key.timestep for key in keys], native.batch, native.together, fit.seed)
        return (drawn.batch(step) for step in range(1, (fit.budget.iterations or 0) + 1))

    def done(self, line: str) -> tuple[int, str] | None:
        """The authors' training counts images."""
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
        identity, head = read_identity(folder)
        own_chart = self._has_own_chart(head, work.checkout)
        subject = write_program(identity, head, work, own_chart=own_chart)
        script = [*work.checkout.python, str(work.checkout.folder / "render.py")]
        command = self.launched(script, work, [CLIPPED, *self.render_patches(folder, work.checkout)])
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
        differences = [
            "frames are renumbered and all of them are used (--split all); their code holds out the last 350",
            "the background is removed from partly covered pixels, and the static offset is part of the template",
            "eyelids are added before skinning by their code, after it in the capture's head model",
            "colours of renders are limited to 0 to 255 before they are rounded down to 8 bits by their code",
            "their code sets no seed: a run with the same seed is a repetition",
        ]
        if self.config.motion == "root":
            differences.append(
                "the motion of the head is that of the whole head, not of its neck joint (retarget_neck)"
            )
        if self.config.values:
            differences.append(f"other values in their configuration: {', '.join(self.config.values)}")
        if self.config.device != "cuda" and not has_their_topology(clip.head, self.inspect()):
            differences.append(
                "the head has another topology than FLAME's: its own chart is used, on the head with its teeth, with as many "
                + "texels as the native method has, and splats of the size that they have there at the start"
            )
        return differences + padding_remarks(clip.head)


def _as_native(head: HeadAsset, samples: int) -> dict[str, Any]:
    """Entries of their configuration with which the splats of a chart are those of the native method."""
    uv = chart_of(head)
    count = len(texel_points(uv, np.arange(len(uv)), samples).triangles)
    return {"tex_size": chart_resolution(uv, samples), "init_scaling": RGBAvatarConfig().initial_scale(count)}
