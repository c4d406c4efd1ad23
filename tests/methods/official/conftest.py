"""Clips whose principal points are not in the middle, and stand-ins of all adapters, built and trained once and copied."""

import shutil
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from headbench.methods.official import checkout
from headbench.methods.official.gha import method as gha

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_clip
from .helpers import export, fit
from .repository import ADAPTERS

OFFSETS = {"00": (0.0, 0.0), "01": (3.3, -2.2), "02": (-1.6, 4.1)}
OF_VIDEO = ("rgbavatar", "flashavatar")
"""Adapters that are tested with the clip of equal cameras."""
MORE_SETTINGS = {"gha": {"mesh_fraction": 0.25}, "insta": {"python": ""}}


def with_offsets(clip, offsets):
    cameras = {}
    for name, camera in clip.cameras.items():
        K = camera.K.copy()
        K[:2, 2] += offsets[name]
        cameras[name] = replace(camera, K=K)
    return replace(clip, cameras=cameras)


@pytest.fixture(scope="session")
def official_clip(head):
    """Two training cameras and one held out; principal points off by whole pixels and parts of them."""
    return with_offsets(toy_clip(head, timesteps=3, cameras=3, width=28, height=36), OFFSETS)


@pytest.fixture(scope="session")
def video_clip():
    """Twelve training frames of two equal cameras, a held-out one of other intrinsics, eyelids, and a lower end of the neck."""
    plain = toy_head(16, eyelids=True)
    boundary = np.flatnonzero(plain.template[:, 1] < -0.1)
    head = replace(plain, regions=plain.regions | {"boundary": boundary})
    clip = toy_clip(head, timesteps=6, cameras=3, width=28, height=36)
    lids = {t: replace(pose, eyelids=np.array([0.1 * t, 0.5])) for t, pose in clip.poses.items()}
    same = dict.fromkeys(("00", "01"), (1.3, -2.2))
    return with_offsets(replace(clip, poses=lids), {**same, "02": (-1.6, 4.1)})


@pytest.fixture(scope="session")
def answers():
    """Answers of this interpreter by the question and the environment: asking takes a second, mostly of importing torch."""
    ask, found = checkout._answer, {}

    def answer(command, *arguments):
        if command[0] != sys.executable:
            return ask(command, *arguments)
        key = (*command, *arguments, *checkout.environment().items())
        if key not in found:
            found[key] = ask(command, *arguments)
        return found[key]

    return answer


@pytest.fixture(scope="session", autouse=True)
def small_renders_and_a_gpu(answers):
    """Renders of Gaussian Head Avatar of 64 pixels instead of 2048, and a device for INSTA's program."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkout, "_answer", answers)
        patch.setattr(gha, "RENDERED", 64)
        patch.setattr(checkout, "_DEVICES", "print('headbench-devices', 1)")
        yield


@pytest.fixture(scope="session")
def made(official_clip, video_clip, tmp_path_factory):
    """Method around its stand-in by name, each made once. Its place has words in it that INSTA's program looks for in paths."""

    def make(name):
        folder = tmp_path_factory.mktemp(name) / "train and test $(false)"
        implementation, make = ADAPTERS[name]
        commit = make(folder, (video_clip if name in OF_VIDEO else official_clip).head)
        settings = {"checkout": str(folder), "python": sys.executable, "commit": commit}
        return implementation(implementation.config_class(**{**settings, **MORE_SETTINGS.get(name, {})}))

    return cache(make)


@pytest.fixture(scope="session")
def trained(made, official_clip, video_clip, tmp_path_factory):
    """Folder of an avatar by name of the method, trained once, and the progress of its training."""

    def train(name):
        folder, calls = tmp_path_factory.mktemp(f"{name}-avatar") / "avatar", []
        clip = video_clip if name in OF_VIDEO else official_clip
        fit(made(name), clip, folder, lambda done, total, note="": calls.append((done, total, note)))
        return folder, calls

    return cache(train)


@pytest.fixture
def name(request):
    """The adapter that a module or class of tests is about."""
    return getattr(request.cls, "NAME", None) or request.module.NAME


@pytest.fixture
def clip(name, official_clip, video_clip):
    return video_clip if name in OF_VIDEO else official_clip


@pytest.fixture
def method(name, made):
    return type(made(name))(made(name).config)


@pytest.fixture
def repository(method, tmp_path):
    """Folder and commit of a copy of the stand-in that a test changes; the method is set to it."""
    folder = tmp_path / "repository"
    shutil.copytree(method.config.checkout, folder)
    method.config = replace(method.config, checkout=str(folder))
    return folder, method.config.commit


@pytest.fixture
def behave(method):
    """Make the stand-in behave in another way."""
    place = Path(method.config.checkout) / "behaviour.txt"
    yield place.write_text
    place.unlink(missing_ok=True)


@pytest.fixture
def avatar(name, method, trained, tmp_path):
    """A copy of the trained avatar."""
    shutil.copytree(trained(name)[0], tmp_path / "avatar")
    return method.load(tmp_path / "avatar", device="cpu")


@pytest.fixture
def exported(method, clip, tmp_path):
    """What a method writes of the training frames."""
    return export(method, clip, tmp_path / "work")
