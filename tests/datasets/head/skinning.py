"""Linear blend skinning by 4x4 matrices, written from FLAME's definition: independent of the head model under test."""

import numpy as np
from scipy.spatial.transform import Rotation

STILL = (0.0, 0.0, 0.0)


def skinned(
    head,
    expression=(),
    *,
    shape=(),
    offset=0.0,
    rotation=STILL,
    neck=STILL,
    jaw=STILL,
    eyes=STILL * 2,
    translation=STILL,
    eyelids=(0.0, 0.0),
):
    """(V, 3) float64 vertices of one pose, metres."""
    shaped = np.asarray(head.template, np.float64) + offset
    for basis, values in ((head.shape_basis, shape), (head.expression_basis, expression)):
        shaped = shaped + basis[:, :, : len(values)] @ np.asarray(values, np.float64)
    joints = head.joint_regressor @ shaped
    turns = [Rotation.from_rotvec(part).as_matrix() for part in (rotation, neck, jaw, eyes[:3], eyes[3:])]
    posed = shaped + head.pose_basis @ np.concatenate([(turn - np.eye(3)).ravel() for turn in turns[1:]])
    motions = []
    for joint, parent in enumerate((-1, 0, 1, 1, 1)):
        about = np.eye(4)
        about[:3, :3], about[:3, 3] = turns[joint], joints[joint] - turns[joint] @ joints[joint]
        motions.append(about if parent < 0 else motions[parent] @ about)
    result = np.zeros_like(posed)
    for weights, motion in zip(head.skinning_weights.T, motions):
        result += weights[:, None] * (posed @ motion[:3, :3].T + motion[:3, 3])
    if head.eyelid_basis is not None:
        result += (head.eyelid_basis @ np.asarray(eyelids, np.float64)) @ (turns[0] @ turns[1]).T
    return result + translation
