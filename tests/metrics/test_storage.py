import pytest

from headbench.bench.errors import InputError
from headbench.metrics.storage import storage


class Files:
    def __init__(self, *paths):
        self.paths = paths

    def files(self):
        return self.paths


def test_counts_declared_files_once_in_si_megabytes(tmp_path):
    (tmp_path / "splats.ply").write_bytes(bytes(1_500_000))
    (tmp_path / "shape.npz").write_bytes(bytes(250_000))
    (tmp_path / "optimiser.pth").write_bytes(bytes(9_000_000))
    (tmp_path / "link.ply").symlink_to(tmp_path / "splats.ply")
    avatar = Files(*(tmp_path / name for name in ("splats.ply", "shape.npz", "splats.ply", "link.ply")))
    measured = storage(avatar, [])
    assert measured.value == 1.75
    assert measured.details == {"bytes": 1_750_000, "files": 2}


def test_a_file_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"gone\.ply.*nothing there"):
        storage(Files(tmp_path / "gone.ply"))
    with pytest.raises(InputError, match="a folder"):
        storage(Files(tmp_path))
    with pytest.raises(InputError, match="at least one file"):
        storage(Files())
