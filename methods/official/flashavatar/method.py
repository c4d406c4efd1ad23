"""FlashAvatar by its authors' code.

Xiang et al., "FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding", CVPR 2024.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

from ....bench.contracts import Clip, Frame, FrameKey, HeadAsset, Progress
from ....bench.errors import InputError
from ....bench.io.documents import read_json
from ....bench.io.files import write_json
from ...shared.avatar_files import SUBJECT_FILE, Subject, read_shared_head
from ...shared.loop import Fit
from ..checkout import Checkout, Repository
from ..config import FlashAvatarOfficialConfig
from ..ga.export import check_mark
from ..ga.head_files import padding_remarks
from ..ga.windows import around, cameras_of, check_square_pixels, inside
from ..in_parts import PartsMethod, RenderCall, in_parts, same_intrinsics
from ..method import read_identity
from ..spec import FLASHAVATAR_OFFICIAL
from ..video import check_masks, check_one_camera, write_torch
from ..workplace import Listed, Patch, Workplace, copy_file, is_white, opaque, read_sized
from .export import (
    EYELID_FILES,
    MESH_FILE,
    flame_subject,
    grid_of,
    has_their_topology,
    native_network,
    write_list,
    write_points,
    write_program,
    write_training,
)

NAME, LOG = "head", "log"
CHECKPOINT_FILE, OPTIONS_FILE = "chkpnt.pth", "options.json"
LOADER, MODEL = "scene/__init__.py", "src/deform_model.py"
PART = 500
"""Maximum number of frames in one call, whose images are in the GPU's memory; as many as their test split has."""
PICTURES: Patch = (
    "train.py",
    "np.zeros((args.image_res, args.image_res*2, 3))",
    "np.zeros((image.shape[1], args.image_res*2, 3))",
)
CHANGES: tuple[Patch, ...] = (
    (LOADER, "torch.zeros((3, 512, 512))", "torch.zeros((3, 1, 1))"),
    (LOADER, "test_num = 500", "test_num = 0 if train_type == 0 else self.N_frames"),
    PICTURES,
    ("train.py", "if iteration % 5000 == 0:", "if iteration == opt.iterations:"),
)
"""Source patches: images of any size, no held-out frames, and a checkpoint at the end of a run of any length."""
RENDERING_CHANGES: tuple[Patch, ...] = (
    *CHANGES[:2],
    ("test.py", *PICTURES[1:]),
    (
        "test.py",
        "out.write(save_image)",
        'cv2.imwrite(os.path.join(logdir, "%05d.png" % iteration), save_image); print("drawn", iteration + 1)',
    ),
)
"""Every frame of the list is rendered, and written as PNG instead of a video that loses detail."""
ORDER: Patch = (
    "train.py",
    "viewpoint_stack.pop(random.randint(0, len(viewpoint_stack)-1))",
    "scene.getCameras()[int(images_in_order[iteration - 1])]",
)
"""The authors' code draws a frame at random; this takes the next of the given order. As in the native method, the last one
has no step."""
NETWORK_FILE = "network.pth"
START: tuple[Patch, ...] = (
    (
        "train.py",
        "DeformModel.training_setup()",
        f"DeformModel.training_setup(); DeformModel.deformNet.load_state_dict(torch.load({NETWORK_FILE!r}))",
    ),
    (
        "train.py",
        "gaussians.create_from_verts(verts_final[0])",
        "gaussians.create_from_verts(DeformModel.uv_vertices_shape[0, DeformModel.uv_head_idx])",
    ),
)
"""With ``start=native``: their network is read from a file, and sizes are taken on the neutral mesh."""
NUMBERS = {
    "range": (r"range\((\d+)\)", "range({})"),
    "uv_size": (r"self\.uv_size = (\d+)", "self.uv_size = {}"),
}
"""Source texts with the numbers of vertices and texels per side, which the CPU shim replaces for another topology."""
SHRINK = """
import sys, torch
path = sys.argv[1]
network, splats, iteration = torch.load(path)
def lean(part):
    return {**part, "state": {}} if isinstance(part, dict) and "param_groups" in part else part
torch.save((tuple(map(lean, network)), tuple(map(lean, splats)), iteration), path)
print("headbench:", len(splats[1]), "splats")
"""
"""Removes the state of both optimisers, two thirds of the file, from a checkpoint, since rendering does not need it, and
prints the number of splats."""
SPLATS = re.compile(r"^headbench: (\d+) splats$", re.MULTILINE)
_DRAWN = r"drawn (\d+)"
_white = partial(is_white, other=(0.0, 1.0, 0.0), known="white, or green (0, 1, 0)")

FLASHAVATAR_REPOSITORY = Repository(
    "https://github.com/USTC3DV/FlashAvatar-code",
    FlashAvatarOfficialConfig().commit,
    (
        *("train.py", "test.py", LOADER, MODEL, "flame/flame_mica.py"),
        *(path.as_posix() for path in (MESH_FILE, *EYELID_FILES)),
    ),
    (
        *("torch", "lpips", "pytorch3d.renderer.mesh", "pytorch3d.transforms", "pytorch3d.io"),
        *("diff_gaussian_rasterization", "simple_knn._C", "yacs.config", "loguru", "skimage"),
        *("plyfile", "cv2", "tqdm", "PIL", "numpy"),
    ),
    "import torch; open(torch.hub.get_dir() + '/checkpoints/vgg16-397923af.pth').close()",
    "Its loss needs VGG's weights: run python -c \"import lpips; lpips.LPIPS(net='vgg')\" once in that environment, "
    "which fetches them.",
)


class FlashAvatarOfficial(PartsMethod[FlashAvatarOfficialConfig]):
    """See the module docstring."""

    name, version = FLASHAVATAR_OFFICIAL.name, FLASHAVATAR_OFFICIAL.version
    config_class, repository = FlashAvatarOfficialConfig, FLASHAVATAR_REPOSITORY
    shimmed = "charted splats"
    changes, order_changes = CHANGES, (ORDER,)
    iteration_line = r"^step: (\d+), huber: ([\d.]+|nan|inf)"
    avatar_files = (CHECKPOINT_FILE, OPTIONS_FILE, SUBJECT_FILE)
    # Frames and checkpoints contain more than tensors, which newer versions of torch read only if requested.
    variables: ClassVar[Mapping[str, str]] = {"TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1"}

    def __init__(self, config: FlashAvatarOfficialConfig | None = None):
        super().__init__(config)
        if self.config.start == "native":
            self.changes = (*CHANGES, *START)

    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Refuse a clip without masks, on another background, of several intrinsics or too many frames, and a head that lacks
        regions or, without the CPU shim, is not FLAME's."""
        where = f"clip {clip.subject}"
        check_masks(clip)
        _white(clip.background, where)
        check_one_camera(clip)
        for camera in cameras_of(clip).values():
            check_square_pixels(camera, where)
        most = int(checkout.constant(LOADER, r"max_train_num = (\d+)", "max_train_num"))
        if len(clip.splits["train"]) > most:
            expected = f"at most {most} training frames, as many as their loader reads"
            raise InputError(where, "train", expected, f"{len(clip.splits['train'])}")
        own_chart = self._has_own_chart(clip.head, checkout.folder)
        flame_subject(Subject.of(clip), clip.head, checkout, own_chart=own_chart)

    def check_length(self, iterations: int, checkout: Checkout) -> None:
        """Refuse a run with the CPU shim in which their perceptual loss is used."""
        most = int(checkout.constant("train.py", r"mid_num = (\d+)", "mid_num"))
        if self._shim and iterations > most:
            expected = f"at most {most} with device=cpu-shim, which has no perceptual loss"
            raise InputError(f"settings.{self.name}", "budget.iterations", expected, f"{iterations}")

    @property
    def _shim(self) -> bool:
        return self.config.device != "cuda"

    def _has_own_chart(self, head: HeadAsset, folder: Path) -> bool:
        return self._shim and not has_their_topology(head, folder)

    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames as an identity, and their program with the files that it opens."""
        own_chart = self._has_own_chart(clip.head, work.checkout.folder)
        subject = write_program(Subject.of(clip), clip.head, work, own_chart=own_chart)
        native_masks = self.config.masks == "native"
        return write_training(clip, subject, NAME, work, progress, native_masks=native_masks)

    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """Their script; its output folder inside the identity's is a link to ``model``."""
        link = work.program / "dataset" / NAME / LOG
        link.unlink(missing_ok=True)
        link.symlink_to(Path("../../..") / work.model.name)
        if self._has_own_chart(fit.clip.head, work.checkout.folder):  # The chart depends on the seed.
            write_points(Subject.of(fit.clip), fit.clip.head, self.config.samples, fit.seed, work)
        if self.config.start == "native":
            write_torch(work.program / NETWORK_FILE, native_network(fit.clip.head, fit.seed))
        camera = inside(check_one_camera(fit.clip)).camera
        options = ["--idname", NAME, "--image_res", str(camera.width), "--seed", str(fit.seed)]
        options += ["--iterations", str(fit.budget.iterations)]
        ground = _flags(_white(fit.clip.background, f"clip {fit.clip.subject}"))
        return [*work.checkout.python, str(work.program / "train.py"), *options, *ground]

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Numbers of vertices and texels for another topology."""
        if not self._has_own_chart(head, checkout.folder):
            return []
        numbers = len(head.template), grid_of(self.config.samples)
        theirs = (int(checkout.constant(MODEL, pattern, name)) for name, (pattern, _) in NUMBERS.items())
        texts = [text for _, text in NUMBERS.values()]
        return [(MODEL, text.format(old), text.format(new)) for text, old, new in zip(texts, theirs, numbers)]

    def patches_to_render(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """The same."""
        return self.patches(read_shared_head(folder), 0, checkout)

    def image_name(self, path: str) -> str:
        """The index of a frame, which is one less than the number of its images."""
        return str(int(Path(path).stem.partition("_")[0]) - 1)

    def shrink_command(self, fit: Fit, work: Workplace) -> list[str] | None:
        """Run in their interpreter, on the device to which tensors are loaded."""
        return [*work.checkout.python, "-c", SHRINK, str(_checkpoint(fit, work))]

    def keep(self, fit: Fit, work: Workplace) -> None:
        """The checkpoint, and the background of the training, which their renderer needs as an option."""
        copy_file(_checkpoint(fit, work), fit.out / CHECKPOINT_FILE)
        white = _white(fit.clip.background, f"clip {fit.clip.subject}")
        write_json(fit.out / OPTIONS_FILE, {"white_background": white, "seed": fit.seed})

    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Write the frames of each camera's intrinsics as an identity."""
        white = _white(background, "render")
        trained = read_json(folder / OPTIONS_FILE)
        if white != bool(trained.get("white_background")):
            expected = "the background that it was trained on; their renders have no coverage"
            raise InputError(folder, "background", expected, str(tuple(background)))
        for frame in frames:
            check_square_pixels(frame.camera, "render")
        identity, head = read_identity(folder)
        own_chart = self._has_own_chart(head, work.checkout.folder)
        subject = write_program(identity, head, work, own_chart=own_chart)
        if own_chart:
            write_points(identity, head, self.config.samples, trained.get("seed", 0), work)
        script = [*work.checkout.python, str(work.program / "test.py")]
        patches = [*RENDERING_CHANGES, *self.render_patches(folder, work.checkout)]
        command = self.launched(script, work, patches)
        calls = []
        for index, part in enumerate(in_parts(frames, same_intrinsics, PART)):
            name = f"part_{index:04d}"
            write_list(part, subject, name, work)
            renders = work.program / "dataset" / name / LOG
            renders.mkdir()
            width = around(part[0].camera).camera.width
            options = ["--idname", name, "--image_res", str(width), *_flags(white)]
            options += ["--checkpoint", str((folder / CHECKPOINT_FILE).absolute())]
            calls.append(RenderCall([*command, *options], [f.number for f in part], str(renders)))
        return self.command_of(calls, _DRAWN, work)

    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render; the image on its left is used to verify the frame."""
        window = around(frame.camera)
        width = window.camera.width
        image = read_sized(path, frame, 2 * width, window.camera.height)
        check_mark(image[:, :width], path, frame.number)
        return opaque(window.uncut(image[:, width:], frame.camera))

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Of the export, the images, the head model and the schedule."""
        camera = check_one_camera(clip)
        window = inside(camera).camera
        masks = {
            "parts": "masks of head and neck and of the mouth are those of the head model's mesh, not of a network that parses faces",
            "native": "masks of head and neck contain all foreground pixels; masks of the mouth are those of the native method",
        }
        differences = [
            "frames are renumbered and all of them are used; their code holds out the last 500",
            masks[self.config.masks],
            "the background is removed from partly covered pixels, and the static offset is part of the template",
            f"images of {window.width}x{window.height} pixels as PNG in place of JPEG of 512x512; renders are PNG in place "
            + "of a video, rounded down to 8 bits",
            "whatever the length of the run, their perceptual loss begins at iteration 15,000 and a degree of the harmonics "
            + "is added every 500 iterations",
        ]
        if self.config.start == "native":
            differences.append(
                "the network starts as the native method's with this seed, and sizes with the distances on the neutral mesh"
            )
        if (window.width, window.height) != (camera.width, camera.height):
            differences.append(
                "their code assumes the principal point in the middle of the image: images are cropped accordingly"
            )
        if self._has_own_chart(clip.head, Path(self.config.checkout).expanduser()):
            differences.append(
                "the head has another topology than FLAME's: their chart is replaced by one with a texel for each splat of the "
                + "native method, on the head with its teeth and its border"
            )
        return differences + padding_remarks(clip.head)


def _checkpoint(fit: Fit, work: Workplace) -> Path:
    return work.model / "ckpt" / f"chkpnt{fit.budget.iterations}.pth"


def _flags(white: bool) -> list[str]:
    return ["--white_background"] if white else []
