"""A clip of a painted procedural head, drawn by the z-buffer: cheap enough to test every behaviour."""

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from headbench.bench.contracts import FrameKey
from headbench.datasets.mesh_pictures import draw_mesh, portrait_camera
from headbench.datasets.steps.tongue.mouth import posed_meshes
from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.plan import load_geometry

SKIN = np.array([0.62, 0.36, 0.22])  # linear reflectance
LIPS = SKIN * [0.86, 0.5, 0.5]
INSIDE = np.array([0.055, 0.012, 0.012])
TONGUE = np.array([0.45, 0.15, 0.14])
BLUSH = np.array([1.04, 0.80, 0.81])


@dataclass(frozen=True)
class Moment:
    """One timestep: controls of the face, colour of everything, what lies before the mouth."""

    controls: dict[str, float] = field(default_factory=dict)
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    lip_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    lines: float = 0.0  # how dark the chin's wrinkles are
    blob: np.ndarray | None = None  # colour of a disc before the face
    drop: float = 0.010  # metres of the disc's middle below the line between the lips
    radius: float = 0.011


@dataclass(frozen=True, eq=False)
class PaintedClip:
    """As much of a `Clip` as the detector looks at."""

    head: Any
    shape: np.ndarray
    static_offset: np.ndarray
    cameras: dict[str, Any]
    poses: dict[int, Any]
    splits: dict[str, tuple[FrameKey, ...]]
    images: dict[FrameKey, np.ndarray]
    subject: str = "900"
    excluded: dict[FrameKey, str] = field(default_factory=dict)

    def image(self, key):
        return self.images[key]


@cache
def geometry():
    return load_geometry("procedural")


def painted_clip(moments, *, yaws=(0.0, 0.35), tracking_mm=0.0, seed=0):
    """Draw the moments from cameras at ``yaws`` radians; the clip's poses are off by ``tracking_mm`` RMS."""
    head, translation = geometry().head, geometry().translation
    rng = np.random.default_rng(seed)
    shape = 0.5 * rng.standard_normal(head.shape_basis.shape[2])
    rest = dict.fromkeys(CONTROLS, 0.0)
    poses = {t: translation.pose(rest | m.controls, "900", t) for t, m in enumerate(moments)}
    offset = np.zeros(head.template.shape)
    blank = PaintedClip(head, shape, offset, {}, poses, {}, {})
    meshes = dict(posed_meshes(blank, list(poses)))
    around = meshes[0][head.regions["lips"]]
    low, high = around.min(axis=0) - 0.045, around.max(axis=0) + 0.03
    cameras = {
        f"at{index}": replace(portrait_camera(np.array([low, high]), 96, 96, yaw=yaw), id=f"at{index}")
        for index, yaw in enumerate(yaws)
    }
    images = {}
    for t, moment in enumerate(moments):
        vertices, faces, colours = _dress(moment, meshes[t])
        for name, camera in cameras.items():
            picture = draw_mesh(vertices, faces, camera, _display(colours), shading=0.0)
            noisy = picture + rng.normal(0.0, 1.5, picture.shape)
            images[FrameKey("900", "FREE", t, name)] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    if tracking_mm:
        shifts = rng.normal(0.0, tracking_mm * 1e-3 / np.sqrt(3), (len(poses), 3))
        poses = {t: replace(pose, translation=pose.translation + shifts[t]) for t, pose in poses.items()}
    return PaintedClip(head, shape, offset, cameras, poses, {"train": tuple(images)}, images)


def _dress(moment, vertices):
    """Mesh and linear vertex colours of a moment, with the disc before the mouth if it has one."""
    head = geometry().head
    colours = np.tile(SKIN, (len(vertices), 1))
    colours[head.regions["lips"]] = LIPS * moment.lip_tint
    colours[head.regions["mouth_socket"]] = INSIDE
    colours *= moment.tint
    chin = np.zeros(len(vertices), bool)
    chin[head.regions["face"]] = True
    chin[head.regions["lips"]] = False
    template = head.template
    chin &= (template[:, 1] < template[head.regions["lips"], 1].min()) & (np.arange(len(vertices)) % 3 == 0)
    colours[chin] *= 1.0 - moment.lines
    if moment.blob is None:
        return vertices, head.faces, colours
    upper, lower = (vertices[head.regions[f"lip_outside_ring_{part}"]] for part in ("upper", "lower"))
    middle = 0.5 * (upper + lower)[len(upper) // 2]
    depth = np.concatenate([upper, lower])[:, 2].max() + 0.004
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(24)], axis=1) * moment.radius
    disc = np.concatenate([np.zeros((1, 3)), rim]) + [middle[0], middle[1] - moment.drop, depth]
    fan = np.stack([np.zeros(24, int), np.arange(1, 25), np.roll(np.arange(1, 25), -1)], axis=1)
    return (
        np.concatenate([vertices, disc]),
        np.concatenate([head.faces, fan + len(vertices)]),
        np.concatenate([colours, np.tile(moment.blob, (len(disc), 1))]),
    )


def _display(linear):
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
