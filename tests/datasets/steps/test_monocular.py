"""Many views as one video: every key maps to its own image, and no test frame enters."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.engine.config import RunConfig
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.steps.for_method import as_single_video
from headbench.datasets.steps.rest import as_rigid_head

from ..tiny_capture import projected


@pytest.fixture(scope="module")
def video(clip):
    return as_single_video(clip)


@pytest.fixture(scope="module")
def sources(video):
    """Key in the source by key in the video."""
    return {new: old for old, new in video.keys.items()}


def test_every_key_maps_to_its_own_image_and_back(clip, video):
    assert set(video.keys) == set(clip.files)
    images = {old: clip.image(old).tobytes() for old in clip.files}
    assert len(set(images.values())) == len(images)  # so that a mix-up would be seen
    for old, new in video.keys.items():
        assert video.clip.image(new).tobytes() == images[old]
        assert video.clip.mask(new).tobytes() == clip.mask(old).tobytes()
        assert video.clip.recorded(new) == old
        assert new.sequence == old.sequence
        assert new.camera.startswith(old.camera)
        assert video.clip.cameras[new.camera].id == new.camera
    assert video.clip.steps[-1].name == "as_single_video"
    assert as_single_video(clip).clip.fingerprint == video.clip.fingerprint != clip.fingerprint


def test_the_video_is_the_training_split_camera_after_camera(clip, video, sources):
    train = video.clip.splits["train"]
    assert [key.timestep for key in train] == list(range(len(clip.splits["train"])))
    assert [sources[key] for key in train] == sorted(
        clip.splits["train"], key=lambda key: (key.camera, key.timestep)
    )


def test_no_frame_of_another_split_enters(clip, video, sources):
    for name in ("novel_view", "self_reenactment"):
        assert {sources[key] for key in video.clip.splits[name]} == set(clip.splits[name])
        assert min(key.timestep for key in video.clip.splits[name]) >= len(clip.splits["train"])
    for own in ("timestep", "camera"):
        assert len({getattr(key, own) for key in video.clip.files}) == len(clip.files)
    excluded = {sources[key]: reason for key, reason in video.clip.excluded.items()}
    assert excluded == clip.excluded


def test_the_mesh_projects_where_it_did(clip, video):
    """Vertices that hang on the neck joint alone; correctives of the neck are what the head frame gives up."""
    correctives = clip.head.pose_basis.copy()
    correctives[:, :, :9] = 0
    subject = PosedSubject(replace(clip.head, pose_basis=correctives), clip.shape, clip.static_offset)
    rigid = clip.head.skinning_weights[:, 1] > 1 - 1e-9
    assert rigid.sum() > 20

    def seen(source, key):
        pose, camera = source.poses[key.timestep], source.cameras[key.camera]
        return projected(subject.meshes([pose])[0, rigid], camera)

    for old in clip.files:
        new = video.keys[old]
        assert np.abs(seen(video.clip, new) - seen(clip, old)).max() < 1e-4
        pose = video.clip.poses[new.timestep]
        assert not np.any([pose.rotation, pose.neck, pose.translation])
        assert np.array_equal(pose.expression, clip.poses[old.timestep].expression)
        assert pose.timestep == new.timestep


def test_a_rigid_head_follows_no_neck(clip):
    """Vertices that follow the neck fully stay where they were; those of the root move with the head."""
    neck = np.array([0.1, -0.2, 0.05])
    poses = {t: replace(pose, neck=neck * (1 + t), translation=neck) for t, pose in clip.poses.items()}
    # Without correctives, since those of the neck go with its rotation.
    head = replace(clip.head, pose_basis=np.zeros_like(clip.head.pose_basis))
    turned = replace(clip, poses=poses, head=head)
    rigid = as_rigid_head(turned, RunConfig(data="", out=""))
    assert rigid.steps[-1].name == "as_rigid_head"
    assert rigid.fingerprint != turned.fingerprint
    subject = PosedSubject.of(turned)
    weights = clip.head.skinning_weights
    above, below = weights[:, 0] == 0, weights[:, 0] > 0.5
    assert above.any()
    assert below.any()
    for timestep, pose in rigid.poses.items():
        assert not pose.neck.any()
        before, after = subject.meshes([turned.poses[timestep], pose])
        moved = np.linalg.norm(after - before, axis=1)
        assert moved[above].max() < 1e-6
        assert moved[below].max() > 1e-3
        assert np.array_equal(pose.jaw, turned.poses[timestep].jaw)
