"""Recordings that tests share, and copies that a test may damage."""

import shutil

import pytest

from .recordings import Recording, write_recording


def _copied(pristine: Recording, folder) -> Recording:
    shutil.copytree(pristine.folder, folder)
    return Recording(folder, pristine.release)


@pytest.fixture(scope="session")
def pristine_recording(tmp_path_factory) -> Recording:
    """Frames as images with masks, second release; tests only read it."""
    return write_recording(tmp_path_factory.mktemp("images"))


@pytest.fixture(scope="session")
def pristine_videos(tmp_path_factory) -> Recording:
    """Frames as videos, second release; tests only read it."""
    return write_recording(tmp_path_factory.mktemp("videos"), images=False)


@pytest.fixture
def recording(pristine_recording, tmp_path) -> Recording:
    """A copy of the images that a test may damage."""
    return _copied(pristine_recording, tmp_path / "recording")


@pytest.fixture
def videos(pristine_videos, tmp_path) -> Recording:
    """A copy of the videos that a test may damage."""
    return _copied(pristine_videos, tmp_path / "videos")
