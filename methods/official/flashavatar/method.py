"""FlashAvatar by its authors' code.

Xiang et al., "FlashAvatar: High-fidelity Head Avatar with Efficient Gaussian Embedding", CVPR 2024.

Of an identity NAME, the loader reads ``metrical-tracker/output/NAME/checkpoint/00000.frame``, numbered from 0, and
``dataset/NAME/imgs/00001.jpg``, ``alpha/00001.jpg``, ``parsing/00001_neckhead.png`` and ``parsing/00001_mouth.png``, whose numbers are
one higher. Images are PNG under these names; the loader recognises the format by the content. It takes identity, image size and
focal lengths from frame 0, and the principal point to be the middle of the image.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import pad

from ....bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
    Progress,
)
from ....bench.errors import InputError
from ....bench.io.documents import read_json
from ....bench.io.files import read_bytes, write_bytes, write_json, write_text
from ....bench.io.images import write_png
from ....datasets.head.arrays import region
from ...flashavatar.method import BOUNDARY, MOUTH
from ...flashavatar.model import INPUTS, network_sizes
from ...flashavatar.spec import FlashAvatarConfig
from ...insta.marching import mouth_triangles, touching
from ...shared.avatar_files import SUBJECT_FILE, Subject, read_shared_head
from ...shared.loop import Fit
from ...shared.optimisation import initial_network, input_count, layer_names
from ...shared.surface_points import SubjectMesh, SurfacePoints, mouth_mask, spread_points
from ..checkout import Checkout, Repository
from ..ga.head_files import (
    EXPRESSION_SIZE,
    OfficialHead,
    around,
    cameras_of,
    check_square_pixels,
    inside,
    padding_remarks,
    pickled,
    read_obj,
)
from ..ga.method import check_mark, mark
from ..method import read_identity
from ..spec import FLASHAVATAR_OFFICIAL, FlashAvatarOfficialConfig
from ..video import (
    FlameSubject,
    PartsMethod,
    RenderCall,
    VisibleMesh,
    at_rest,
    check_masks,
    check_one_camera,
    frame_name,
    in_parts,
    same_intrinsics,
    straight_rgba,
    training_frames,
    write_torch,
)
from ..workplace import Listed, Patch, Workplace, copy_file, is_white, opaque, read_sized

SOURCES = (
    "*.py",
    *(f"{name}/*.py" for name in ("arguments", "flame", "gaussian_renderer", "scene", "src", "utils")),
)
"""Their program, which is run from a copy because it opens the eyelid bases beside its own file."""
MESH_FILE = Path("flame/FlameMesh.obj")
"""FLAME's triangles, more that close the lips, and their texture chart."""
UNCHANGED = (
    MESH_FILE,
    Path("flame/landmark_embedding.npy"),
    Path("flame/mediapipe/mediapipe_landmark_embedding.npz"),
)
MODEL_FILE, MASKS_FILE = Path("flame/generic_model.pkl"), Path("flame/FLAME_masks/FLAME_masks.pkl")
EYELID_FILES = (Path("flame/blendshapes/l_eyelid.npy"), Path("flame/blendshapes/r_eyelid.npy"))
FULL = 255
TURNS_AND_LIDS = 20
"""Inputs of their network for jaw, eyes and eyelids."""
TEXEL_SIDE = 0.5
"""Sides of a triangle of `chart_of_points`, texels: no other texel's centre lies in it."""
SMALLEST_WEIGHT = 1e-4
"""Smallest barycentric coordinate in `chart_of_points`, so that a texel's centre is inside its triangle also in float32."""


def has_their_topology(head: HeadAsset, folder: Path) -> bool:
    """Whether a head without its teeth has as many vertices as the mesh file of a checkout."""
    vertices, _ = read_obj(folder / MESH_FILE)
    return len(OfficialHead.numbered(head).order) == vertices


def flame_subject(subject: Subject, head: HeadAsset, checkout: Checkout, *, own_chart: bool) -> FlameSubject:
    """The head model, with its teeth if it has a chart of its own, and one identity."""
    for name in (BOUNDARY, MOUTH):
        region(head, name)
    if not own_chart:
        vertices, _ = read_obj(checkout.folder / MESH_FILE)
        return FlameSubject.of(head, subject, vertices, MESH_FILE)
    return FlameSubject.whole(head, subject)


def write_program(identity: Subject, head: HeadAsset, work: Workplace, *, own_chart: bool) -> FlameSubject:
    """Write their program and the files that it opens relative to its working directory or beside itself.

    With ``own_chart``, the mesh file is left to `write_points`. Returns the identity on the head model; raises the errors of
    `flame_subject`.
    """
    checkout, folder = work.checkout, work.program
    subject = flame_subject(identity, head, checkout, own_chart=own_chart)
    paths = [path for pattern in SOURCES for path in sorted(checkout.folder.glob(pattern))]
    unchanged = [name for name in UNCHANGED if not (own_chart and name == MESH_FILE)]
    for path in (*paths, *(checkout.folder / name for name in unchanged)):
        content = read_bytes(path, "a file of the program")
        write_bytes(folder / path.relative_to(checkout.folder), content)
    write_bytes(folder / MODEL_FILE, pickled(subject.model()))
    # Splats of a separate chart are those of the native method; none is left out.
    border = np.zeros(0, np.int64) if own_chart else subject.official.region(BOUNDARY)
    write_bytes(folder / MASKS_FILE, pickled({BOUNDARY: border}))
    subject.official.write_eyelids(*(folder / name for name in EYELID_FILES))
    return subject


def native_points(identity: Subject, head: HeadAsset, samples: int, seed: int) -> SurfacePoints:
    """The splats of the native method with these settings on this identity."""
    mesh = SubjectMesh(head, identity.shape, identity.static_offset, "cpu")
    vertices, chart = mesh.canonical.numpy().astype(np.float64), FlashAvatarConfig().uv_chart
    return spread_points(head, vertices, samples, seed, chart=chart, chart_without=head.regions.get(BOUNDARY))


def native_network(head: HeadAsset, seed: int) -> dict[str, Tensor]:
    """The native method's published network at the start, by the names of their layers.

    Their network has `EXPRESSION_SIZE` inputs for expressions, and two for eyelids. Those that the head model lacks have weights of 0.
    """
    config, size, inputs = FlashAvatarConfig(), head.expression_basis.shape[2], input_count(head, INPUTS)
    network = initial_network(network_sizes(config, inputs), seed)
    weights, biases = layer_names(config.layers + 1)
    split = [network[weights[0]].shape[1] - inputs + size, inputs - size]
    until, after = network[weights[0]].split(split, dim=1)
    network[weights[0]] = torch.cat(
        [pad(until, (0, EXPRESSION_SIZE - size)), pad(after, (0, TURNS_AND_LIDS - after.shape[1]))], 1
    )
    layers = [*(f"fcs.{layer}" for layer in range(config.layers)), "output_linear"]
    of_weights = {f"{layer}.weight": network[name] for layer, name in zip(layers, weights)}
    return of_weights | {f"{layer}.bias": network[name] for layer, name in zip(layers, biases)}


def grid_of(samples: int) -> int:
    """Side of a chart, texels, for about ``samples`` points, with a margin of a quarter."""
    return int(np.ceil(np.sqrt(1.25 * samples)))


def write_points(identity: Subject, head: HeadAsset, samples: int, seed: int, work: Workplace) -> None:
    """Write the mesh file of `chart_of_points` of the `native_points`."""
    points = native_points(identity, head, samples, seed)
    vertices, faces = np.asarray(head.template), np.asarray(head.faces)[points.triangles]
    chart = chart_of_points(vertices, faces, points.barycentric, grid_of(samples))
    write_text(work.program / MESH_FILE, chart)


def chart_of_points(vertices: FloatArray, faces: IntArray, barycentric: FloatArray, grid: int) -> str:
    """An OBJ file whose chart has one texel for each point, row by row from the top.

    A point's triangle of the mesh is listed once for the point, small in the chart and such that the centre of the texel has
    the point's barycentric coordinates.

    - ``vertices``, ``faces``, ``barycentric``: (V, 3) metres; (P, 3) triangle and (P, 3) barycentric coordinates of each point.
    - ``grid``: texels of a side.
    """
    if len(faces) > grid**2:
        raise InputError("head model", "points", f"at most {grid**2}, as many as texels", str(len(faces)))
    row, column = np.divmod(np.arange(len(faces)), grid)
    centers = np.column_stack([column + 0.5, grid - 0.5 - row])
    weights = np.maximum(barycentric, SMALLEST_WEIGHT)
    weights /= weights.sum(1, keepdims=True)
    around = weights[:, 1:]  # where the point is in the triangle (0, 0), (1, 0), (0, 1)
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) - around[:, None]
    uv = (centers[:, None] + TEXEL_SIDE * corners) / grid
    lines = ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices]
    lines += ["vt {:.9f} {:.9f}".format(*corner) for corner in uv.reshape(-1, 2)]
    at = np.arange(3 * len(faces)).reshape(-1, 3) + 1
    numbers = np.stack([faces + 1, at], axis=2).reshape(-1, 6)
    lines += ["f {}/{} {}/{} {}/{}".format(*six) for six in numbers]
    return "\n".join(lines) + "\n"


class ParsingMasks:
    """Masks of head with neck, and of the mouth, by the tracked mesh in place of a network that parses faces.

    The mouth is where the mesh shows lips, teeth or the inside of the mouth. Head and neck are the covered pixels that
    show the mesh above its boundary, and those beside the mesh (hair) whose nearest projected vertex is not on the
    boundary; shoulders and clothes are left out. With ``native`` masks head and neck are all covered pixels, and the mouth is
    that of the native method.
    """

    def __init__(self, head: HeadAsset, subject: FlameSubject, *, native: bool = False):
        self._native, self._lips = native, np.asarray(head.regions[MOUTH])
        self._mesh = VisibleMesh(head, subject.posed)
        self._mouth = mouth_triangles(head).numpy()
        self._below = touching(head, BOUNDARY)
        self._on_boundary = np.isin(np.arange(len(head.template)), head.regions[BOUNDARY])

    def of(self, pose: HeadPose, camera: Camera, coverage: ByteArray) -> tuple[ByteArray, ByteArray]:
        """(H, W) masks of head with neck, and of the mouth, 0 or 255, for a camera in the head's frame."""
        surface = self._mesh.seen(pose, camera, coverage)
        if self._native:
            hull = mouth_mask(camera, surface.vertices[self._lips], surface.vertices.mean(0))
            return FULL * (coverage > 0).astype(np.uint8), FULL * hull.astype(np.uint8)
        triangles = surface.triangles.clip(0)
        head, mouth = (np.zeros(coverage.shape, np.uint8) for _ in range(2))
        mouth[surface.rows, surface.columns] = FULL * (surface.hit & self._mouth[triangles])
        inside_head = surface.hit & ~self._below[triangles]
        beside = np.flatnonzero(~surface.hit)
        if len(beside):
            world = np.asarray(camera.world_to_camera, np.float64)
            points = (surface.vertices @ world[:3, :3].T + world[:3, 3]) @ np.asarray(camera.K, np.float64).T
            pixels = np.stack([surface.columns[beside], surface.rows[beside]], axis=1) + 0.5
            _, nearest = KDTree(points[:, :2] / points[:, 2:]).query(pixels)
            inside_head[beside] = ~self._on_boundary[nearest]
        head[surface.rows, surface.columns] = FULL * inside_head
        return head, mouth


def write_training(
    clip: Clip,
    subject: FlameSubject,
    name: str,
    work: Workplace,
    progress: Progress,
    *,
    native_masks: bool = False,
) -> dict[str, FrameKey]:
    """Write the training frames as an identity of this name, cut to the window with the principal point in its middle.

    Returns the key of every image by its path.
    """
    frames = training_frames(clip, subject.posed)
    masks = ParsingMasks(clip.head, subject, native=native_masks)
    images: dict[str, FrameKey] = {}
    for frame in frames:
        window = inside(frame.camera)
        pixels = straight_rgba(clip, frame.key)
        head, mouth = masks.of(frame.pose, frame.camera, pixels[..., 3])
        parts = (np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3]), head, mouth)
        for place, image in zip(image_names(name, frame.number), parts):
            write_png(work.program / place, window.cut(image))
            images[f"program/{place}"] = frame.key
        write_torch(work.program / tracked_name(name, frame.number), subject.frame(window.camera, frame.pose))
        progress(frame.number + 1, len(frames), "exporting")
    return images


def write_list(frames: Sequence[Listed], subject: FlameSubject, name: str, work: Workplace) -> None:
    """Write frames of one camera's intrinsics as an identity, in windows around their images.

    Images are marks, see `..ga.method.mark`; the renderer writes each beside the render. Masks have one pixel.
    """
    white, black = np.full((1, 1), FULL, np.uint8), np.zeros((1, 1), np.uint8)
    for index, frame in enumerate(at_rest(subject.posed, frames)):
        window = around(frame.camera).camera
        image = np.full((window.height, window.width, 3), mark(frame.number), np.uint8)
        for place, pixels in zip(image_names(name, index), (image, white, white, black)):
            write_png(work.program / place, pixels)
        write_torch(work.program / tracked_name(name, index), subject.frame(window, frame.pose))


def image_names(name: str, number: int) -> tuple[str, str, str, str]:
    """Paths of image, coverage, mask of head and neck, and mask of the mouth; their numbers begin with 1."""
    folder, place = f"dataset/{name}", f"{number + 1:05d}"
    masks = (f"{folder}/parsing/{place}_{mask}.png" for mask in ("neckhead", "mouth"))
    return (f"{folder}/imgs/{place}.jpg", f"{folder}/alpha/{place}.jpg", *masks)  # type: ignore[return-value]


def tracked_name(name: str, number: int) -> str:
    """Path of a frame's parameters, numbered from 0."""
    return f"metrical-tracker/output/{name}/{frame_name(number)}"


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
