"""Google's GNM Head as a head in FLAME's layout.

"GNM Head: A Generative aNthropometric Model of the human head", arXiv 2607.23687; the names of the arrays and the
order of the operations are those of the authors' code, https://github.com/google/GNM (``gnm/shape/gnm_xnp.py``,
``gnm_common.py``).

Like FLAME it is a sum of bases, posed by linear blend skinning. The differences are converted without loss:

* its joints are the neck, which is the root, the head and the eyes: they are FLAME's root, neck and eyes;
* it has no jaw joint, because expressions move the lower teeth: FLAME's jaw becomes a joint without influence on any vertex;
* its joints follow the identity alone, FLAME's the vertices: a regressor with the same joints is found here.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from ...bench.contracts import FloatArray, IntArray
from ...bench.errors import InputError
from ...bench.io.arrays import MAX_MAGNITUDE, TEXT, Member, check_arrays
from .arrays import JOINT_NAMES, HeadArrays

JOINTS = ("neck", "head", "left_eye", "right_eye")
"""Names of the file's joints, in order; the parent of each is the one before it, that of both eyes the head."""
PLACES = tuple(JOINT_NAMES.index(name) for name in ("root", "neck", "left_eye", "right_eye"))
"""The corresponding joint of the layout for each of them."""

MEMBER_WEIGHT = 1e-4
"""Weight in a vertex group above which a vertex is a member, as in the authors' code."""
JOINT_TOLERANCE = 1e-8
"""Tolerance of joint positions, metres per unit of a coefficient: a hundredth of a micrometre."""

_RIDGE, _REFINEMENTS = 1e-10, 4
_MOST_DIRECTIONS = 2000
"""Identity and expression directions together; GNM's are 636. Memory grows with their square, to 0.3 GB."""
_KEYS = {
    "version": TEXT,
    "variant": TEXT,
    "template_vertex_positions": Member("f", ("V", 3), MAX_MAGNITUDE),
    "template_joint_positions": Member("f", ("J", 3), MAX_MAGNITUDE),
    "vertex_identity_basis": Member("f", ("I", "V", 3), MAX_MAGNITUDE),
    "joint_identity_basis": Member("f", ("I", "J", 3), MAX_MAGNITUDE),
    "expression_basis": Member("f", ("E", "V", 3), MAX_MAGNITUDE),
    "joint_names": Member("U", ("J",)),
    "joint_parent_indices": Member("iu", ("J",)),
    "skinning_weights": Member("f", ("J", "V"), MAX_MAGNITUDE),
    "triangles": Member("iu", ("F", 3)),
    "joint_regressor": Member("f", ("J", "V"), MAX_MAGNITUDE),
    "pose_correctives_regressor": Member("f", (9 * len(JOINTS), None), MAX_MAGNITUDE),
    "vertex_groups": Member("f", ("G", "V"), MAX_MAGNITUDE),
    "vertex_group_names": Member("U", ("G",)),
    "triangle_uvs": Member("f", ("F", 3, 2), MAX_MAGNITUDE),
}


def is_gnm(content: Mapping[str, np.ndarray]) -> bool:
    """Whether the members of an npz look like GNM's."""
    return {"template_vertex_positions", "vertex_identity_basis", "joint_identity_basis"} <= set(content)


def gnm_head(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> HeadArrays:
    """GNM Head in FLAME's layout: metres, +y up, +z front, as in the file.

    Parameters
    ----------
    file : str | PathLike[str]
        Named in errors.
    content : Mapping[str, np.ndarray]
        Members of the npz: V vertices, F triangles, J = 4 joints, I identity and E expression directions, and G groups of
        vertices, of which those with a counterpart in FLAME's masks become regions.

    Returns
    -------
    HeadArrays
        Head whose vertices are those of GNM at equal coefficients, at any pose with ``rotation``, ``neck`` and ``eyes`` as
        the rotations of GNM's neck, head and eyes. ``jaw`` moves nothing. It has no landmarks, which GNM has in another file.
        Skin, eyes, teeth and tongue have separate charts, which overlap.

    Raises
    ------
    InputError
        A member is missing or inconsistent, the joints are others, the root has pose correctives, or no
        regressor gives the file's joints.
    """
    sizes = check_arrays(file, content, _KEYS, {"J": len(JOINTS)})
    if str(content["variant"]) != "head":
        raise InputError(file, "variant", "'head'", repr(str(content["variant"]))[:80])
    names, parents = content["joint_names"].tolist(), content["joint_parent_indices"].astype(int).tolist()
    if tuple(names) != JOINTS or parents[1:] != [0, 1, 1]:
        expected = f"{', '.join(JOINTS)} with parents 0, 1 and 1 of the last three"
        raise InputError(file, "joint_names", expected, f"{', '.join(map(str, names))[:200]} with {parents}")
    vertices, directions = sizes["V"], sizes["I"] + sizes["E"]
    if not vertices:
        raise InputError(file, "template_vertex_positions", "at least one vertex", "none")
    if directions > _MOST_DIRECTIONS:
        expected = f"at most {_MOST_DIRECTIONS} directions with those of expression_basis"
        raise InputError(file, "vertex_identity_basis", expected, f"{directions}")
    correctives = content["pose_correctives_regressor"]
    if correctives.shape[1] != 3 * vertices:
        raise InputError(
            file, "pose_correctives_regressor", f"{3 * vertices} columns", f"{correctives.shape[1]}"
        )
    if correctives[:9].any():
        expected = "zeros in the rows of the neck, whose rotation turns the whole head"
        raise InputError(file, "pose_correctives_regressor", expected, "others")
    pose_basis = np.zeros((vertices, 3, 9 * (len(JOINT_NAMES) - 1)), np.float32)
    weights = np.zeros((vertices, len(JOINT_NAMES)))
    regressor = np.zeros((len(JOINT_NAMES), vertices))
    regressor[list(PLACES)] = _regressor(file, content)
    # The jaw, which no vertex follows, is in the middle of the head.
    regressor[JOINT_NAMES.index("jaw")] = regressor[JOINT_NAMES.index("neck")]
    for joint, place in enumerate(PLACES):
        weights[:, place] = content["skinning_weights"][joint]
        if place:  # the layout has no pose correctives for the root
            block = correctives[9 * joint : 9 * joint + 9].reshape(9, vertices, 3)
            pose_basis[:, :, 9 * (place - 1) : 9 * place] = np.moveaxis(block, 0, 2)
    return HeadArrays(
        version=f"gnm-head-{content['version']}",
        template=content["template_vertex_positions"].astype(np.float64),
        faces=content["triangles"].astype(np.int64),
        shape_basis=np.ascontiguousarray(np.moveaxis(content["vertex_identity_basis"], 0, 2)),
        expression_basis=np.ascontiguousarray(np.moveaxis(content["expression_basis"], 0, 2)),
        pose_basis=pose_basis,
        joint_regressor=regressor,
        skinning_weights=weights,
        parents=np.array([-1, 0, 1, 1, 1]),
        regions=_regions(content),
        uv=content["triangle_uvs"],
    ).validate(file)


def _regressor(file: str | PathLike[str], content: Mapping[str, np.ndarray]) -> FloatArray:
    """(4, V) weights that give the file's joints at any identity and any expression.

    The regressor of the file, changed as little as possible (in the sum of squares) so that it gives the joints of the
    mean head, their change by each identity direction, none by any expression, and rows that sum to 1.
    """
    template = content["template_vertex_positions"].astype(np.float64)
    regressor = content["joint_regressor"].astype(np.float64)
    vertices, joints = len(template), len(regressor)

    def rows(values: np.ndarray, count: int) -> FloatArray:
        """(k, n, 3) as (3 k, n)."""
        return np.moveaxis(values.astype(np.float64), 2, 1).reshape(-1, count)

    motions = (content["vertex_identity_basis"], content["expression_basis"])
    given = [np.ones((1, vertices)), template.T, *(rows(motion, vertices) for motion in motions)]
    still = np.zeros((3 * len(motions[1]), joints))
    joints_at = content["template_joint_positions"].astype(np.float64)
    moved = rows(content["joint_identity_basis"], joints)
    matrix, wanted = np.concatenate(given), np.concatenate([np.ones((1, joints)), joints_at.T, moved, still])
    missing = wanted - matrix @ regressor.T
    if np.abs(missing).max() > JOINT_TOLERANCE:
        scale = np.linalg.norm(matrix, axis=1, keepdims=True)
        scale[scale == 0] = 1  # a direction without effect
        matrix, wanted = matrix / scale, wanted / scale
        gram = matrix @ matrix.T
        gram[np.diag_indices(len(gram))] += _RIDGE
        factor = cho_factor(gram, overwrite_a=True)
        for _ in range(_REFINEMENTS):
            regressor += cho_solve(factor, wanted - matrix @ regressor.T).T @ matrix
        missing = (wanted - matrix @ regressor.T) * scale
        if not np.abs(missing).max() <= JOINT_TOLERANCE:
            expected = "joints that some weights of the vertices give at every identity and expression"
            raise InputError(file, "joint_identity_basis", expected, f"{np.abs(missing).max():.2g} m off")
    return regressor


_REGIONS = {
    "face": ("hockey_mask", "skin_exterior"),
    "left_ear": ("ears", "left"),
    "right_ear": ("ears", "right"),
    "nose": ("nose_region",),
    "left_eyeball": ("left_eye",),
    "right_eyeball": ("right_eye",),
    "teeth": ("teeth",),
    "teeth_upper": ("teeth", "upper_teeth_and_gums"),
    "teeth_lower": ("teeth", "lower_teeth_and_gums"),
    "tongue": ("tongue",),
}
"""Groups of the file whose intersection is a region. Regions with a missing group are left out."""
_LIPS = ("upper_lip", "lower_lip")


def _regions(content: Mapping[str, np.ndarray]) -> dict[str, IntArray]:
    names = content["vertex_group_names"].tolist()
    groups = dict(zip(names, content["vertex_groups"] > MEMBER_WEIGHT))
    found = {
        region: np.logical_and.reduce([groups[part] for part in parts])
        for region, parts in _REGIONS.items()
        if all(part in groups for part in parts)
    }
    if all(part in groups for part in _LIPS):
        found["lips"] = np.logical_or.reduce([groups[part] for part in _LIPS])
        if "face" in found:
            found["face"] = found["face"] | (found["lips"] & groups["skin_exterior"])
    return {name: np.flatnonzero(members) for name, members in found.items() if members.any()}
