"""The separate tongue of heads that bring none: it comes out of the mouth, not through the lip."""

from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.datasets.head.arrays import region
from headbench.datasets.head.geometry import mesh_edges
from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.mesh_pictures import rasterize_mesh
from headbench.datasets.synthetic.anatomy import front_depth, measure
from headbench.datasets.synthetic.parts import HIDES, share_that_shows
from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.plan import draw_person, load_geometry
from headbench.datasets.synthetic.subject import (
    DRIVERS,
    FACE_MM,
    RenderedSubject,
    displacement,
    make_correctives,
)

from .conftest import settled

SMILE = {"smile_left": 1.0, "smile_right": 1.0, "jaw_open": 0.6, "cheek_raise_left": 0.8}


@pytest.fixture(scope="module")
def shapes(plan, subject):
    head = plan.geometry.head
    return make_correctives(plan.person, subject.anatomy, head, subject.neutral, plan.geometry.translation)


def test_each_displaces_the_face_by_the_amount_stated(plan, subject, shapes, rest):
    face = np.intersect1d(region(plan.geometry.head, "face"), subject.anatomy.skin_faces)
    for first, second in DRIVERS:
        alone = [displacement(shapes, level, {**rest, first: 1.0, second: 1.0})[face] for level in (1.0, 2.0)]
        once, twice = (1e3 * np.sqrt((each**2).sum(1).mean()) for each in alone)
        assert 0.9 * FACE_MM < once < 1.5 * FACE_MM, (first, second)  # a square may act beside a product
        assert twice == pytest.approx(2.0 * once, rel=1e-3)


def test_one_control_alone_displaces_only_by_its_square(shapes, rest):
    alone = {name for name in CONTROLS if displacement(shapes, 1.0, {**rest, name: 1.0}).any()}
    assert alone == {first for first, second in DRIVERS if first == second}
    for name in alone:
        whole, half = (displacement(shapes, 1.0, {**rest, name: value}) for value in (1.0, 0.5))
        np.testing.assert_allclose(half, 0.25 * whole, atol=1e-8)


def test_shapes_are_smooth_and_the_basis_comes_no_closer(plan, subject, shapes):
    """The basis explains as little of a shape as coefficients can: its best fit leaves nearly all of it."""
    head, edges = plan.geometry.head, mesh_edges(subject.anatomy.skin_faces)
    edges = edges[np.isin(edges, region(head, "face")).all(1)]
    skin = np.unique(subject.anatomy.skin_faces)
    basis = np.asarray(head.expression_basis)[skin].reshape(-1, head.expression_basis.shape[2])
    u, s, _ = np.linalg.svd(basis, full_matrices=False)
    u = u[:, s > 1e-9 * s[0]]
    for shape in shapes:
        size = np.sqrt((shape**2).sum(1))
        step = np.sqrt(((shape[edges[:, 0]] - shape[edges[:, 1]]) ** 2).sum(1))
        assert np.sqrt((step**2).mean()) < 0.5 * np.sqrt((size[edges[:, 0]] ** 2).mean())
        assert np.linalg.norm(u.T @ shape[skin].ravel()) < 0.05 * np.linalg.norm(shape)


def test_joints_eyes_and_the_tracked_mesh_stay(plan, subject, shapes, rest):
    np.testing.assert_allclose(plan.geometry.head.joint_regressor @ shapes[0], 0.0, atol=1e-8)
    other = RenderedSubject(plan.person, plan.geometry, plan.shape, correctives=1.0)
    smiling = {**rest, **SMILE, "head_turn": 0.2}
    pose = plan.geometry.translation.pose(smiling, "900", 0)
    np.testing.assert_array_equal(other.tracked(pose), subject.tracked(pose))
    state = settled(smiling, plan.person)
    with_, without = (each.posed_meshes(pose, smiling, state) for each in (other, subject))
    for name in ("eye_left", "eye_right", "hair", "tongue"):
        np.testing.assert_array_equal(with_[name].vertices, without[name].vertices)
    # Skin moves as far as the shape says, whose vectors turn with the head.
    fine = subject._fine
    expected = np.linalg.norm(fine.interpolate(displacement(shapes, 1.0, smiling)), axis=1)
    found = np.linalg.norm(with_["skin"].vertices - without["skin"].vertices, axis=1)
    assert np.corrcoef(expected, found)[0, 1] > 0.95
    assert found.max() > 1e-3


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
