"""Files of the layout of GNM Head for tests, made of a head in FLAME's layout, and GNM's vertices by its definition."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from headbench.datasets.head.arrays import HeadArrays

from .toy import toy_head

_ROWS = [0, 1, 3, 4]  # root, neck, eyes


def gnm_content(head: HeadArrays | None = None, *, blind: bool = False) -> dict[str, np.ndarray]:
    """The arrays of ``gnm_head.npz`` of a head.

    Its jaw's skinning weights go to GNM's head joint; pose correctives are those of the neck and the eyes. With
    ``blind`` the expressions do not move the vertices that the joints depend on.
    """
    head = head or toy_head(version="source")
    regressor = head.joint_regressor[_ROWS]
    expression = np.array(head.expression_basis)
    if blind:
        expression[regressor.any(axis=0)] = 0
    weights = head.skinning_weights.copy()
    weights[:, 1] += weights[:, 2]
    count = len(head.template)
    correctives = np.zeros((36, count, 3))
    for joint, place in ((1, 1), (2, 3), (3, 4)):
        block = head.pose_basis[:, :, 9 * place - 9 : 9 * place]
        correctives[9 * joint : 9 * joint + 9] = np.moveaxis(block, 2, 0)
    groups = {
        "hockey_mask": head.regions["face"],
        "skin_exterior": np.setdiff1d(np.arange(count), _eyeballs(head)),
        "upper_lip": head.regions["lips"][::2],
        "lower_lip": head.regions["lips"][1::2],
        "left_eye": head.regions["left_eyeball"],
        "right_eye": head.regions["right_eyeball"],
    }
    members = np.zeros((len(groups), count), np.float32)
    for row, vertices in zip(members, groups.values()):
        row[vertices] = 1
    names = {
        "identity_names": [f"head_{index:03d}" for index in range(head.shape_basis.shape[2])],
        "expression_names": [f"lower_face_region_{index:03d}" for index in range(expression.shape[2])],
        "joint_names": ["neck", "head", "left_eye", "right_eye"],
        "mesh_component_names": ["skin", "left_eye", "right_eye"],
        "vertex_group_names": list(groups),
        "version": "3.0",
        "variant": "head",
    }
    return {
        **{name: np.array(values) for name, values in names.items()},
        "template_vertex_positions": head.template.astype(np.float32),
        "template_joint_positions": regressor @ head.template.astype(np.float32),
        "vertex_identity_basis": np.moveaxis(head.shape_basis, 2, 0).astype(np.float32),
        "joint_identity_basis": np.moveaxis(
            np.einsum("jv,vci->jci", regressor, head.shape_basis.astype(np.float32)), 2, 0
        ),
        "expression_basis": np.moveaxis(expression, 2, 0).astype(np.float32),
        "joint_parent_indices": np.array([0, 0, 1, 1], np.int32),
        "skinning_weights": weights[:, _ROWS].T.astype(np.float32),
        "triangle_uvs": np.random.default_rng(1).random((len(head.faces), 3, 2)).astype(np.float32),
        "triangles": head.faces.astype(np.int32),
        "joint_regressor": regressor,
        "pose_correctives_regressor": correctives.reshape(36, -1).astype(np.float32),
        "vertex_groups": members,
    }


def write_gnm(path: Path, content: dict[str, np.ndarray] | None = None) -> Path:
    """A file of the layout of GNM Head."""
    np.savez(path, allow_pickle=False, **(content or gnm_content()))
    return path


def gnm_vertices(content, identity, expression, rotations, translation) -> np.ndarray:
    """(V, 3) vertices by the definition of GNM: identity (I,), expression (E,), rotations (4, 3), translation (3,)."""
    shaped = content["template_vertex_positions"].astype(np.float64)
    shaped = shaped + np.tensordot(identity, content["vertex_identity_basis"], 1)
    shaped = shaped + np.tensordot(expression, content["expression_basis"], 1)
    joints = content["template_joint_positions"] + np.tensordot(identity, content["joint_identity_basis"], 1)
    turns = Rotation.from_rotvec(rotations).as_matrix()
    features = (turns - np.eye(3)).reshape(-1)
    shaped = shaped + (features @ content["pose_correctives_regressor"]).reshape(-1, 3)
    worlds: list[np.ndarray] = []
    for joint, parent in enumerate(content["joint_parent_indices"]):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - joints[parent] if joint else joints[0] + translation
        worlds.append(worlds[parent] @ local if joint else local)
    result = np.zeros_like(shaped)
    for weight, world, joint in zip(content["skinning_weights"].astype(np.float64), worlds, joints):
        moved = (shaped - joint) @ world[:3, :3].T + world[:3, 3]
        result += weight[:, None] * moved
    return result


def _eyeballs(head: HeadArrays) -> np.ndarray:
    return np.concatenate([head.regions["left_eyeball"], head.regions["right_eyeball"]])
