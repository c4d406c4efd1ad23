"""The default head in both versions, and a small independent forward pass of FLAME's equations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.procedural.surface import load_sculpture


@pytest.fixture(scope="session")
def heads():
    return {version: procedural_head(version) for version in ("procedural2020", "procedural2023")}


@pytest.fixture(scope="session")
def head(heads):
    return heads["procedural2023"]


@pytest.fixture(scope="session")
def surface():
    return load_sculpture()


@pytest.fixture(scope="session")
def pose():
    """Linear blend skinning written out anew, float64: (head, expression, jaw, shape) -> vertices."""

    def apply(head, expression=None, jaw=(0.0, 0.0, 0.0), shape=None):
        vertices = head.template.astype(np.float64)
        if expression is not None:
            vertices = vertices + head.expression_basis.astype(np.float64) @ expression
        if shape is not None:
            vertices = vertices + head.shape_basis.astype(np.float64) @ shape
        joints = head.joint_regressor.astype(np.float64) @ vertices
        turn = Rotation.from_rotvec(jaw).as_matrix()
        feature = np.zeros(head.pose_basis.shape[2])
        feature[9:18] = (turn - np.eye(3)).ravel()
        vertices = vertices + head.pose_basis @ feature
        weight = head.skinning_weights[:, 2:3].astype(np.float64)
        return (1 - weight) * vertices + weight * ((vertices - joints[2]) @ turn.T + joints[2])

    return apply
