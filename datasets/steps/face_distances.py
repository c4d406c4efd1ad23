"""How far apart the expressions of a performance are, and a few timesteps that lie near all the others."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from ...bench.contracts import Clip, FloatArray, HeadAsset, IntArray, Progress, no_progress
from ...bench.errors import InputError
from ..head.model import HeadModel

FACE_REGION, EYE_REGION = "face", "eye_region"
EYE_WEIGHT = 2.0

_MESH_BATCH = 64
_BLOCK = 16
"""Meshes compared with one at a time: few enough for their differences to stay in the processor's cache."""


class Landmarks(NamedTuple):
    """Meshes that stand for all."""

    indices: IntArray
    """(m,) which meshes they are, in the order of choice; distinct."""
    distances: FloatArray
    """(N, m) float32 distance of every mesh to each of them, metres."""
    radius: float
    """Distance, metres, within which every mesh has a landmark."""


def expression_displacements(clip: Clip, timesteps: Sequence[int]) -> FloatArray:
    """(T, 3, F) float32 displacements of the face's F vertices from the neutral face, metres.

    Meshes keep jaw, eyes and expression and lose rotation, neck and translation; vertices of the eye region
    count `EYE_WEIGHT` times. Raises `InputError` where the head has no region "face".
    """
    vertices, weights = _face_vertices(clip.head)
    model = HeadModel(clip.head)
    canonical = model.canonical(_tensor(clip.shape), _tensor(clip.static_offset))
    neutral = canonical[:, vertices]
    result = np.empty((len(timesteps), 3, len(vertices)), dtype=np.float32)
    for start in range(0, len(timesteps), _MESH_BATCH):
        part = slice(start, start + _MESH_BATCH)
        arguments = model.pose_arguments([clip.poses[timestep] for timestep in timesteps[part]])
        for name in ("rotation", "neck", "translation"):
            arguments[name] = torch.zeros_like(arguments[name])
        with torch.no_grad():
            meshes = model(canonical=canonical, **arguments)[:, vertices]
            result[part] = ((meshes - neutral) * weights[:, None]).transpose(1, 2).numpy()
    return result


def mean_vertex_distances(meshes: FloatArray) -> FloatArray:
    """(N, N) float32 mean over vertices of the Euclidean distance among (N, 3, F) meshes, each pair once."""
    result = np.zeros((len(meshes), len(meshes)), dtype=np.float32)

    def fill(start: int) -> None:
        # Columns in blocks: a block stays in the cache while every mesh before its end is compared with it.
        block = meshes[start : start + _BLOCK]
        for row in range(min(start + _BLOCK, len(meshes))):
            result[row, start : start + _BLOCK] = _distances_to(block, meshes[row])

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(fill, range(0, len(meshes), _BLOCK)))
    upper = np.triu(result, 1)
    return upper + upper.T


def farthest_meshes(
    meshes: FloatArray, limit: int, *, seed: int = 0, tolerance: float = 0.0, progress: Progress = no_progress
) -> Landmarks:
    """Greedy farthest-point sampling: from a mesh drawn at random, each time the one farthest from those chosen.

    By the triangle inequality the distance of any two meshes differs from that of their landmarks by the sum of
    their distances to these, at most twice the radius. Memory grows with N times ``limit``, never with N squared.

    Parameters
    ----------
    meshes : (N, 3, F) float32, N at least 1.
    limit : largest number of landmarks.
    tolerance : stop where the radius is at most this fraction of the largest distance found.
    """
    count = min(limit, len(meshes))
    columns = np.empty((count, len(meshes)), dtype=np.float32)
    nearest = np.full(len(meshes), np.inf, dtype=np.float32)
    chosen = [int(np.random.default_rng(seed).integers(len(meshes)))]
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for step in range(count):
            compare = partial(_distances_to, mesh=meshes[chosen[-1]])
            row = columns[step]
            row[:] = np.concatenate(list(pool.map(compare, np.array_split(meshes, torch.get_num_threads()))))
            np.minimum(nearest, row, out=nearest)
            progress(step + 1, count, "landmarks")
            if step + 1 == count or nearest.max() <= tolerance * columns[: step + 1].max():
                break
            chosen.append(int(nearest.argmax()))
    return Landmarks(np.array(chosen), columns[: len(chosen)].T, float(nearest.max()))


def _distances_to(meshes: FloatArray, mesh: FloatArray) -> FloatArray:
    """(N,) float32 mean vertex distances of (N, 3, F) meshes to one."""
    result = np.empty(len(meshes), dtype=np.float32)
    difference = np.empty((_BLOCK, *mesh.shape), dtype=np.float32)
    length = np.empty((_BLOCK, mesh.shape[1]), dtype=np.float32)
    for start in range(0, len(meshes), _BLOCK):
        block = meshes[start : start + _BLOCK]
        delta, norm = difference[: len(block)], length[: len(block)]
        # Differences first: the product form |a|^2 - 2ab + |b|^2 loses what sets neighbouring frames apart.
        np.subtract(block, mesh, out=delta)
        np.einsum("nkf,nkf->nf", delta, delta, out=norm)
        np.mean(np.sqrt(norm, out=norm), axis=1, out=result[start : start + _BLOCK])
    return result


def _face_vertices(head: HeadAsset) -> tuple[IntArray, torch.Tensor]:
    """Face vertices and their weights."""
    face = head.regions.get(FACE_REGION)
    if face is None or not len(face):
        known = ", ".join(sorted(head.regions)) or "none"
        raise InputError(
            f"head model {head.version}",
            f"regions[{FACE_REGION}]",
            "the face's vertices",
            f"regions {known}",
            "For FLAME, give FLAME_masks.pkl as masks=.",
        )
    eyes = np.isin(face, head.regions.get(EYE_REGION, np.array([], dtype=int)))
    return face, torch.from_numpy(np.where(eyes, EYE_WEIGHT, 1.0).astype(np.float32))


def _tensor(array: FloatArray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float32))
