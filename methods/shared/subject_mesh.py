"""The mesh of one subject: canonical, posed and unposed vertices, and triangle frames."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import BoolArray, Camera, Clip, FloatArray, HeadAsset, HeadPose
from ...datasets.head.arrays import check_size
from ...datasets.head.geometry import project
from ...datasets.head.model import HeadModel
from ..ops.mesh import TriangleFrames, triangle_frames

Value = TypeVar("Value")


class SubjectMesh:
    """A head model with fixed identity, driven by expression, pose and translation.

    - ``shape``: (S,) identity coefficients.
    - ``static_offset``: (V, 3) metres, added to the shaped template.
    """

    def __init__(self, head: HeadAsset, shape: FloatArray, static_offset: FloatArray, device: str):
        self.model = HeadModel(head, device=device)
        self.faces = self.model.faces
        like = self.model.template
        # Copies: a clip's arrays are read-only and shared by all methods.
        identity, offset = (torch.tensor(np.asarray(each)).to(like) for each in (shape, static_offset))
        self._canonical = self.model.canonical(identity, offset)
        check_size(
            "subject", "shape, static_offset", self._canonical[0].cpu().numpy(), np.asarray(head.faces)
        )

    @property
    def version(self) -> str:
        """Head model version; poses must carry the same."""
        return self.model.version

    @property
    def canonical(self) -> Tensor:
        """(V, 3) subject with zero expression, pose and translation."""
        return self._canonical[0]

    def arguments(self, poses: Sequence[HeadPose]) -> dict[str, Tensor]:
        """Driving signal as tensors with a batch axis. Raises `InputError` for a pose of another head model."""
        return self.model.pose_arguments(poses)

    def posed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(V, 3) vertices in the world for one timestep's arguments; differentiable in them."""
        return self.model(canonical=self._canonical, **arguments)[0]

    def unposed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(V, 3) with only expression, jaw and eyes (and eyelids), without rotation, neck and translation."""
        still = {name: torch.zeros_like(arguments[name]) for name in ("rotation", "neck", "translation")}
        return self.posed({**arguments, **still})

    def frames(self, vertices: Tensor) -> TriangleFrames:
        """Triangle frames of a mesh; differentiable in its vertices."""
        return triangle_frames(vertices, self.faces)

    @torch.no_grad()
    def drive(self, pose: HeadPose) -> TriangleFrames:
        """Triangle frames of a pose in the world. Raises `InputError` for another head model's pose."""
        return self.frames(self.posed(self.arguments([pose])))


class TrainingPoses:
    """Tracked values of the training timesteps of a clip, as arguments of its subject's mesh.

    - ``row``: row of each timestep, in rising order.
    - ``arguments``: (T, n) values by name, as `SubjectMesh.arguments` gives them.
    """

    def __init__(self, clip: Clip, mesh: SubjectMesh):
        timesteps = sorted({key.timestep for key in clip.splits["train"]})
        self.row = {timestep: row for row, timestep in enumerate(timesteps)}
        self.arguments = mesh.arguments([clip.poses[timestep] for timestep in timesteps])

    def at(self, row: int) -> dict[str, Tensor]:
        """The arguments of one timestep, with a batch axis."""
        return {name: values[row : row + 1] for name, values in self.arguments.items()}


def centroid_displacements(one: Tensor, other: Tensor, faces: Tensor) -> Tensor:
    """(F,) metres between the centroids of the triangles of two (V, 3) meshes."""
    moved = (one - other).index_select(0, faces.reshape(-1)).view(-1, 3, 3).mean(1)
    return torch.linalg.vector_norm(moved, dim=1)


class BoundedCache(Generic[Value]):
    """LRU cache: values by key, computed on request, with a maximum number of entries."""

    def __init__(self, compute: Callable[[int], Value], entries: int):
        self._compute, self._entries = compute, max(entries, 1)
        self._values: OrderedDict[int, Value] = OrderedDict()

    def __call__(self, key: int) -> Value:
        if key not in self._values:
            self._values[key] = self._compute(key)
            if len(self._values) > self._entries:
                self._values.popitem(last=False)
        self._values.move_to_end(key)
        return self._values[key]

    def __len__(self) -> int:
        return len(self._values)


DRIVING = ("expression", "rotation", "neck", "jaw", "eyes", "translation", "eyelids")


def pose_key(pose: HeadPose) -> bytes:
    """All values of a pose as a key."""
    parts = [pose.head_model.encode()]
    for name in DRIVING:
        values = getattr(pose, name)
        parts.append(b"-" if values is None else np.asarray(values, np.float64).tobytes())
    return b"|".join(parts)


def mouth_mask(camera: Camera, mouth: FloatArray, middle: FloatArray) -> BoolArray:
    """(H, W) mask of the pixels within the convex hull of the (M, 3) projected points of the mouth.

    Empty if the mouth faces away, seen from the ``middle`` (3,) of the head, or is not in front of the camera.
    """
    mask, center = np.zeros((camera.height, camera.width), np.uint8), mouth.mean(0)
    depths = mouth @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    if depths.min() > 0 and (center - middle) @ (camera.center - center) > 0:
        import cv2  # not everywhere where methods are trained

        # cv2 counts from the centre of the first pixel, cameras from its corner.
        corners = np.round(project(mouth, camera) - 0.5).clip(-(2**15), 2**15).astype(np.int32)
        cv2.fillConvexPoly(mask, cv2.convexHull(corners), 1)
    return mask.astype(bool)
