"""Every camera at every timestep: a grid with holes is told by its first one and their number."""

from __future__ import annotations

from dataclasses import replace

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.validate import require_full_grid

from ..tiny_capture import write_tiny_capture


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return read_capture(write_tiny_capture(tmp_path_factory.mktemp("capture")).union)


def test_a_whole_grid_passes_and_so_does_one_without_a_whole_timestep(clip):
    require_full_grid(clip)
    first = min(key.timestep for key in clip.files)
    rest = {key: files for key, files in clip.files.items() if key.timestep != first}
    require_full_grid(replace(clip, files=rest))


@pytest.mark.parametrize("holes", [1, 2])
def test_the_first_hole_is_named_and_the_others_counted(holes, clip):
    camera = [*clip.cameras][1]
    gone = sorted((key for key in clip.files if key.camera == camera), key=lambda key: key[:3])[:holes]
    files = {key: value for key, value in clip.files.items() if key not in gone}
    with pytest.raises(InputError) as caught:
        require_full_grid(replace(clip, files=files), "a/capture")
    assert (caught.value.file, caught.value.key) == ("a/capture", f"frame {gone[0]}")
    assert ("1 more missing" in caught.value.found) == (holes == 2)
