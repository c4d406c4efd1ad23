import subprocess
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench.contracts import HeadPose
from headbench.bench.errors import InputError
from headbench.metrics.storage import driving_bytes, packed_bytes, storage

ZERO = np.zeros(3)
POSE = HeadPose("toy", np.zeros(100), ZERO, ZERO, ZERO, np.zeros(6), ZERO)


class Files:
    def __init__(self, *paths):
        self.paths = paths

    def files(self):
        return self.paths

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        raise AssertionError("storage draws nothing")


class Splats(Files):
    def splats(self, pose):
        return SimpleNamespace(means=np.zeros((1000, 3)))

    def shared_files(self):
        return [self.paths[0].with_name("head.npz")]


def test_counts_declared_files_once_in_si_megabytes(tmp_path):
    (tmp_path / "splats.ply").write_bytes(bytes(1_500_000))
    (tmp_path / "shape.npz").write_bytes(bytes(250_000))
    (tmp_path / "optimiser.pth").write_bytes(bytes(9_000_000))
    (tmp_path / "link.ply").symlink_to(tmp_path / "splats.ply")
    avatar = Files(*(tmp_path / name for name in ("splats.ply", "shape.npz", "splats.ply", "link.ply")))
    measured = storage(avatar, [])
    assert measured.value == 1.75
    assert (measured.details["bytes"], measured.details["files"]) == (1_750_000, 2)
    assert set(measured.details) == {"bytes", "files", "packed_mb"}


def test_an_avatar_of_splats_tells_primitives_and_what_it_shares(tmp_path):
    (tmp_path / "splats.ply").write_bytes(bytes(48_000))
    (tmp_path / "head.npz").write_bytes(bytes(3_000_000))
    details = storage(Splats(tmp_path / "splats.ply"), [("camera", POSE)]).details
    assert details["primitives"] == 1000
    assert details["primitive_bytes"] == 48.0
    assert details["shared_mb"] == 3.0


def test_the_driving_signal_is_float32_at_25_frames_a_second(tmp_path):
    (tmp_path / "a").write_bytes(b"1")
    details = storage(Files(tmp_path / "a"), [("camera", POSE)]).details
    assert details["driving_bytes"] == 4 * (100 + 3 + 3 + 3 + 6 + 3) == driving_bytes(POSE)
    assert details["driving_kb_s"] == 472 * 25 / 1000


def test_packed_bytes_are_those_of_the_xz_tool(tmp_path):
    noise = np.random.default_rng(0).integers(0, 4, 300_000, dtype=np.uint8).tobytes()
    paths = [tmp_path / "a.bin", tmp_path / "b.bin"]
    for path, part in zip(paths, (noise[:10_000], noise[10_000:])):
        path.write_bytes(part)
    found = packed_bytes(paths)
    packed = len(noise) * 2 / 8  # two bits of each byte are random
    assert packed < found < 1.2 * packed
    try:
        tool = subprocess.run(["xz", "-6", "-T1", "-c"], input=noise, capture_output=True, check=True)
    except FileNotFoundError:
        assert found < len(zlib.compress(noise, 9))
    else:
        assert found == pytest.approx(len(tool.stdout), abs=200)


def test_a_file_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"gone\.ply.*nothing there"):
        storage(Files(tmp_path / "gone.ply"))
    with pytest.raises(InputError, match="a folder"):
        storage(Files(tmp_path))
    with pytest.raises(InputError, match="at least one file"):
        storage(Files())
