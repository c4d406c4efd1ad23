"""Stand-ins of all adapters, and clips whose principal points are not in the middle."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.methods.official import checkout
from headbench.methods.official.gha import method as gha
from headbench.methods.official.insta.method import INSTAOfficial

from ...datasets.head.toy import toy_head
from ..toy_clip import toy_clip
from .blendshapes_repository import BlendshapesStandIn, make_blendshapes_repository
from .flashavatar_repository import FlashAvatarStandIn, make_flashavatar_repository
from .insta_repository import make_insta_repository
from .repository import (
    HeadAvatarStandIn,
    StandIn,
    TensorialStandIn,
    export,
    fit,
    lip_numbers,
    make_head_avatar_repository,
    make_repository,
)
from .rgbavatar_repository import RGBAvatarStandIn, make_rgbavatar_repository

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

    answer.ask = ask
    return answer


@pytest.fixture(autouse=True)
def small_renders_and_a_gpu(monkeypatch, answers):
    """Renders of Gaussian Head Avatar of 64 pixels instead of 2048, and a device for INSTA's program."""
    monkeypatch.setattr(checkout, "_answer", answers)
    monkeypatch.setattr(gha, "RENDERED", 64)
    monkeypatch.setattr(checkout, "_DEVICES", "print('headbench-devices', 1)")


ADAPTERS = {
    "ga": (StandIn, lambda folder, head: make_repository(folder, *lip_numbers(head))),
    "tga": (TensorialStandIn, lambda folder, head: make_repository(folder, *lip_numbers(head))),
    "gbs": (BlendshapesStandIn, lambda folder, head: make_blendshapes_repository(folder, 1)),
    "gha": (HeadAvatarStandIn, lambda folder, head: make_head_avatar_repository(folder)),
    "insta": (INSTAOfficial, lambda folder, head: make_insta_repository(folder)),
    "rgbavatar": (
        RGBAvatarStandIn,
        lambda folder, head: make_rgbavatar_repository(folder, len(head.template), len(head.faces)),
    ),
    "flashavatar": (
        FlashAvatarStandIn,
        lambda folder, head: make_flashavatar_repository(folder, len(head.template)),
    ),
}
"""Methods by name, and what writes their repository for a head and returns its commit."""
OF_VIDEO = ("rgbavatar", "flashavatar")
"""Adapters that are tested with the clip of equal cameras."""
MORE_SETTINGS = {"gha": {"mesh_fraction": 0.25}, "insta": {"python": ""}}


@pytest.fixture
def name(request):
    """The adapter that a module tests."""
    return request.module.NAME


@pytest.fixture
def clip(name, official_clip, video_clip):
    return video_clip if name in OF_VIDEO else official_clip


@pytest.fixture
def method(name, clip, tmp_path):
    """A method around a stand-in for its repository, at a place with words in it that INSTA's program looks for in paths."""
    folder = tmp_path / "train and test $(false)"
    implementation, make = ADAPTERS[name]
    commit = make(folder, clip.head)
    settings = {"checkout": str(folder), "python": sys.executable, "commit": commit}
    return implementation(implementation.config_class(**{**settings, **MORE_SETTINGS.get(name, {})}))


@pytest.fixture
def repository(method):
    """Folder and commit of the stand-in."""
    return Path(method.config.checkout), method.config.commit


@pytest.fixture
def behave(repository):
    """Make the stand-in behave in another way."""
    yield (repository[0] / "behaviour.txt").write_text
    (repository[0] / "behaviour.txt").write_text("")


@pytest.fixture
def exported(method, clip, tmp_path):
    """What a method writes of the training frames."""
    return export(method, clip, tmp_path / "work")


@pytest.fixture
def avatar(method, clip, tmp_path):
    return fit(method, clip, tmp_path / "train" / "avatar")


def brightness(pose, refined):
    """What the stand-in draws of a pose: red by expression, green by rotation."""
    red = 100 + 40 * (float(pose.expression[0]) + 0.25 * refined)
    return np.floor(np.clip([red, 100 + 900 * float(pose.rotation[0])], 0, 255))
