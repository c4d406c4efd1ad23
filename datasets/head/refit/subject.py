"""A head with one identity: its meshes and rigid motions, float64 in numpy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ....bench.contracts import FloatArray, HeadAsset, HeadPose
from ..model import HeadModel


class Subject:
    """One identity of a head model.

    Parameters
    ----------
    head : the model.
    shape : (S,) identity coefficients.
    static_offset : (V, 3) metres.
    """

    def __init__(self, head: HeadAsset, shape: FloatArray, static_offset: FloatArray):
        self._model = HeadModel(head, dtype=torch.float64)
        shape, offset = np.asarray(shape, dtype=np.float64), np.asarray(static_offset, dtype=np.float64)
        self._identity = {"shape": torch.from_numpy(shape), "static_offset": torch.from_numpy(offset)}
        self._canonical = self._model.canonical(**self._identity)

    @property
    def version(self) -> str:
        """Of the head model."""
        return self._model.version

    @property
    def neutral(self) -> FloatArray:
        """(V, 3) unposed head, metres."""
        return np.asarray(self._canonical[0].numpy())

    def meshes(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, V, 3) vertices in the world, metres. Raises `InputError` for poses of another model."""
        arguments = self._model.pose_arguments(poses)
        return np.asarray(self._model(canonical=self._canonical, **arguments).numpy())

    def motions(self, poses: Sequence[HeadPose]) -> FloatArray:
        """(T, 4, 4) rigid motion of the head: from the frame with the neck joint at rest to the world."""
        arguments = self._model.pose_arguments(poses)
        moving = {name: arguments[name] for name in ("expression", "rotation", "neck", "translation")}
        return np.asarray(self._model.head_transform(**self._identity, **moving).numpy())
