"""A reader as somebody outside writes it: captures in one npz each, nothing imported but headbench's root."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from headbench import Camera, DatasetSpec, FrameKey, HeadPose, InputError

ARRAYS = ("images", "intrinsics", "world_to_camera", "expressions", "vertices", "triangles")
HELD_OUT = 1
"""The last camera and the last timestep are held out."""


@dataclass(frozen=True, eq=False)
class FixedHead:
    """A mesh with expressions and nothing that turns."""

    template: np.ndarray
    faces: np.ndarray
    expression_basis: np.ndarray
    version: str = "fixed"
    eyelid_basis: None = None
    parents: np.ndarray = field(default_factory=lambda: np.array([-1, 0, 1, 1, 1]))

    @property
    def shape_basis(self):
        return np.zeros((len(self.template), 3, 1))

    @property
    def pose_basis(self):
        return np.zeros((len(self.template), 3, 36))

    @property
    def joint_regressor(self):
        return np.full((5, len(self.template)), 1 / len(self.template))

    @property
    def skinning_weights(self):
        return np.eye(1, 5).repeat(len(self.template), axis=0)

    @property
    def regions(self):
        return {}


class NpzClip:
    """A clip over the arrays of one file."""

    background = np.ones(3)
    steps = ()

    def __init__(self, path, arrays):
        self.subject, self._arrays, self.excluded = Path(path).stem, arrays, {}
        timesteps, views, height, width = arrays["images"].shape[:4]
        names = [f"view{i}" for i in range(views)]
        self.cameras = {
            name: Camera(name, width, height, arrays["intrinsics"][i], arrays["world_to_camera"][i])
            for i, name in enumerate(names)
        }
        zero = np.zeros(3)
        self.poses = {
            t: HeadPose(
                "fixed",
                expression=arrays["expressions"][t],
                rotation=zero,
                neck=zero,
                jaw=zero,
                eyes=np.zeros(6),
                translation=zero,
                subject=self.subject,
                timestep=t,
            )
            for t in range(timesteps)
        }
        last, kept = timesteps - HELD_OUT, names[:-HELD_OUT]

        def keys(times, cameras):
            return tuple(
                FrameKey(self.subject, "talk" if t < last else "rest", t, c) for t in times for c in cameras
            )

        self.splits = {
            "train": keys(range(last), kept),
            "novel_view": keys(range(last), names[-HELD_OUT:]),
            "self_reenactment": keys(range(last, timesteps), names),
        }

    @cached_property
    def head(self):
        vertices = self._arrays["vertices"]
        basis = np.zeros((len(vertices), 3, self._arrays["expressions"].shape[1]))
        return FixedHead(vertices, self._arrays["triangles"], basis)

    @property
    def shape(self):
        return np.zeros(1)

    @property
    def static_offset(self):
        return np.zeros_like(self._arrays["vertices"])

    @property
    def fingerprint(self):
        parts = (np.ascontiguousarray(self._arrays[name]).tobytes() for name in ARRAYS)
        return hashlib.sha256(b"".join(parts)).hexdigest()

    def image(self, key):
        return self._arrays["images"][key.timestep, list(self.cameras).index(key.camera)].copy()

    def mask(self, key):
        return None


def find(root):
    return sorted(Path(root).glob("*.npz"))


def read(path, *, dark: bool = False):
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in ARRAYS}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(path, "", "an npz capture", str(error)) from error
    if dark:
        arrays["images"] = arrays["images"] // 2
    return NpzClip(path, arrays)


SPEC = DatasetSpec("npz", "One npz a capture.", "outside_reader:read", find="outside_reader:find")
