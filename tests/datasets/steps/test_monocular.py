"""Many views as one video: every key maps to its own image, and no test frame enters."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from headbench.bench.specs import ResolutionRule
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.model import HeadModel
from headbench.datasets.steps.for_method import as_single_video
from headbench.datasets.steps.resolution import align_clip

from ..tiny_capture import SERIALS


@pytest.fixture(scope="module")
def clip(pristine_capture):
    return read_capture(pristine_capture.union)


@pytest.fixture(scope="module")
def video(clip):
    return as_single_video(clip)


def test_every_key_maps_to_its_own_image_and_back(clip, video):
    assert set(video.keys) == set(clip.files)
    assert video.sources == {new: old for old, new in video.keys.items()}
    images = {old: clip.image(old).tobytes() for old in clip.files}
    assert len(set(images.values())) == len(images)  # so that a mix-up would be seen
    for old, new in video.keys.items():
        assert video.clip.image(new).tobytes() == images[old]
        assert video.clip.mask(new).tobytes() == clip.mask(old).tobytes()
        assert video.clip.recorded(new) == old
        assert new.sequence == old.sequence


def test_the_video_is_the_training_split_camera_after_camera(clip, video):
    train = video.clip.splits["train"]
    assert [key.timestep for key in train] == list(range(len(clip.splits["train"])))
    sources = [video.sources[key] for key in train]
    assert set(sources) == set(clip.splits["train"])
    assert sources == sorted(sources, key=lambda key: (key.camera, key.timestep))


def test_no_frame_of_another_split_enters(clip, video):
    for name in ("novel_view", "self_reenactment"):
        assert {video.sources[key] for key in video.clip.splits[name]} == set(clip.splits[name])
        assert min(key.timestep for key in video.clip.splits[name]) >= len(clip.splits["train"])
    timesteps = [key.timestep for key in video.clip.files]
    assert len(set(timesteps)) == len(timesteps)
    excluded = {video.sources[key]: reason for key, reason in video.clip.excluded.items()}
    assert excluded == clip.excluded


def test_the_mesh_projects_where_it_did(clip, video):
    """Vertices that hang on the neck joint alone; correctives of the neck are what the head frame gives up."""
    correctives = clip.head.pose_basis.copy()
    correctives[:, :, :9] = 0
    model = HeadModel(replace(clip.head, pose_basis=correctives), dtype=torch.float64)
    identity = model.canonical(
        torch.tensor(np.asarray(clip.shape, float)), torch.tensor(np.asarray(clip.static_offset, float))
    )
    rigid = clip.head.skinning_weights[:, 1] > 1 - 1e-9
    assert rigid.sum() > 20

    def project(source, key):
        pose, camera = source.poses[key.timestep], source.cameras[key.camera]
        vertices = model(canonical=identity, **model.pose_arguments([pose]))[0].numpy()[rigid]
        points = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        pixels = points @ camera.K.T
        return pixels[:, :2] / pixels[:, 2:]

    for old in clip.files:
        new = video.keys[old]
        assert np.abs(project(video.clip, new) - project(clip, old)).max() < 1e-4
        pose = video.clip.poses[new.timestep]
        assert not np.any(np.concatenate([pose.rotation, pose.neck, pose.translation]))
        assert np.array_equal(pose.expression, clip.poses[old.timestep].expression)
        assert pose.timestep == new.timestep


def test_every_frame_has_its_own_camera(clip, video):
    cameras = [key.camera for key in video.clip.files]
    assert len(set(cameras)) == len(cameras)
    for old, new in video.keys.items():
        assert new.camera.startswith(old.camera)
        assert video.clip.cameras[new.camera].id == new.camera


def test_cameras_and_poses_can_stay(clip):
    video = as_single_video(clip, head_frame=False)
    assert set(video.clip.cameras) == set(SERIALS)
    old = clip.splits["train"][4]
    new = video.keys[old]
    assert new.camera == old.camera
    assert np.array_equal(video.clip.poses[new.timestep].rotation, clip.poses[old.timestep].rotation)


def test_pixel_steps_before_and_after_see_the_same_frames(clip):
    rule = ResolutionRule(divide=2)
    before = as_single_video(align_clip(clip, rule))
    after = align_clip(as_single_video(clip).clip, rule)
    for key in before.clip.splits["self_reenactment"]:
        assert np.array_equal(before.clip.image(key), after.image(key))
        assert np.allclose(before.clip.cameras[key.camera].K, after.cameras[key.camera].K)


def test_the_step_is_on_record(clip, video):
    assert video.clip.steps[-1].name == "as_single_video"
    assert video.clip.fingerprint != clip.fingerprint
    assert as_single_video(clip).clip.fingerprint == video.clip.fingerprint
