"""Export of videos and lists of frames for FlashAvatar's loader, in the layout of its page.

Of an identity NAME: ``metrical-tracker/output/NAME/checkpoint/00000.frame``, numbered from 0, and
``dataset/NAME/imgs/00001.jpg``, ``alpha/00001.jpg``, ``parsing/00001_neckhead.png`` and ``parsing/00001_mouth.png``,
whose numbers are one higher. Images are PNG under these names; the loader recognises the format by the content. It
takes identity, image size and focal lengths from frame 0, and the principal point to be the middle of the image.

With the CPU shim, a head of another topology than FLAME's has a mesh file of its own, whose chart has one texel for each
splat of the native method (`chart_of_points`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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
    FrameKey,
    HeadAsset,
    HeadPose,
    IntArray,
    Progress,
)
from ....bench.errors import InputError
from ....bench.io.files import read_bytes, write_bytes, write_text
from ....bench.io.images import write_png
from ....datasets.head.arrays import region
from ...flashavatar.config import FlashAvatarConfig
from ...flashavatar.method import BOUNDARY, MOUTH
from ...flashavatar.model import INPUTS, network_sizes
from ...insta.warp import mouth_triangles, touching
from ...shared.avatar_files import Subject
from ...shared.networks import initial_network, input_count, layer_names
from ...shared.subject_mesh import SubjectMesh, mouth_mask
from ...shared.surface_points import SurfacePoints, spread_points
from ..checkout import Checkout
from ..ga.export import mark
from ..ga.head_files import EXPRESSION_SIZE, OfficialHead, pickled, read_obj
from ..ga.windows import around, inside
from ..surface import VisibleMesh
from ..video import FlameSubject, at_rest, frame_name, straight_rgba, training_frames, write_torch
from ..workplace import Listed, Workplace

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
        found = self._mesh.seen(pose, camera, coverage)
        if self._native:
            hull = mouth_mask(camera, found.vertices[self._lips], found.vertices.mean(0))
            return FULL * (coverage > 0).astype(np.uint8), FULL * hull.astype(np.uint8)
        triangles = found.triangles.clip(0)
        head, mouth = (np.zeros(coverage.shape, np.uint8) for _ in range(2))
        mouth[found.rows, found.columns] = FULL * (found.hit & self._mouth[triangles])
        inside_head = found.hit & ~self._below[triangles]
        beside = np.flatnonzero(~found.hit)
        if len(beside):
            world = np.asarray(camera.world_to_camera, np.float64)
            points = (found.vertices @ world[:3, :3].T + world[:3, 3]) @ np.asarray(camera.K, np.float64).T
            pixels = np.stack([found.columns[beside], found.rows[beside]], axis=1) + 0.5
            _, nearest = KDTree(points[:, :2] / points[:, 2:]).query(pixels)
            inside_head[beside] = ~self._on_boundary[nearest]
        head[found.rows, found.columns] = FULL * inside_head
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

    Images are marks, see `..ga.export.mark`; the renderer writes each beside the render. Masks have one pixel.
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
