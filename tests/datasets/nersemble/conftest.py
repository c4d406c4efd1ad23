"""Recordings that tests share, and copies that a test may damage."""

import os
import shutil
import sys

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


FAKE = """#!{python}
import sys
sys.path[:] = {path!r}
import cv2, numpy as np
words = sys.argv[1:]
open({log!r}, "w").write(" ".join(words))
data = np.frombuffer(sys.stdin.buffer.read(), np.uint8)
if {fails}:
    sys.exit("no such encoder")
width, height = map(int, words[words.index("-s") + 1].split("x"))
rate = float(words[words.index("-r") + 1])
writer = cv2.VideoWriter(words[-1], cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
for frame in data.reshape(-1, height, width, 3):
    writer.write(frame[..., ::-1].copy())
writer.release()
"""


@pytest.fixture
def ffmpeg(tmp_path, monkeypatch):
    """A program of that name that encodes by OpenCV, whose encoder of H.264 is not everywhere; it notes its words."""

    def make(fails=False):
        program = tmp_path / "bin" / "ffmpeg"
        program.parent.mkdir(exist_ok=True)
        log = tmp_path / "words"
        program.write_text(FAKE.format(python=sys.executable, path=sys.path, log=str(log), fails=fails))
        program.chmod(0o755)
        monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
        return log

    return make
