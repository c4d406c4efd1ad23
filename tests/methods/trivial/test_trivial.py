"""The trivial avatars, exactly."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.datasets.head.model import PosedSubject, frontal_key
from headbench.datasets.mesh_pictures import draw_mesh
from headbench.methods.trivial.method import (
    INDEX_FILE,
    MEAN_FILE,
    MeanImage,
    NearestCamera,
    OnePicture,
    TexturedMesh,
    _centres,
    _medians,
    resize,
    texels,
)

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_every_texel_holds_its_centre_and_points_near_it(rows):
    corners = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1]]], float)  # where positions are barycentric weights
    centres = _centres(corners, rows)
    assert len(centres) == rows**2
    face = np.full(rows**2, 3)
    for _ in range(5):
        moved = centres + 0.2 / rows * (RNG.dirichlet([1, 1, 1], rows**2) - 1 / 3)
        np.testing.assert_array_equal(texels(face, moved, rows), 3 * rows**2 + np.arange(rows**2))
    places = texels(np.zeros(1000, int), RNG.dirichlet([0.1, 0.1, 0.1], 1000), rows)
    assert 0 <= places.min() <= places.max() < rows**2


def test_the_colour_is_the_median():
    places, values = RNG.integers(0, 7, 200), RNG.integers(0, 256, (200, 3)).astype(np.uint8)
    colors, seen = _medians(places, values, 9)
    assert seen.tolist() == [True] * 7 + [False] * 2
    for place in range(7):
        expected = np.quantile(values[places == place], 0.5, axis=0, method="lower")
        np.testing.assert_array_equal(colors[place], expected)


class Painted:
    """A clip whose images show its mesh, painted with one colour for each vertex."""

    def __init__(self, clip):
        self._clip, self._mesh = clip, PosedSubject.of(clip)
        smooth = clip.head.template @ RNG.normal(size=(3, 3))
        self._colors = (smooth - smooth.min(0)) / np.ptp(smooth, axis=0)

    def __getattr__(self, name):
        return getattr(self._clip, name)

    def image(self, key):
        (vertices,) = self._mesh.meshes([self.poses[key.timestep]])
        camera = self.cameras[key.camera]
        return draw_mesh(
            vertices, self.head.faces, camera, self._colors, shading=0.0, background=self.background
        )

    def mask(self, key):
        return None


def train(clip, folder):
    return TexturedMesh().fit(clip, folder, Budget(iterations=1), device="cpu", seed=0, progress=no_progress)


def test_a_painted_mesh_is_drawn_again(clip, tmp_path):
    painted = Painted(clip)
    avatar = train(painted, tmp_path)
    for split in ("train", "novel_view", "self_reenactment"):
        key = clip.splits[split][0]
        frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
        inside = frame.alpha == 1
        assert inside.mean() > 0.05
        gap = np.abs(frame.rgb - painted.image(key) / 255)[inside]
        assert np.median(gap) < 0.04  # a colour changes by about as much from pixel to pixel
        assert frame.alpha.min() == 0


class Recorded(Painted):
    """A painted clip that notes the frames whose images are read."""

    def __init__(self, clip):
        super().__init__(clip)
        self.read = set()

    def image(self, key):
        self.read.add(key)
        return super().image(key)


def test_one_picture_is_all_that_it_sees_and_it_moves(clip, tmp_path):
    seen = Recorded(clip)
    avatar = fit(OnePicture(), seen, tmp_path / "one")
    mesh = train(Painted(clip), tmp_path / "all")
    (source,) = seen.read
    first = min(key.timestep for key in clip.splits["train"])
    assert source in clip.splits["train"]
    assert source == frontal_key(clip, first)
    frame = show(avatar, clip, source, background=clip.background)
    inside = frame.alpha == 1
    assert inside.mean() > 0.05
    gap = np.abs(frame.rgb - Painted.image(seen, source) / 255)[inside]
    assert np.median(gap) < 0.02
    key = clip.splits["self_reenactment"][0]
    moved = show(avatar, clip, key)
    np.testing.assert_array_equal(moved.alpha, show(mesh, clip, key).alpha)
    assert (moved.alpha != show(avatar, clip, key._replace(timestep=first)).alpha).any()


def test_one_half_of_the_face_colours_the_other():
    seen, unseen = np.array([[1.0, 0, 0], [-0.2, 1, 0]]), np.array([[-1.1, 0, 0], [0.1, 1, 0.3], [2, 0, 0]])
    assert OnePicture()._nearest(seen, unseen).tolist() == [0, 1, 0]
    assert TexturedMesh()._nearest(seen, unseen).tolist() == [1, 1, 0]


def test_a_head_outside_of_all_pictures_is_an_error(clip, tmp_path):
    away = {t: replace(pose, translation=pose.translation + 50) for t, pose in clip.poses.items()}
    with pytest.raises(InputError, match="headbench lint"):
        train(replace(clip, poses=away), tmp_path)


def fit(method, clip, folder):
    return method.fit(clip, folder, Budget(iterations=1), device="cpu", seed=0, progress=no_progress)


def show(avatar, clip, key, **options):
    return avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], **options)


def test_mean_image_is_the_mean_of_training_images_alone(clip, tmp_path):
    avatar = fit(MeanImage(), clip, tmp_path)
    keys = clip.splits["train"]
    expected = np.mean([clip.image(key) / 255.0 for key in keys], axis=0)
    coverage = np.mean([clip.mask(key) / 255.0 for key in keys], axis=0)
    for split in clip.splits:
        frame = show(avatar, clip, clip.splits[split][0])
        np.testing.assert_allclose(frame.rgb, expected, atol=1e-6)
        np.testing.assert_allclose(frame.alpha, coverage, atol=1e-6)


def test_nearest_camera_returns_a_training_frame_itself(clip, tmp_path):
    avatar = fit(NearestCamera(), clip, tmp_path)
    for key in clip.splits["train"]:
        frame = show(avatar, clip, key)
        np.testing.assert_array_equal(frame.rgb, (clip.image(key) / np.float32(255)).astype(np.float32))
        np.testing.assert_array_equal(frame.alpha, (clip.mask(key) / np.float32(255)).astype(np.float32))


def test_a_held_out_view_shows_the_nearest_camera_at_that_time(clip, tmp_path):
    avatar = fit(NearestCamera(), clip, tmp_path)
    training = {key.camera for key in clip.splits["train"]}
    for key in clip.splits["novel_view"]:
        head = clip.poses[key.timestep].translation
        towards = {name: camera.center - head for name, camera in clip.cameras.items()}
        cosines = {n: -towards[n] @ towards[key.camera] / np.linalg.norm(towards[n]) for n in training}
        source = key._replace(camera=min(cosines, key=cosines.__getitem__))
        np.testing.assert_allclose(show(avatar, clip, key).rgb, clip.image(source) / 255.0, atol=1e-6)


def test_a_held_out_expression_shows_the_nearest_timestep(clip, tmp_path):
    avatar = fit(NearestCamera(), clip, tmp_path)
    pose = clip.poses[1]
    near = pose.expression + np.float32(1e-3)
    nudged = replace(pose, expression=near, timestep=None, subject="somebody else")
    key = next(key for key in clip.splits["train"] if key.timestep == 1)
    frame = avatar.render(clip.cameras[key.camera], nudged)
    np.testing.assert_allclose(frame.rgb, clip.image(key) / 255.0, atol=1e-6)


def test_the_background_is_exchanged_under_the_mask(clip, tmp_path):
    avatar = fit(NearestCamera(), clip, tmp_path)
    key = clip.splits["train"][0]
    white, alpha = show(avatar, clip, key)
    black, _ = show(avatar, clip, key, background=(0, 0, 0))
    expected = np.clip(white - (1 - alpha[..., None]), 0, 1)
    np.testing.assert_allclose(black, expected, atol=1e-6)


@pytest.mark.parametrize("method", [MeanImage, NearestCamera])
def test_a_pose_of_another_head_model_is_refused(method, clip, tmp_path):
    with pytest.raises(InputError, match="head_model"):
        fit(method(), clip, tmp_path).render(clip.cameras["00"], replace(clip.poses[0], head_model="another"))


def test_resize_keeps_means_and_leaves_its_own_size_alone():
    image = np.random.default_rng(0).random((12, 8, 4)).astype(np.float32)
    assert resize(image, 8, 12) is image
    np.testing.assert_allclose(resize(image, 4, 6), image.reshape(6, 2, 4, 2, 4).mean((1, 3)), atol=1e-6)
    assert resize(image, 16, 24).shape == (24, 16, 4)


@pytest.mark.parametrize(
    ("method", "file", "name", "change"),
    [
        (MeanImage, MEAN_FILE, "rgba", lambda v: np.full_like(v, np.nan)),
        (MeanImage, MEAN_FILE, "rgba", lambda v: v[:0]),
        (MeanImage, MEAN_FILE, "background", lambda v: v[:2]),
        (NearestCamera, INDEX_FILE, "images", lambda v: v + 10**6),
        (NearestCamera, INDEX_FILE, "images", lambda v: v - 10),
        (NearestCamera, INDEX_FILE, "images", lambda v: np.full_like(v, -1)),
        (NearestCamera, INDEX_FILE, "images", lambda v: v[:1]),
        (NearestCamera, INDEX_FILE, "signals", lambda v: v * np.nan),
        (NearestCamera, INDEX_FILE, "scales", lambda v: v * 0),
        (NearestCamera, INDEX_FILE, "centers", lambda v: v[:, :2]),
    ],
)
def test_a_damaged_avatar_is_refused_when_loaded(clip, tmp_path, method, file, name, change):
    fit(method(), clip, tmp_path)
    with np.load(tmp_path / file) as archive:
        arrays = dict(archive)
    np.savez(tmp_path / file, **{**arrays, name: change(arrays[name])})
    with pytest.raises(InputError) as caught:
        method().load(tmp_path, device="cpu")
    assert caught.value.key == name


def test_an_image_that_is_gone_is_named_when_loaded(clip, tmp_path):
    avatar = fit(NearestCamera(), clip, tmp_path)
    avatar.files()[-1].unlink()
    with pytest.raises(InputError, match="000.*png"):
        NearestCamera().load(tmp_path, device="cpu")
