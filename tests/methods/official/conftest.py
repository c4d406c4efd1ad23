"""The stand-in repository, and a clip whose principal points are not in the middle."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.process import ProgramError

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_clip
from .repository import export, fit, lip_numbers, make_repository

OFFSETS = {"00": (0.0, 0.0), "01": (3.3, -2.2), "02": (-1.6, 4.1)}


@pytest.fixture(scope="session")
def official_clip(head):
    """Two training cameras and one held out; principal points off by whole pixels and parts of them."""
    clip = toy_clip(head, timesteps=3, cameras=3, width=28, height=36)
    cameras = {}
    for name, camera in clip.cameras.items():
        K = camera.K.copy()
        K[:2, 2] += OFFSETS[name]
        cameras[name] = replace(camera, K=K)
    return replace(clip, cameras=cameras)


@pytest.fixture(scope="session")
def video_clip():
    """Twelve training frames of two equal cameras, a held-out one of other intrinsics, eyelids, and a lower end of the neck."""
    plain = toy_head(16, eyelids=True)
    boundary = np.flatnonzero(plain.template[:, 1] < -0.1)
    clip = toy_clip(
        replace(plain, regions=plain.regions | {"boundary": boundary}),
        timesteps=6,
        cameras=3,
        width=28,
        height=36,
    )
    cameras = {}
    for name, camera in clip.cameras.items():
        K = camera.K.copy()
        K[:2, 2] += (1.3, -2.2) if name != "02" else (-1.6, 4.1)
        cameras[name] = replace(camera, K=K)
    lids = {t: replace(pose, eyelids=np.array([0.1 * t, 0.5])) for t, pose in clip.poses.items()}
    return replace(clip, cameras=cameras, poses=lids)


@pytest.fixture
def repository(tmp_path, head):
    """Folder and commit of the stand-in, whose lips have numbers that no vertex of the head has."""
    return tmp_path / "repository", make_repository(tmp_path / "repository", *lip_numbers(head))


@pytest.fixture
def exported(method, video_clip, tmp_path):
    """What a method writes of the tracked video."""
    return export(method, video_clip, tmp_path / "work")


@pytest.fixture
def avatar(method, video_clip, tmp_path):
    """An avatar of the tracked video."""
    return fit(method, video_clip, tmp_path / "a")


@pytest.fixture
def behave(repository):
    """Make the stand-in behave in another way."""

    def set_behaviour(what):
        (repository[0] / "behaviour.txt").write_text(what)

    yield set_behaviour
    set_behaviour("")


@pytest.fixture
def faults_are_found(behave):
    """Each behaviour of the stand-in ends ``work`` with the error that is named for it, after which the work can be done."""

    def check(faults, work):
        for behaviour, expected in faults.items():
            behave(behaviour)
            with pytest.raises(ProgramError, match=expected):
                work()
            behave("")
            assert work()

    return check


def brightness(pose, refined):
    """What the stand-in draws of a pose: red by expression, green by rotation."""
    red = 100 + 40 * (float(pose.expression[0]) + 0.25 * refined)
    return np.floor(np.clip([red, 100 + 900 * float(pose.rotation[0])], 0, 255))
