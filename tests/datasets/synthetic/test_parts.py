"""The separate tongue of heads that bring none: it comes out of the mouth, not through the lip."""

from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.procedural.sculpture import lip_arc
from headbench.datasets.mesh_pictures import rasterize_mesh
from headbench.datasets.synthetic.anatomy import front_depth, measure
from headbench.datasets.synthetic.parts import (
    HIDES,
    render_parts,
    share_that_shows,
)
from headbench.datasets.synthetic.plan import draw_person, load_geometry

ICT = Path(__file__).parents[3].parent / "shared/data/ict_facekit/ict_facekit_f16.npz"


def mouth_of(geometry, seed, shape):
    """Parts in the mouth, anatomy and neutral mesh of a subject."""
    neutral = PosedSubject(geometry.head, shape, np.zeros_like(geometry.head.template)).neutral
    anatomy = measure(geometry.head, neutral)
    return geometry.mouth(draw_person("900", 0, seed), anatomy, shape), anatomy, neutral


@pytest.mark.parametrize("share", [0.5, 0.75, 1.0])
def test_tongue_slides_over_the_lower_lip(share):
    if not ICT.exists():
        pytest.skip("no ICT-FaceKit file beside the repository")
    geometry = load_geometry(str(ICT))
    (tongue,), anatomy, neutral = mouth_of(geometry, 1, np.zeros(geometry.head.shape_basis.shape[2]))
    step, size = 0.0005, np.array([80, 90])
    low = anatomy["mouth"][:2] - [0.020, 0.040]
    skin = front_depth(neutral, anatomy.skin_faces, low, step, size)
    hidden = front_depth(tongue.at(share), tongue.faces, low, step, size) > skin
    rim = 80  # row at the height where the lips meet
    middle = hidden[:rim, 40]
    assert middle.any()
    lowest = int(np.flatnonzero(middle)[0])
    assert middle[lowest : rim - 4].all(), "skin shows between the mouth's opening and the tongue's tip"


def test_front_depth_is_the_nearest_triangle_at_each_point():
    """Against each grid point's place in each triangle, solved for singly; some triangles have no area or lie outside."""
    rng = np.random.default_rng(2)
    vertices, faces = rng.uniform(-0.2, 1.2, (40, 3)), rng.integers(0, 40, (60, 3))
    low, step, size = np.array([0.01, -0.02]), 0.05, np.array([19, 23])
    expected = np.full((size[1], size[0]), -np.inf)
    for corners in vertices[faces]:
        system = np.vstack([corners[:, :2].T, np.ones(3)])
        if abs(np.linalg.det(system)) > 1e-9:
            for row, column in np.ndindex(*expected.shape):
                weights = np.linalg.solve(system, [*(low + step * np.array([column, row])), 1.0])
                if weights.min() >= 0.0:
                    expected[row, column] = max(expected[row, column], weights @ corners[:, 2])
    found = front_depth(vertices, faces, low, step, size)
    assert np.isinf(expected).any()
    assert np.isfinite(expected).mean() > 0.5
    np.testing.assert_allclose(found, expected, atol=1e-9)


FAR = 50.0


@pytest.fixture(scope="module", params=[0, 4])
def subject(request):
    geometry = load_geometry("procedural")
    rng = np.random.default_rng(request.param)
    shape = 0.6 * rng.standard_normal(geometry.head.shape_basis.shape[2])
    return mouth_of(geometry, request.param, shape)


def hidden_area(parts, anatomy, neutral, share):
    """Square metres below the line between the lips, from a distant camera in front."""
    size, step = 300, 0.0004
    middle = anatomy["mouth"]
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[:3, 3] = [-middle[0], middle[1], middle[2] + FAR]
    K = np.array([[FAR / step, 0, size / 2], [0, FAR / step, size / 2], [0, 0, 1.0]])
    camera = Camera("front", size, size, K, world_to_camera)
    (tongue,) = [part for part in parts if part.name == "tongue"]
    skin = rasterize_mesh(neutral, anatomy.skin_faces, camera).depth
    front = rasterize_mesh(tongue.at(share), tongue.faces, camera).depth
    return float((np.isfinite(skin) & (front < skin))[size // 2 :].sum()) * step**2


def test_tongue_threshold_agrees_with_another_rasterizer(subject):
    share = share_that_shows(*subject)
    assert 0.2 < share < 0.85  # a phrase puts the tongue out by 0.85 at least
    assert hidden_area(*subject, share - 0.03) < HIDES < hidden_area(*subject, share + 0.03)


@pytest.fixture(scope="module")
def head():
    return procedural_head("procedural2023")


@pytest.fixture(scope="module")
def parts(head):
    return {part.name: part for part in render_parts(head)}


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


def test_tongue_comes_out_over_the_lower_lip(head, parts):
    assert parts["tongue"].vertices[:, 2].max() < parts["lower_teeth"].vertices[:, 2].max()
    out = {part.name: part for part in render_parts(head, tongue_out=1.0)}["tongue"]
    assert out.vertices[:, 2].max() > head.template[head.landmarks["lower_lip_mid"], 2] + 0.010
