"""What outlines and pairs of landmarks contribute to a fit, on a head whose pose is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Camera
from headbench.datasets.head.arrays import with_derived_regions
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.mesh_pictures import rasterize_mesh
from headbench.datasets.tracking.equations import HeadState, MotionPrior, NormalEquations
from headbench.datasets.tracking.fit import LEVELS, Fitter, LastPass, sampled_vertices, with_shape
from headbench.datasets.tracking.landmarks import ImageLandmarks
from headbench.datasets.tracking.outline import outline_of
from headbench.datasets.tracking.rig import FrameStack, PointRig, PoseColumns, Views

SIZE = 192


@pytest.fixture(scope="module")
def head():
    """A head whose shape is kept."""
    whole = with_derived_regions(procedural_head("2023"))
    return with_shape(whole, np.zeros(whole.shape_basis.shape[2]))


@pytest.fixture(scope="module")
def camera():
    K = np.array([[700.0, 0, SIZE / 2], [0, 700.0, SIZE / 2], [0, 0, 1]])
    motion = np.diag([1.0, -1, -1, 1])
    motion[:3, 3] = [0, 0, 1.0]
    return Camera("0", SIZE, SIZE, K, motion)


def turned(camera, angle):
    """The camera, moved by an angle around the vertical axis."""
    motion = np.array(camera.world_to_camera)
    motion[:3, :3] = motion[:3, :3] @ Rotation.from_euler("y", angle).as_matrix()
    return Camera(f"{angle:g}", SIZE, SIZE, camera.K, motion)


def resting(head):
    return HeadState(np.zeros(head.shape_basis.shape[2]), np.zeros((1, PoseColumns.of(head).size)))


NOTHING = ImageLandmarks(
    np.zeros((1, 3), int), np.array([[1.0, 0, 0]]), np.full((1, 1, 1, 2), np.nan), np.zeros((0, 2), int)
)
GREY = np.full((SIZE, SIZE, 3), 128, np.uint8)


@pytest.mark.parametrize(("masked", "left_mm"), [(True, 1.0), (False, 5.0)])
def test_an_outline_moves_the_head_where_colours_say_nothing(head, camera, masked, left_mm):
    mesh = np.asarray(head.template, np.float64)
    mask = np.where(rasterize_mesh(mesh, head.faces, camera).face >= 0, 255, 0).astype(np.uint8)
    outlines = [outline_of(mask) if masked else None]
    fitter = Fitter(head, Views([camera]), NOTHING, sampled_vertices(head), outlines)
    state = resting(head)
    aside = PoseColumns.of(head).translation.start
    state.poses[0, aside] = 0.005
    found = fitter.fit_colours(state, FrameStack([GREY]), levels=LEVELS[:1]).state
    rig = PointRig.at_vertices(head, np.asarray(head.regions["nose"]))
    moved = rig.points(found.shape, found.poses[0]) - mesh[head.regions["nose"]]
    assert abs(1e3 * moved[:, 0].mean()) == pytest.approx(left_mm, abs=1.0)


def test_outlines_of_several_cameras_open_the_mouth(head, camera):
    views = [turned(camera, angle) for angle in (-0.8, 0.8)]
    state, opened = resting(head), resting(head)
    opened.poses[0, 6] = 0.4  # the jaw
    rig = PointRig.at_vertices(head, np.arange(len(head.template)))
    mesh = rig.points(opened.shape, opened.poses[0]).astype(np.float64)
    masks = [
        np.where(rasterize_mesh(mesh, head.faces, view).face >= 0, 255, 0).astype(np.uint8) for view in views
    ]
    landmarks = NOTHING._replace(pixels=np.repeat(NOTHING.pixels, 2, axis=1))
    fitter = Fitter(head, Views(views), landmarks, sampled_vertices(head), [outline_of(one) for one in masks])
    found = fitter.fit_colours(state, FrameStack([GREY] * 2), levels=LEVELS[:2]).state
    lips = np.asarray(head.regions["lips"])
    gaps = [rig.points(one.shape, one.poses[0])[lips] - mesh[lips] for one in (state, found)]
    before, after = (np.sqrt((gap**2).sum(axis=1).mean()) for gap in gaps)
    assert after < 0.5 * before


def test_the_residual_is_not_that_of_one_wrong_camera(head, camera):
    views = Views([turned(camera, angle) for angle in (-0.4, 0.0, 0.4)])
    members = np.asarray(head.regions["nose"])
    pixels = views.project(np.asarray(head.template, np.float64)[members]).pixels
    pixels[2] += 10  # 14 mm, too little to be left out
    corners, weights = np.repeat(members[:, None], 3, axis=1), np.tile([1.0, 0, 0], (len(members), 1))
    landmarks = ImageLandmarks(corners, weights, pixels[None], NOTHING.pairs)
    fitter, state = Fitter(head, views, landmarks, sampled_vertices(head)), resting(head)
    assert fitter.add_landmarks(NormalEquations(state), fitter.landmark_rig(), state, 1.0)[0] < 0.1


def last_pass(head, camera, poses, pixels, motion):
    """Poses (T, D) after the final pass on grey images with landmarks (T, L, 2) at the nose."""
    vertices = sampled_vertices(head)
    members = np.asarray(head.regions["nose"])
    corners, weights = np.repeat(members[:, None], 3, axis=1), np.tile([1.0, 0, 0], (len(members), 1))
    landmarks = ImageLandmarks(corners, weights, pixels[:, None], NOTHING.pairs)
    fitter = Fitter(head, Views([camera]), landmarks, vertices)
    last = LastPass(np.zeros((len(vertices), 3)), motion)
    stack = FrameStack([GREY] * len(poses))
    return fitter.fit_colours(HeadState(np.zeros(0), poses), stack, last=last).state.poses


def test_the_last_pass_keeps_half_turns(head, camera):
    filming = Camera("0", SIZE, SIZE, camera.K, np.eye(4))  # as of a video: the head is turned towards it
    state = resting(head)
    state.poses[0, PoseColumns.of(head).translation] = 0, 0.3, 1
    poses = np.repeat(state.poses, 3, axis=0)
    poses[:, 0] = np.pi - 0.01, -np.pi + 0.01, np.pi - 0.01  # nearly the same rotation
    pixels = np.full((2, len(head.regions["nose"]), 2), np.nan)
    motion = MotionPrior(poses[0], np.full((2, poses.shape[1]), 0.05))
    poses = poses[1:]
    found = HeadState(np.zeros(0), last_pass(head, filming, poses, pixels, motion))
    turned = Rotation.from_rotvec(found.poses[:, :3]) * Rotation.from_rotvec(poses[:, :3]).inv()
    assert turned.magnitude().max() < 0.05


def test_the_prior_of_motion_removes_jitter(head, camera):
    frames, nose = 12, np.asarray(head.regions["nose"])
    poses = np.repeat(resting(head).poses, frames, axis=0)
    still = Views([camera]).project(np.asarray(head.template, np.float64)[nose]).pixels[0]
    pixels = still + 4.0 * np.random.default_rng(0).standard_normal((frames, 1, 2))
    aside = PoseColumns.of(head).translation.start
    seconds = np.array([np.inf] + [1 / 30] * (frames - 1))
    found, loose, late = (
        last_pass(head, camera, poses, pixels, motion)[:, aside]
        for motion in (
            MotionPrior.of(poses[0], seconds),
            None,
            MotionPrior.of(poses[0], np.where(np.arange(frames) == 6, 5.0, seconds)),  # a face lost for 5 s
        )
    )
    jitter, without = (np.abs(np.diff(one)).mean() for one in (found, loose))
    assert jitter < 0.5 * without
    assert abs(late[6] - late[5]) > 1.5 * abs(found[6] - found[5])


def test_pairs_of_landmarks_open_the_mouth(head, camera):
    columns, views = PoseColumns.of(head), Views([camera])
    lips = np.asarray(head.regions["lips"])
    heights = np.asarray(head.template)[lips, 1]
    pair = lips[[np.argmax(heights), np.argmin(heights)]]
    others = np.asarray(head.regions["nose"])[::20]
    vertices = np.concatenate([pair, others])
    rig = PointRig.at_vertices(head, vertices)
    open_mouth = resting(head)
    open_mouth.poses[0, 6] = 0.2  # jaw
    pixels = views.project(rig.points(open_mouth.shape, open_mouth.poses[0])).pixels[None]
    corners, weights = np.repeat(vertices[:, None], 3, axis=1), np.tile([1.0, 0, 0], (len(vertices), 1))

    def gap(pairs):
        marks = ImageLandmarks(corners, weights, pixels, np.array(pairs, int).reshape(-1, 2))
        fitter = Fitter(head, views, marks, np.zeros(0, int))
        found = fitter.fit_landmarks(resting(head), weight=1e-4)
        assert found.poses.shape == (1, columns.size)
        places = views.project(rig.points(found.shape, found.poses[0])).pixels[0]
        return np.linalg.norm((places[0] - places[1]) - (pixels[0, 0, 0] - pixels[0, 0, 1]))

    assert gap([(0, 1)]) < 0.5 * gap([])
