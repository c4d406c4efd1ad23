"""The studio against pinhole projection written out here."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from skimage.draw import polygon2mask

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.datasets.synthetic.studio import Studio, develop, sample_count, window
from headbench.datasets.synthetic.take import lights


def ball(center, radius, steps=24):
    """A convex mesh, so that its silhouette is the hull of its projected vertices."""
    theta, phi = np.meshgrid(
        np.linspace(0.1, np.pi - 0.1, steps), np.linspace(0, 2 * np.pi, steps, endpoint=False), indexing="ij"
    )
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1).reshape(
        -1, 3
    )
    hull = ConvexHull(unit)
    faces = hull.simplices.copy()
    inward = (
        np.einsum(
            "ni,ni->n", np.cross(*(unit[faces[:, k]] - unit[faces[:, 0]] for k in (1, 2))), unit[faces[:, 0]]
        )
        < 0
    )
    faces[inward] = faces[inward][:, ::-1]
    return center + radius * unit, faces


@pytest.mark.parametrize("principal", [(40.0, 30.0), (47.5, 22.0), (33.0, 37.5)])
def test_silhouette_lies_where_the_pinhole_camera_puts_it(principal):
    angle = 0.4
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    ) @ np.diag([1.0, -1.0, -1.0])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, [0.02, -0.01, 1.1]
    K = np.array([[200.0, 0, principal[0]], [0, 200.0, principal[1]], [0, 0, 1]])
    camera = Camera("a", 80, 60, K, world_to_camera)
    vertices, faces = ball(np.array([0.01, 0.03, 0.02]), 0.08)
    studio = Studio(lights(), 25)
    studio.add("ball", vertices, faces, np.full((len(vertices), 3), 0.5), "skin")
    _, alpha = studio.image(camera, 0)

    in_camera = vertices @ rotation.T + world_to_camera[:3, 3]
    pixels = in_camera @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    outline = pixels[ConvexHull(pixels).vertices]
    scale = 8  # supersampled, as the matte is
    inside = polygon2mask((60 * scale, 80 * scale), outline[:, ::-1] * scale - 0.5)
    expected = inside.reshape(60, scale, 80, scale).mean((1, 3))
    overlap = np.minimum(alpha, expected).sum() / np.maximum(alpha, expected).sum()
    assert overlap > 0.97
    rows, columns = np.mgrid[:60, :80] + 0.5
    for axis in (rows, columns):
        assert (alpha * axis).sum() / alpha.sum() == pytest.approx(
            (expected * axis).sum() / expected.sum(), abs=0.1
        )


def test_moved_mesh_is_rendered_where_it_went():
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[2, 3] = 1.0
    K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])
    camera = Camera("a", 64, 48, K, world_to_camera)
    vertices, faces = ball(np.zeros(3), 0.05)
    studio = Studio(lights(), 9)
    studio.add("ball", vertices, faces, np.full((len(vertices), 3), 0.5), "skin")
    columns = np.arange(64) + 0.5
    _, before = studio.image(camera, 0)
    studio.move("ball", vertices + [0.1, 0, 0])
    _, after = studio.image(camera, 0)
    shift = (after.sum(0) @ columns) / after.sum() - (before.sum(0) @ columns) / before.sum()
    assert shift == pytest.approx(10.0, abs=0.3)  # 0.1 m at 1 m and 100 px


def test_only_the_part_that_can_show_is_rendered_and_it_lacks_nothing():
    """The window is tight, and a far speck that widens it to the whole image leaves coverage where it was."""
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[2, 3] = 1.0
    K = np.array([[100.0, 0, 30.5], [0, 100.0, 26]], float)
    camera = Camera("a", 64, 48, np.vstack([K, [0, 0, 1]]), world_to_camera)
    vertices, faces = ball(np.array([0.08, 0.03, 0.0]), 0.05)
    rows, columns = window(camera, vertices)
    assert columns.start == pytest.approx(33.5, abs=4)
    assert (columns.stop, rows.start, rows.stop) == (
        pytest.approx(43.5 + 4, abs=4),
        pytest.approx(16, abs=4),
        pytest.approx(32, abs=4),
    )
    alphas = []
    for corners in ((), ((-0.30, 0.26), (0.34, -0.22))):
        studio = Studio(lights(), 289)
        studio.add("ball", vertices, faces, np.full((len(vertices), 3), 0.5), "skin")
        for index, (x, y) in enumerate(corners):
            speck = np.array([[x, y, 0.0], [x + 1e-4, y, 0.0], [x, y + 1e-4, 0.0]])
            studio.add(f"speck{index}", speck, np.array([[0, 1, 2]]), np.full((3, 3), 0.5), "cloth")
        alphas.append(studio.image(camera, 0)[1])
    inside = np.zeros(alphas[0].shape, bool)
    inside[rows, columns] = True
    assert alphas[0][~inside].max() == 0
    difference = np.abs(alphas[0] - alphas[1])[2:-2, 2:-2]
    assert difference.max() < 0.06
    assert alphas[0].max() == 1


def test_nothing_in_view_gives_an_empty_picture_and_no_error():
    camera = Camera("a", 32, 24, np.array([[50.0, 0, 16], [0, 50.0, 12], [0, 0, 1]]), np.eye(4))
    vertices, faces = ball(np.array([5.0, 0.0, 1.0]), 0.05)
    studio = Studio(lights(), 9)
    studio.add("ball", vertices, faces, np.full((len(vertices), 3), 0.5), "skin")
    rgb, alpha = studio.image(camera, 0)
    assert rgb.shape == (24, 32, 3)
    assert not rgb.any()
    assert not alpha.any()


def test_develop_is_srgb_below_the_knee_and_composites_in_display_space():
    linear = np.full((1, 3, 3), 0.2140)  # display 0.5
    picture, matte = develop(linear, np.array([[1.0, 0.5, 0.0]]), np.ones(3))
    assert picture[0, :, 0].tolist() == [pytest.approx(127.5, abs=1), pytest.approx(191, abs=1), 255]
    assert matte[0].tolist() == [255, 128, 0]
    bright, _ = develop(np.array([[[0.9] * 3, [3.0] * 3]]), np.ones((1, 2)), np.ones(3))
    assert 200 < bright[0, 0, 0] < bright[0, 1, 0] <= 255


def test_sample_count_rounds_up_and_refuses():
    assert [sample_count(n) for n in (1, 9, 10, 25, 26)] == [9, 9, 25, 25, 49]
    with pytest.raises(InputError, match="samples per pixel"):
        sample_count(1000)
