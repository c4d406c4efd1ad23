"""Pictures: noise, mattes, and a face that a detector finds."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial import ConvexHull
from skimage.data import lbp_frontal_face_cascade_filename
from skimage.draw import polygon2mask
from skimage.feature import Cascade

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError
from headbench.datasets.synthetic.plan import FRONTAL, SynthSettings, lights, plan_subject
from headbench.datasets.synthetic.renderer import CaptureRenderer, PathTracer, develop, sample_count, window

from .conftest import hull_faces


@pytest.fixture(scope="module")
def renderer(plan):
    return CaptureRenderer(plan)


def pose_at(renderer, plan, sequence, timestep):
    renderer.set_pose(plan.poses[sequence][timestep], plan.performed[sequence].activations[timestep])


def psnr(a, b):
    return -10 * np.log10(np.mean((a / 255.0 - b / 255.0) ** 2))


def test_two_seeds_agree_to_40_db_and_one_seed_exactly(renderer, plan):
    pose_at(renderer, plan, "FREE", 1)
    first, mask = renderer.render(FRONTAL, 1)
    again, _ = renderer.render(FRONTAL, 1)
    other, other_mask = renderer.render(FRONTAL, 2)
    np.testing.assert_array_equal(first, again)
    assert 40 < psnr(first, other) < 70
    assert psnr(mask, other_mask) > 38


def test_mask_is_clean(renderer, plan):
    pose_at(renderer, plan, "FREE", 0)
    picture, mask = renderer.render(FRONTAL, 3)
    assert (picture[mask == 0] == 255).all()
    assert mask[:2].max() == 0  # room above the hair
    assert (mask == 255).mean() > 0.25
    solid = mask > 127
    outline = binary_dilation(solid, iterations=2) & ~binary_erosion(solid, iterations=2, border_value=1)
    partial = (mask > 0) & (mask < 255)
    assert (partial & ~outline).sum() < 0.1 * partial.sum()
    assert picture[mask == 255].max(1).mean() < 235


@pytest.mark.parametrize("size", [(72, 104), (69, 100)])  # the shapes of 144 x 208 and of 550 x 802
def test_every_camera_holds_the_whole_head_with_a_margin(geometry, rest, size):
    plan = plan_subject(Path("unused"), 0, geometry, SynthSettings(1, 16, 8, size, "procedural", 0, 0.0, 9))
    assert plan.person.style == "bob"  # the widest hair
    renderer = CaptureRenderer(plan)
    renderer.set_pose(plan.geometry.translation.pose(rest, "900", None), rest)
    for camera in plan.cameras:
        _, mask = renderer.render(camera, 1)
        assert mask[: size[1] // 20].max() == 0, camera
        assert max(mask[:, :2].max(), mask[:, -2:].max()) == 0, camera
        # The bust is cut by the frame, not by its own end.
        assert (mask[-1] > 200).sum() > size[0] // 8, camera


def test_tracked_skin_projects_into_the_mask(plan, subject, renderer):
    """The face's tracked triangles, projected here by hand, are covered; below the hair they fill the mask."""
    pose_at(renderer, plan, "FREE", 1)
    camera = plan.cameras[FRONTAL]
    _, mask = renderer.render(FRONTAL, 1)
    tracked = subject.tracked(plan.poses["FREE"][1])
    seen = tracked @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    scale = 4
    covered = np.zeros((camera.height * scale, camera.width * scale), bool)
    for triangle in pixels[subject.anatomy.skin_faces]:
        low = np.floor(triangle.min(0) * scale).astype(int).clip(0)
        high = np.ceil(triangle.max(0) * scale).astype(int) + 1
        if (low >= [camera.width * scale, camera.height * scale]).any():
            continue
        local = triangle[:, ::-1] * scale - low[::-1] - 0.5
        patch = covered[low[1] : high[1], low[0] : high[0]]
        patch |= polygon2mask((high - low)[::-1], local)[: patch.shape[0], : patch.shape[1]]
    expected = covered.reshape(camera.height, scale, camera.width, scale).mean((1, 3))
    chin = int(pixels[plan.geometry.head.landmarks["chin"], 1])
    alpha = mask[: chin + 4] / 255.0
    assert np.maximum(expected[: chin + 4] - alpha, 0).sum() < 0.02 * expected[: chin + 4].sum()
    below = slice(chin + 1, chin + 4)
    overlap = (
        np.minimum(expected[below], mask[below] / 255).sum()
        / np.maximum(expected[below], mask[below] / 255).sum()
    )
    assert overlap > 0.9 if plan.person.style != "bob" else overlap > 0.5


def test_expression_is_seen_in_the_picture(renderer, plan):
    rest = dict.fromkeys(plan.performed["FREE"].activations[0], 0.0)
    pose = plan.geometry.translation.pose(rest, "900", 0)
    raised = {**rest, "brow_inner_up": 1.0, "brow_outer_up_left": 1.0, "brow_outer_up_right": 1.0}
    pictures = []
    for activations in (rest, raised):
        renderer.set_pose(pose, activations)
        pictures.append(renderer.render(FRONTAL, 1)[0].astype(int))
    assert (np.abs(pictures[0] - pictures[1]).max(2) >= 6).sum() >= 10


@pytest.mark.slow
def test_a_detector_finds_the_face(geometry):
    """scikit-image's LBP cascade, trained on photographs, finds the one face in at least 95 % of frames."""
    detector = Cascade(lbp_frontal_face_cascade_filename())
    found, total = 0, 0
    for index in range(4):
        settings = SynthSettings(4, 2, 8, (275, 401), "procedural", 0, 0.0, 25)
        plan = plan_subject(Path("unused"), index, geometry, settings)
        renderer = CaptureRenderer(plan)
        for sequence, timestep in plan.moments():
            pose_at(renderer, plan, sequence, timestep)
            picture, _ = renderer.render(FRONTAL, 1)
            boxes = detector.detect_multi_scale(
                img=picture, scale_factor=1.2, step_ratio=1, min_size=(120, 120), max_size=(260, 260)
            )
            middles = [(box["c"] + box["width"] / 2, box["r"] + box["height"] / 2) for box in boxes]
            found += bool(middles) and all(abs(x - 137) < 40 and 110 < y < 270 for x, y in middles)
            total += 1
    assert found >= 0.95 * total


def ball(center, radius, steps=24):
    """A convex mesh, so that its silhouette is the hull of its projected vertices."""
    polar, around = np.linspace(0.1, np.pi - 0.1, steps), np.linspace(0, 2 * np.pi, steps, endpoint=False)
    theta, phi = (grid.ravel() for grid in np.meshgrid(polar, around, indexing="ij"))
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    return np.asarray(center) + radius * unit, hull_faces(unit)


def front_camera(width, height, focal, cx, cy):
    """At one metre before the origin."""
    world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
    world_to_camera[2, 3] = 1.0
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    return Camera("a", width, height, K, world_to_camera)


def lit(vertices, faces, samples=9):
    tracer = PathTracer(lights(), samples)
    tracer.add("ball", vertices, faces, np.full((len(vertices), 3), 0.5), "skin")
    return tracer


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
    _, alpha = lit(vertices, faces, 25).image(camera, 0)

    in_camera = vertices @ rotation.T + world_to_camera[:3, 3]
    pixels = in_camera @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    outline = pixels[ConvexHull(pixels).vertices]
    scale = 8  # supersampled, as the mask is
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
    camera = front_camera(64, 48, 100.0, 32, 24)
    vertices, faces = ball(np.zeros(3), 0.05)
    tracer, columns = lit(vertices, faces), np.arange(64) + 0.5
    _, before = tracer.image(camera, 0)
    tracer.move("ball", vertices + [0.1, 0, 0])
    _, after = tracer.image(camera, 0)
    shift = (after.sum(0) @ columns) / after.sum() - (before.sum(0) @ columns) / before.sum()
    assert shift == pytest.approx(10.0, abs=0.3)  # 0.1 m at 1 m and 100 px


def test_the_rendered_window_lacks_nothing():
    """The window is tight, and a far speck that widens it to the whole image leaves coverage where it was."""
    camera = front_camera(64, 48, 100.0, 30.5, 26)
    vertices, faces = ball([0.08, 0.03, 0.0], 0.05)
    rows, columns = window(camera, vertices)
    found = (columns.start, columns.stop, rows.start, rows.stop)
    np.testing.assert_allclose(found, [33.5, 47.5, 16, 32], atol=4)
    alphas = []
    for corners in ((), ((-0.30, 0.26), (0.34, -0.22))):
        tracer = lit(vertices, faces, 289)
        for index, (x, y) in enumerate(corners):
            speck = np.array([[x, y, 0.0], [x + 1e-4, y, 0.0], [x, y + 1e-4, 0.0]])
            tracer.add(f"speck{index}", speck, np.array([[0, 1, 2]]), np.full((3, 3), 0.5), "cloth")
        alphas.append(tracer.image(camera, 0)[1])
    inside = np.zeros(alphas[0].shape, bool)
    inside[rows, columns] = True
    assert alphas[0][~inside].max() == 0
    assert np.abs(alphas[0] - alphas[1])[2:-2, 2:-2].max() < 0.06
    assert alphas[0].max() == 1


def test_nothing_in_view_gives_an_empty_picture_and_no_error():
    rgb, alpha = lit(*ball([5.0, 0.0, 0.0], 0.05)).image(front_camera(32, 24, 50.0, 16, 12), 0)
    assert rgb.shape == (24, 32, 3)
    assert not rgb.any()
    assert not alpha.any()


def test_develop_is_srgb_below_the_knee():
    linear = np.full((1, 3, 3), 0.2140)  # display 0.5
    picture, mask = develop(linear, np.array([[1.0, 0.5, 0.0]]), np.ones(3))
    assert picture[0, :, 0].tolist() == [pytest.approx(127.5, abs=1), pytest.approx(191, abs=1), 255]
    assert mask[0].tolist() == [255, 128, 0]
    bright, _ = develop(np.array([[[0.9] * 3, [3.0] * 3]]), np.ones((1, 2)), np.ones(3))
    assert 200 < bright[0, 0, 0] < bright[0, 1, 0] <= 255


def test_sample_count_rounds_up_and_refuses():
    assert [sample_count(n) for n in (1, 9, 10, 25, 26)] == [9, 9, 25, 25, 49]
    with pytest.raises(InputError, match="samples per pixel"):
        sample_count(1000)
