"""Teeth, gums and tongue lie in the mouth, and the tongue comes out of it."""

import numpy as np
import pytest

from headbench.datasets.head.geometry import border_edges
from headbench.datasets.head.procedural.sculpture import lip_arc
from headbench.datasets.synthetic.parts import (
    ARCH_REACH,
    LOWER_WIDTHS,
    UPPER_WIDTHS,
    arch_length,
    dental_arch,
    render_parts,
    tongue,
)


@pytest.fixture(scope="module")
def parts(head):
    return {part.name: part for part in render_parts(head)}


def test_parts_hang_rigidly_on_one_joint(parts):
    for name, part in parts.items():
        joint = 1 if name.startswith("upper") else 2
        assert np.all(part.skinning_weights[:, joint] == 1)
        assert part.skinning_weights.sum() == len(part.vertices)
        assert part.faces.min() == 0
        assert part.faces.max() == len(part.vertices) - 1


@pytest.mark.parametrize("widths", [UPPER_WIDTHS, LOWER_WIDTHS])
def test_the_row_of_teeth_fits_on_the_arch(widths):
    x = np.linspace(0.0, ARCH_REACH, 20001)
    measured = np.hypot(np.diff(x), np.diff(26.0 * x**2)).sum()
    assert arch_length() == pytest.approx(measured, rel=1e-6)
    assert sum(widths) * 1e-3 < measured


def test_teeth_stand_in_the_mouth(parts):
    """Behind the lips, facing forward, the upper ones over the lower ones in front."""
    for name in ("upper_teeth", "lower_teeth", "upper_gums", "lower_gums"):
        vertices = parts[name].vertices
        assert np.all(vertices[:, 2] < lip_arc(vertices[:, 0]) - 0.004)
    upper, lower = (parts[f"{row}_teeth"].vertices for row in ("upper", "lower"))
    assert upper[:, 1].min() < lower[:, 1].max()
    assert upper[:, 2].max() > lower[:, 2].max()
    for name in ("upper_teeth", "lower_teeth"):
        part = parts[name]
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        middle = (a + b + c) / 3
        front = (np.abs(middle[:, 0]) < 0.004) & (middle[:, 2] > part.vertices[:, 2].max() - 0.0008)
        assert front.any()
        assert np.all(np.cross(b - a, c - a)[front, 2] > 0)


def test_arch_is_measured_by_its_own_length():
    points, normals = dental_arch(np.linspace(-0.03, 0.03, 2001), 0.069)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.06 / 2000, rtol=2e-3)
    tangents = np.diff(points, axis=0)
    assert np.abs(np.einsum("ij,ij->i", tangents, normals[:-1])).max() < 1e-6


@pytest.mark.parametrize("out", [0.0, 0.5, 1.0])
def test_tongue_is_closed_and_wound_outward(out):
    vertices, faces = tongue(out)
    assert not len(border_edges(faces))
    a, b, c = (vertices[faces[:, k]] - vertices.mean(axis=0) for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert 4e-6 < volume < 4e-5  # cubic metres


def test_tongue_comes_out_over_the_lower_lip(head, parts):
    assert parts["tongue"].vertices[:, 2].max() < parts["lower_teeth"].vertices[:, 2].max()
    out = {part.name: part for part in render_parts(head, tongue_out=1.0)}["tongue"]
    assert out.vertices[:, 2].max() > head.template[head.landmarks["lower_lip_mid"], 2] + 0.010


def test_parts_follow_the_identity(head, parts):
    shape = np.random.default_rng(1).normal(size=head.shape_basis.shape[2])
    moved = {part.name: part for part in render_parts(head, shape)}
    lips = head.shape_basis[head.regions["mouth_socket"]] @ shape
    for name, part in parts.items():
        offset = moved[name].vertices - part.vertices
        assert np.abs(offset).max() > 1e-4
        assert np.all(offset.min(axis=0) >= lips.min(axis=0) - 1e-9)
        assert np.all(offset.max(axis=0) <= lips.max(axis=0) + 1e-9)
