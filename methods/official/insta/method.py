"""INSTA by its authors' code.

Zielonka, Bolkart, Thies, "Instant Volumetric Head Avatars", CVPR 2023. Their program is C++ and CUDA, built on
instant-ngp. It takes a scene and a configuration, trains, records the frames of the scene's test split, and ends.

The program reads the format of Metrical Tracker with ``generate.sh``: ``transforms_train.json`` (camera-to-world with OpenCV's axes,
metres; intrinsics of each frame), ``images`` with straight alpha, ``meshes``, ``flame/exp``, ``depth`` (16 bits, millimetres),
``seg_mask`` (a class in the red channel), ``canonical.obj``; and ``mesh_masks``, which it opens relative to its working directory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ....bench.contracts import (
    ByteArray,
    Camera,
    Clip,
    FloatArray,
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
    Progress,
)
from ....bench.errors import InputError
from ....bench.io.files import read_bytes, write_bytes, write_json, write_text
from ....datasets.head.model import BATCH, PosedSubject, pose_in_head_frame
from ....datasets.images import write_image
from ...insta.marching import bare_triangles, mouth_triangles
from ...insta.spec import InstaConfig
from ...shared.avatar_files import SUBJECT_FILE, Subject
from ...shared.loop import Fit
from ...shared.surface_points import pose_key
from ..checkout import Checkout, Environment, Repository, inspect_program
from ..ga.head_files import cameras_of, read_obj, without_teeth
from ..method import read_identity
from ..spec import INSTA_OFFICIAL, INSTAOfficialConfig
from ..video import (
    PartsMethod,
    RenderCall,
    VisibleMesh,
    at_rest,
    check_masks,
    check_no_skew,
    in_parts,
    straight_rgba,
    training_frames,
)
from ..workplace import Listed, Workplace, copy_file, write_placeholder

MASKS: Mapping[str, tuple[str, ...]] = {
    "lips": ("lips", "mouth_socket"),
    "right_ear": ("right_ear",),
    "left_ear": ("left_ear",),
    "eye_region": ("eye_region",),
    "boundary": ("boundary",),
    "face": ("face",),
}
"""Their meshes that mark a region by red vertices, and regions of the head; a vertex of several belongs to the
first."""
MASK_FOLDER = "mesh_masks"
SKIN, MOUTH, HAIR = 250, 140, 80
"""Classes of pixels: losses of the mouth have a larger weight, and classes up to 90 have no depth loss."""
CONDITIONS = 16
"""Expression coefficients that the network reads; their program assumes that a file has as many."""
REACH = 0.45
"""Maximum distance of vertices from the head's origin, metres: their scene is a cube of one metre, with a margin
around the head."""
MILLIMETRES, FARTHEST = 1000, 65_535
TRAIN, TEST, CANONICAL = "transforms_train.json", "transforms_test.json", "canonical.obj"
PLACEHOLDER = "images/placeholder.png"
PART = 1000
"""Maximum number of frames in one call, since all their meshes are in GPU memory."""


@dataclass(frozen=True, eq=False)
class VideoMesh:
    """A head model and one identity for their program: meshes without teeth, with the static offset."""

    head: HeadAsset
    posed: PosedSubject
    """The clip's own, with teeth if it has them."""
    kept: IntArray
    """(V',) vertices of their mesh."""
    faces: IntArray
    """(F', 3) triangles in their numbering."""
    masks: Mapping[str, bytes]
    """Files of regions, by name."""
    is_flames: bool
    """Whether vertices are FLAME's, so that triangles and regions are the official ones."""

    @classmethod
    def of(cls, subject: Subject, head: HeadAsset, checkout: Checkout) -> VideoMesh:
        """Raises `InputError` for a head outside their scene."""
        posed = PosedSubject(head, subject.shape, subject.static_offset)
        kept, faces = without_teeth(head)
        farthest = float(np.abs(posed.neutral[kept]).max())
        if farthest > REACH:
            expected = f"vertices within {REACH} m of the origin along each axis, as FLAME's are"
            raise InputError(f"head model {head.version!r}", "template", expected, f"{farthest:.3g} m")
        files = {
            name: read_bytes(checkout.folder / MASK_FOLDER / f"{name}.obj", "an OBJ file") for name in MASKS
        }
        vertices, theirs = read_obj(checkout.folder / MASK_FOLDER / "lips.obj")
        if vertices == len(kept) and len(theirs) and 0 <= theirs.min() and theirs.max() < len(kept):
            return cls(head, posed, kept, theirs, files, True)
        return cls(head, posed, kept, faces, _masks(head, kept, faces, posed.neutral), False)

    def write_masks(self, folder: Path) -> None:
        """Write the files of regions below the program's working directory."""
        for name, content in self.masks.items():
            write_bytes(folder / MASK_FOLDER / f"{name}.obj", content)

    def write_canonical(self, folder: Path) -> None:
        """Write the canonical mesh: no expression, with the jaw opened as by the tracker."""
        rest, still = np.zeros(3), np.zeros(self.head.expression_basis.shape[2])
        jaw = np.array([InstaConfig().jaw_opening, 0.0, 0.0])
        pose = HeadPose(self.head.version, still, rest, rest, jaw, np.zeros(6), rest)
        self.write(folder / CANONICAL, self.posed.meshes([pose])[0])

    def write(self, path: Path, vertices: FloatArray) -> None:
        """Write a mesh of the clip's head."""
        write_text(path, _vertices(vertices[self.kept]) + _triangles(self.faces))

    def write_poses(self, folder: Path, poses: Mapping[str, HeadPose]) -> None:
        """Write mesh and expression of each frame, by the frame's name; equal poses are written once and linked."""
        at_rest = {name: pose_in_head_frame(pose) for name, pose in poses.items()}
        first: dict[bytes, str] = {}
        for name, pose in at_rest.items():
            first.setdefault(pose_key(pose), name)
        written = [*first.values()]
        for start in range(0, len(written), BATCH):
            names = written[start : start + BATCH]
            for name, mesh in zip(names, self.posed.meshes([at_rest[name] for name in names])):
                self.write(folder / mesh_name(name), mesh)
        for name, pose in at_rest.items():
            values = np.zeros(max(CONDITIONS, len(pose.expression)))
            values[: len(pose.expression)] = pose.expression
            write_text(folder / expression_name(name), "".join(f"{value:.8f}\n" for value in values))
            source = first[pose_key(pose)]
            if source != name:
                (folder / mesh_name(name)).symlink_to(Path(mesh_name(source)).name)


def _vertices(vertices: FloatArray, colours: IntArray | None = None) -> str:
    rows = vertices if colours is None else np.hstack([vertices, colours])
    line = "v" + " {:.8g}" * rows.shape[1] + "\n"
    return "".join(line.format(*row) for row in rows.tolist())


def _triangles(faces: IntArray) -> str:
    return "".join("f {} {} {}\n".format(*face) for face in (faces + 1).tolist())


def _masks(head: HeadAsset, kept: IntArray, faces: IntArray, neutral: FloatArray) -> dict[str, bytes]:
    """Meshes whose red vertices are a region's."""
    taken = np.zeros(len(head.template), bool)
    files = {}
    for name, regions in MASKS.items():
        inside = np.zeros(len(head.template), bool)
        for region in regions:
            inside[np.asarray(head.regions.get(region, ()), dtype=np.int64)] = True
        inside &= ~taken
        taken |= inside
        colours = np.where(inside[kept, None], [1, 0, 0], [0, 0, 1])
        files[name] = (_vertices(neutral[kept], colours) + _triangles(faces)).encode()
    return files


def mesh_name(name: str) -> str:
    """Path of a frame's mesh; their program orders frames by these names."""
    return f"meshes/{name}.obj"


def expression_name(name: str) -> str:
    """Path of a frame's expression coefficients."""
    return f"flame/exp/{name}.txt"


def frame_name(number: int) -> str:
    """Name of a frame in a folder; names sort by number."""
    return f"{number:06d}"


def write_training(clip: Clip, head: VideoMesh, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
    """Write the training frames, and a placeholder as the split that their program renders at the end.

    The placeholder has an image of one pixel, and pose and camera of the first training frame. Depths and classes of
    pixels are those of the mesh instead of those of a tracker and a face parsing network. Returns the key of every
    other image by its path.
    """
    frames = training_frames(clip, head.posed)
    surfaces = _Surfaces(head)
    images: dict[str, FrameKey] = {}
    records = []
    head.write_canonical(work.input)
    head.write_poses(work.input, {frame_name(frame.number): frame.pose for frame in frames})
    for frame in frames:
        name, pixels = frame_name(frame.number), straight_rgba(clip, frame.key)
        classes, depth = surfaces.seen(frame.pose, frame.camera, pixels[..., 3])
        for part, image in (("images", pixels), ("seg_mask", classes), ("depth", depth)):
            write_image(work.input / f"{part}/{name}.png", image)
            images[f"input/{part}/{name}.png"] = frame.key
        parts = {"depth_path": f"depth/{name}.png", "seg_mask_path": f"seg_mask/{name}.png"}
        records.append({**record(name, frame.camera, f"images/{name}.png"), **parts})
        progress(frame.number + 1, len(frames), "exporting")
    write_placeholder(work.input / PLACEHOLDER)
    shared = {**intrinsics(frames[0].camera), "integer_depth_scale": 1 / MILLIMETRES}
    write_json(work.input / TRAIN, {**shared, "frames": records})
    last = record(frame_name(0), frames[0].camera, PLACEHOLDER)
    write_json(work.input / TEST, {**shared, "frames": [last]})
    return images


class _Surfaces:
    """Classes of pixels and depths by the mesh visible in a clip's frames."""

    def __init__(self, head: VideoMesh):
        self._mesh = VisibleMesh(head.head, head.posed)
        mouth, bare = mouth_triangles(head.head).numpy(), bare_triangles(head.head).numpy()
        self._classes = np.select([mouth, bare], [MOUTH, SKIN], HAIR).astype(np.uint8)

    def seen(self, pose: HeadPose, camera: Camera, coverage: ByteArray) -> tuple[ByteArray, np.ndarray]:
        """(H, W, 3) class in the red channel and (H, W) uint16 depth, millimetres along the axis; 0 for background.

        Covered pixels beside the mesh are hair.
        """
        surface = self._mesh.seen(pose, camera, coverage)
        classes = np.zeros((*coverage.shape, 3), np.uint8)
        classes[surface.rows, surface.columns, 0] = np.where(
            surface.hit, self._classes[surface.triangles.clip(0)], HAIR
        )
        depth = np.zeros(coverage.shape, np.uint16)
        millimetres = np.rint(np.where(surface.hit, MILLIMETRES * surface.depths, 0))
        depth[surface.rows, surface.columns] = millimetres.clip(0, FARTHEST)
        return classes, depth


def record(name: str, camera: Camera, image: str, *, height: int | None = None) -> dict[str, Any]:
    """A frame of their JSON, its camera in the head's frame.

    ``height`` is the height of the image if it differs from the camera's: their program takes focal lengths relative
    to it.
    """
    return {
        "transform_matrix": np.linalg.inv(np.asarray(camera.world_to_camera, np.float64)).tolist(),
        "file_path": image,
        "mesh_path": mesh_name(name),
        "exp_path": expression_name(name),
        **intrinsics(camera, (height or camera.height) / camera.height),
    }


def intrinsics(camera: Camera, scale: float = 1.0) -> dict[str, float]:
    """Size, focal lengths times ``scale`` and principal point, pixels; the last is read as a fraction of the size."""
    K = np.asarray(camera.K, np.float64)
    return {
        "w": float(camera.width),
        "h": float(camera.height),
        "fl_x": scale * float(K[0, 0]),
        "fl_y": scale * float(K[1, 1]),
        "cx": float(K[0, 2]),
        "cy": float(K[1, 2]),
    }


def write_list(frames: Sequence[Listed], head: VideoMesh, work: Workplace) -> list[dict[str, Any]]:
    """Write frames to render, in folders of one image size and at most `PART` frames each; return a list of the
    folders.

    Each entry has ``folder``, ``width``, ``height`` and the ``numbers`` of its frames in order. Images have one pixel:
    rendering reads none, and their program would keep all of them in GPU memory.
    """
    for frame in frames:
        check_no_skew(frame.camera)
    parts: list[dict[str, Any]] = []
    for part in in_parts(frames, lambda frame: (frame.camera.width, frame.camera.height), PART):
        folder = f"part_{len(parts):04d}"
        cameras = [frame.camera for frame in at_rest(head.posed, part)]
        names = [frame_name(index) for index in range(len(part))]
        head.write_canonical(work.input / folder)
        head.write_poses(work.input / folder, dict(zip(names, (frame.pose for frame in part))))
        write_placeholder(work.input / folder / PLACEHOLDER)
        records = [record(n, c, PLACEHOLDER, height=1) for n, c in zip(names, cameras)]
        write_json(work.input / folder / TEST, {"frames": records})
        size = {"width": cameras[0].width, "height": cameras[0].height}
        parts.append({"folder": folder, **size, "numbers": [frame.number for frame in part]})
    return parts


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
