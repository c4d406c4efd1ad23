"""ICT-FaceKit Light as a head in FLAME's layout: its scan-derived shapes on a fitted jaw, neck and eye rig.

Li et al., "Learning Formation of Physically-Based Face Attributes", CVPR 2020. The kit has blendshapes and no
skeleton, so the skeleton is fitted here:

* jaw: the hinge that best explains how ``jawOpen`` moves the lower teeth; every vertex follows it by the
  share of its displacement that the hinge explains, and the rest becomes a pose corrective;
* eyes: centres of the spheres through the back of the eyeballs;
* neck and root: centres of the neck's cross-section half-way and at its base, blended along the neck.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike

import numpy as np

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, Member, check_arrays
from ..rounding import LENGTH_BITS, REGRESSOR_BITS, SHARE_BITS, on_grid
from .arrays import HeadArrays
from .geometry import fit_sphere, smoothstep
from .ict_regions import MeshParts, Profile, landmark_names, mesh_parts, regions_of
from .rigging import (
    Hinge,
    fit_hinge,
    hinge_correctives,
    hinge_weights,
    regressor_row,
)

VERSION = "ict-facekit"
JAW_SHAPE = "jawOpen"
DROPPED_SHAPES = (JAW_SHAPE, "mouthClose")
"""Not in the expression basis: the jaw joint replaces the first, the second only corrects the first."""

_METRES = 0.01
_SOFTNESS = 0.004  # metres; see hinge_weights
_LARGEST = MAX_MAGNITUDE / _METRES  # centimetres
_KEYS = {
    "v_neutral": Member("f", ("V", 3), _LARGEST),
    "tri_v": Member("iu", ("F", 3)),
    "tri_material": Member("iu", ("F",)),
    "material_names": Member("U", ("M",)),
    "expr_names": Member("U", ("E",)),
    "expr_deltas": Member("f", ("E", "V", 3), _LARGEST),
    "id_deltas": Member("f", ("S", "V", 3), _LARGEST),
    "idx_to_landmark_verts": Member("iu", (len(landmark_names()),)),
}


def is_ict(content: Mapping[str, np.ndarray]) -> bool:
    """Whether the members of an npz look like ICT-FaceKit's."""
    return {"v_neutral", "expr_deltas", "id_deltas"} <= set(content)


def expression_names(content: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Names of the columns of the expression basis, in order."""
    return tuple(str(name) for name in content["expr_names"] if str(name) not in DROPPED_SHAPES)


def ict_head(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> HeadArrays:
    """Rig the kit: metres, +y up, +z front, origin amid the head.

    Parameters
    ----------
    file : named in errors.
    content : members of the npz: ``v_neutral`` and deltas in centimetres, triangles with materials, names,
        landmark vertices.

    Returns
    -------
    A head with one identity direction per mode (metres per standard deviation), one expression direction per
    shape but those of `DROPPED_SHAPES` (coefficients in [0, 1]), and 68 named landmarks.

    Raises
    ------
    InputError
        Where a member is missing or does not fit the others, or the mesh has not the kit's parts.
    """
    _check(file, content)
    try:
        return _rigged(file, content).validate(file)
    except (ValueError, IndexError, ArithmeticError, np.linalg.LinAlgError) as error:
        expected = "the mesh of ICT-FaceKit, whose parts can be told apart"
        raise InputError(file, "", expected, f"one whose rig cannot be fitted ({error})"[:400]) from error


def _rigged(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> HeadArrays:
    faces = content["tri_v"].astype(np.int64)
    landmarks = content["idx_to_landmark_verts"].astype(np.int64)
    names = [str(name) for name in content["expr_names"]]
    jaw_open = content["expr_deltas"][names.index(JAW_SHAPE)].astype(np.float64) * _METRES
    materials = {
        str(name): np.unique(faces[content["tri_material"] == index])
        for index, name in enumerate(content["material_names"])
    }
    neutral = content["v_neutral"].astype(np.float64) * _METRES
    template = neutral - _middle_of_head(neutral, landmarks)
    parts = mesh_parts(file, template, faces, materials, jaw_open)
    profile = Profile.of(template, landmarks)

    hinge = fit_hinge(template[parts.teeth_lower], template[parts.teeth_lower] + jaw_open[parts.teeth_lower])
    weights = on_grid(_weights(template, jaw_open, hinge, parts, profile), SHARE_BITS)
    correctives = np.zeros((len(template), 3, 36))
    # The second joint's block: the root has none, the neck has the first.
    correctives[:, :, 9:18] = hinge_correctives(hinge, template, jaw_open, weights[:, 2])
    kept = [index for index, name in enumerate(names) if name not in DROPPED_SHAPES]
    return HeadArrays(
        version=VERSION,
        template=template,
        faces=faces,
        shape_basis=_basis(content["id_deltas"]),
        expression_basis=_basis(content["expr_deltas"][kept]),
        pose_basis=on_grid(correctives, LENGTH_BITS).astype(np.float32),
        joint_regressor=on_grid(_regressor(template, hinge, parts, profile), REGRESSOR_BITS),
        skinning_weights=weights,
        parents=np.array([-1, 0, 1, 1, 1]),
        regions=regions_of(template, faces, parts, profile, landmarks),
        landmarks=dict(zip(landmark_names(), landmarks.tolist())),
    )


def fitted_jaw(head: HeadArrays, displacement: FloatArray) -> Hinge:
    """The hinge of a rigged kit, from ``jawOpen``'s displacement (V, 3) in metres; its angle opens the jaw."""
    teeth = head.regions["teeth_lower"]
    return fit_hinge(head.template[teeth], head.template[teeth] + displacement[teeth])


def _check(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> None:
    sizes = check_arrays(file, content, _KEYS)
    for key, bound in (
        ("tri_v", sizes["V"]),
        ("tri_material", sizes["M"]),
        ("idx_to_landmark_verts", sizes["V"]),
    ):
        if content[key].size == 0 or not 0 <= content[key].min() <= content[key].max() < bound:
            raise InputError(file, key, f"indices from 0 to {bound - 1}", "others, or none")
    if JAW_SHAPE not in content["expr_names"]:
        found = ", ".join(map(str, content["expr_names"]))[:400]
        raise InputError(file, "expr_names", f"a shape {JAW_SHAPE}", found)


def _middle_of_head(vertices: FloatArray, landmarks: IntArray) -> FloatArray:
    """Middle of the bounding box of what lies above the chin."""
    above = vertices[vertices[:, 1] > vertices[landmarks[8], 1]]
    return 0.5 * (above.min(0) + above.max(0))


def _basis(deltas: FloatArray) -> FloatArray:
    """(K, V, 3) centimetres to (V, 3, K) float32 metres."""
    return np.ascontiguousarray(np.moveaxis(deltas.astype(np.float32) * np.float32(_METRES), 0, 2))


def _weights(
    template: FloatArray, jaw_open: FloatArray, hinge: Hinge, parts: MeshParts, profile: Profile
) -> FloatArray:
    """(V, 5) skinning weights, rows sum to 1."""
    jaw = hinge_weights(hinge, template, jaw_open, _SOFTNESS)
    jaw[parts.teeth_lower], jaw[parts.teeth_upper] = 1, 0
    on_neck = smoothstep(profile.height(template), profile.neck_base, profile.neck_top)
    inside = np.concatenate([parts.teeth, parts.gums_and_tongue, parts.mouth_socket])
    on_neck[inside] = 1  # what is in the mouth hangs on the head, however low it reaches
    still = np.zeros_like(jaw)
    weights = np.stack([1 - on_neck, on_neck * (1 - jaw), on_neck * jaw, still, still], axis=1)
    weights[parts.left_eyeball] = [0, 0, 0, 1, 0]
    weights[parts.right_eyeball] = [0, 0, 0, 0, 1]
    return weights


def _regressor(template: FloatArray, hinge: Hinge, parts: MeshParts, profile: Profile) -> FloatArray:
    """(5, V) joint regressor: each joint from the vertices around it."""
    skin = np.concatenate([parts.face_material, parts.outer_back])
    height = profile.height(template[skin])
    rows = []
    for level in (profile.neck_base, 0.5 * (profile.neck_base + profile.neck_top)):
        ring = np.unique(skin[np.abs(height - level) < 0.05 * profile.length])
        spread = template[ring]
        rows.append(regressor_row(template, ring, 0.5 * (spread.min(0) + spread.max(0))))
    rows.append(regressor_row(template, _around_axis(template, skin, hinge), hinge.center))
    for eyeball in (parts.left_sclera, parts.right_sclera):
        center, _ = fit_sphere(template[eyeball])
        back = eyeball[template[eyeball, 2] < center[2]]  # without the bulge of the cornea
        center, _ = fit_sphere(template[back])
        rows.append(regressor_row(template, back, center))
    return np.stack(rows)


def _around_axis(template: FloatArray, skin: IntArray, hinge: Hinge, each_side: int = 60) -> IntArray:
    """The vertices of the skin nearest to the hinge's axis, as many on either side."""
    distance = np.linalg.norm(template[skin, 1:] - hinge.center[1:], axis=1)
    sides = [skin[template[skin, 0] > 0], skin[template[skin, 0] < 0]]
    distances = [distance[template[skin, 0] > 0], distance[template[skin, 0] < 0]]
    nearest = [side[np.argsort(away)[:each_side]] for side, away in zip(sides, distances)]
    return np.unique(np.concatenate(nearest))
