"""Linear blend skinning in loops, written from the definition of FLAME: independent of the head model under test."""

import numpy as np
from scipy.spatial.transform import Rotation

PARENTS = (-1, 0, 1, 1, 1)


def skinned(head, expression, *, jaw=(0, 0, 0), eyes=(0,) * 6, eyelids=(0, 0), shape=None):
    """(V, 3) vertices of a head that does not move as a whole, metres."""
    neutral = np.asarray(head.template, np.float64)
    if shape is not None:
        neutral = neutral + head.shape_basis @ shape
    shaped = neutral + head.expression_basis[:, :, : len(expression)] @ np.asarray(expression, np.float64)
    joints = head.joint_regressor @ shaped
    turns = [np.eye(3), np.eye(3)]
    turns += [Rotation.from_rotvec(part).as_matrix() for part in (jaw, eyes[:3], eyes[3:])]
    feature = np.concatenate([(turn - np.eye(3)).ravel() for turn in turns[1:]])
    posed = shaped + head.pose_basis @ feature
    motions = []
    for joint, parent in enumerate(PARENTS):
        local = np.eye(4)
        local[:3, :3] = turns[joint]
        local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
        motions.append(local if parent < 0 else motions[parent] @ local)
    result = np.zeros_like(posed)
    for joint, motion in enumerate(motions):
        moved = (posed - joints[joint]) @ motion[:3, :3].T + motion[:3, 3]
        result += head.skinning_weights[:, joint, None] * moved
    if head.eyelid_basis is not None:
        result += head.eyelid_basis @ np.asarray(eyelids, np.float64)
    return result
