"""The mesh of one subject: canonical, posed and unposed vertices, and triangle frames."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from ...bench.contracts import FloatArray, HeadAsset, HeadPose
from ...datasets.head.arrays import check_size
from ...datasets.head.model import HeadModel
from . import avatar_kernel
from .binding import Frames, triangle_frames

Value = TypeVar("Value")


class SubjectMesh:
    """A head model with one identity. Only expression, pose and translation are left to drive it.

    Parameters
    ----------
    shape : (S,) identity coefficients.
    static_offset : (V, 3) metres, added to the shaped template.

    Raises
    ------
    InputError
        Where they make a mesh that is no head's by its size, see `check_size`.
    """

    def __init__(self, head: HeadAsset, shape: FloatArray, static_offset: FloatArray, device: str):
        self.model = HeadModel(head, device=device)
        self.faces = self.model.faces
        like = self.model.template
        self._canonical = self.model.canonical(
            torch.as_tensor(np.asarray(shape)).to(like), torch.as_tensor(np.asarray(static_offset)).to(like)
        )
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
        """Driving signal as tensors with a batch axis. Raises `InputError` for another head model's pose."""
        return self.model.pose_arguments(poses)

    def posed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(V, 3) vertices in the world for one timestep's arguments; differentiable in them."""
        return self.model(canonical=self._canonical, **arguments)[0]

    def unposed(self, arguments: Mapping[str, Tensor]) -> Tensor:
        """(V, 3) with expression, jaw and eyes (and eyelids) alone: no rotation, neck or translation."""
        still = {name: torch.zeros_like(arguments[name]) for name in ("rotation", "neck", "translation")}
        return self.posed({**arguments, **still})

    def frames(self, vertices: Tensor) -> Frames:
        """Triangle frames of a mesh; differentiable in its vertices."""
        if avatar_kernel.usable(vertices) and not (vertices.requires_grad and torch.is_grad_enabled()):
            return avatar_kernel.triangles(vertices, self.faces)
        return triangle_frames(vertices, self.faces)


def centroid_displacements(one: Tensor, other: Tensor, faces: Tensor) -> Tensor:
    """(F,) metres between the centroids of the triangles of two (V, 3) meshes."""
    moved = (one - other).index_select(0, faces.reshape(-1)).view(-1, 3, 3).mean(1)
    return torch.linalg.vector_norm(moved, dim=1)


class BoundedCache(Generic[Value]):
    """Values by key, computed when asked for, the least recently used dropped beyond a number of entries."""

    def __init__(self, compute: Callable[[int], Value], entries: int):
        self._compute, self._entries = compute, max(entries, 1)
        self._values: OrderedDict[int, Value] = OrderedDict()

    def __call__(self, key: int) -> Value:
        if key in self._values:
            self._values.move_to_end(key)
            return self._values[key]
        value = self._values[key] = self._compute(key)
        if len(self._values) > self._entries:
            self._values.popitem(last=False)
        return value

    def __len__(self) -> int:
        return len(self._values)
