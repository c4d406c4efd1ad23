"""What training data say about the capacity an avatar needs: motion and size of the surface in pixels.

Only cameras and tracked poses of training frames are read, no image; a plan takes seconds.
"""

from __future__ import annotations

import numpy as np
import torch

from ....bench.contracts import Clip, FloatArray, HeadPose
from ....datasets.head.arrays import JOINT_NAMES
from ....datasets.steps.jaw_bases import IDENTITY, farthest_quaternions, jaw_quaternions
from ...shared.subject_mesh import SubjectMesh, centroid_displacements

_BLOCK = 64  # timesteps whose displacement fields are held at once


def pixel_footprint(clip: Clip, center: FloatArray) -> float:
    """Metres that a pixel covers on the head: the median over training frames of depth over focal length.

    Parameters
    ----------
    center : (3,) centre of the canonical head, metres; each pose's translation is added.
    """
    sizes = []
    for key in clip.splits["train"]:
        camera = clip.cameras[key.camera]
        point = center + np.asarray(clip.poses[key.timestep].translation, dtype=np.float64)
        depth = camera.world_to_camera[2, :3] @ point + camera.world_to_camera[2, 3]
        sizes.append(abs(depth) / np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return float(np.median(sizes))


def largest_displacements(mesh: SubjectMesh, poses: list[HeadPose]) -> FloatArray:
    """(F,) metres: how far expression, jaw and eyes take a triangle's centroid from the canonical mesh, at most."""
    largest = torch.zeros(len(mesh.faces), device=mesh.faces.device)
    with torch.no_grad():
        for pose in poses:
            unposed = mesh.unposed(mesh.arguments([pose]))
            moved = centroid_displacements(unposed, mesh.canonical, mesh.faces)
            largest = torch.maximum(largest, moved.to(largest))
    return largest.cpu().numpy()


def leading_directions(coefficients: FloatArray, basis: FloatArray, tolerance: float) -> int:
    """How many leading expression directions suffice.

    A constant expression needs no direction, as what does not change is not dynamic: deviations from the mean over
    the timesteps count.

    Parameters
    ----------
    coefficients : (T, E) of the training timesteps.
    basis : (V, 3, E) metres per unit.
    tolerance : metres.

    Returns
    -------
    The least K such that leaving out the directions from K on, or from any later one on, displaces no vertex by more
    than the tolerance in any timestep.
    """
    deviation, columns = _deviation(coefficients), _columns(basis)
    needed = 0
    for start in range(0, len(deviation), _BLOCK):
        block = deviation[start : start + _BLOCK]
        field = np.zeros((len(block), len(columns)), np.float32)
        for last in range(basis.shape[2] - 1, needed - 1, -1):
            field += block[:, last, None] * columns[None, :, last]
            if _longest(field) > tolerance:
                needed = last + 1
                break
    return needed


def displacement_without(coefficients: FloatArray, basis: FloatArray, kept: int) -> float:
    """Metres that leaving out the directions from ``kept`` on displaces a vertex, at most; as above."""
    deviation, columns = _deviation(coefficients)[:, kept:], _columns(basis)[:, kept:]
    blocks = range(0, len(deviation), _BLOCK)
    return max(_longest(deviation[start : start + _BLOCK] @ columns.T) for start in blocks)


def _deviation(coefficients: FloatArray) -> FloatArray:
    exact = np.asarray(coefficients, np.float64)
    return (exact - exact.mean(0)).astype(np.float32)


def _columns(basis: FloatArray) -> FloatArray:
    return np.asarray(basis, np.float32).reshape(-1, basis.shape[2])


def _longest(field: FloatArray) -> float:
    """Largest length among the vectors of (T, 3 V) fields."""
    return float(np.sqrt((field.reshape(len(field), -1, 3) ** 2).sum(2).max()))


def jaw_lever(mesh: SubjectMesh) -> float:
    """Metres from the jaw joint to the vertex it moves most: skinning weight times distance, at most."""
    model = mesh.model
    joint = JOINT_NAMES.index("jaw")
    canonical = mesh.canonical
    center = model.joint_regressor[joint] @ canonical
    distance = torch.linalg.vector_norm(canonical - center, dim=1)
    return float((model.skinning_weights[:, joint] * distance).max())


def spanning_jaw_bases(
    poses: list[HeadPose], limit: int, lever: float, tolerance: float
) -> tuple[int, float]:
    """How many jaw bases suffice, and what the rotations that they do not reach move.

    The weights |<q, q_i>| on the bases are linear in the quaternion q but for their common scale, so that lines
    for bases with the same span can say the same: four at most are ever needed, two for a jaw that only opens. A
    residual r of a unit quaternion is a rotation by 2 asin(r), which moves a vertex by 2 r times its lever.

    Returns
    -------
    Number of bases, at most ``limit``, of the farthest-point order of `jaw_bases`, and metres. None are needed
    where no training pose moves a vertex by more than the tolerance from the mean jaw rotation.
    """
    candidates = jaw_quaternions(poses)
    mean = candidates.mean(0)
    rest = 2 * lever * _residual(candidates, (mean / np.linalg.norm(mean))[None])
    if rest <= tolerance:
        return 0, rest
    bases = farthest_quaternions(candidates, IDENTITY, limit)
    for count in range(1, len(bases) + 1):
        rest = 2 * lever * _residual(candidates, bases[:count])
        if rest <= tolerance:
            return count, rest
    return len(bases), rest


def _residual(quaternions: FloatArray, bases: FloatArray) -> float:
    """Largest distance of (N, 4) unit quaternions from the span of (n, 4) bases."""
    _, sizes, rows = np.linalg.svd(bases, full_matrices=False)
    rows = rows[sizes > 1e-9 * sizes[0]]
    return float(np.linalg.norm(quaternions - quaternions @ rows.T @ rows, axis=1).max())


def surface_area(vertices: FloatArray, faces: FloatArray) -> float:
    """Square metres of a mesh."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
