"""The trivial avatars, exactly."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.methods.trivial.method import INDEX_FILE, MEAN_FILE, MeanImage, NearestCamera, resize


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
