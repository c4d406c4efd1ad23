"""Sequence names, splits, and grids of frames with holes."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.validate import (
    check_disjoint,
    require_full_grid,
    sequence_names,
    split_by_holding_out,
)

KEYS = [
    FrameKey("s", sequence, t, camera)
    for t, sequence in enumerate(["EMO-1-shout+laugh", "EMO-2-surprise+fear", "FREE"])
    for camera in "abc"
]


def test_names_are_declared_or_parsed_and_never_shared():
    entries = [SimpleNamespace(sequence_folder=f) for f in ("1_A_v16_x", "1_B_v16_x", "1_B_v16_y", "odd")]
    assert sequence_names(entries, {"1_A_v16_x": "declared"}) == {
        "1_A_v16_x": "declared",
        "1_B_v16_x": "1_B_v16_x",
        "1_B_v16_y": "1_B_v16_y",
        "odd": "odd",
    }


@settings(deadline=None)
@given(
    cameras=st.sets(st.sampled_from("abc")), sequences=st.sets(st.sampled_from(["EMO-1", "EMO-2", "FREE"]))
)
def test_every_frame_is_in_one_split_and_held_out_where_asked(cameras, sequences):
    splits = split_by_holding_out("x", KEYS, sorted(sequences), sorted(cameras))
    assert sorted(key for keys in splits.values() for key in keys) == sorted(KEYS)
    check_disjoint("x", splits)
    for key in splits["train"]:
        assert key.camera not in cameras
        assert not any(key.sequence.startswith(prefix) for prefix in sequences)
    assert all(key.camera in cameras for key in splits["novel_view"])
    assert {k for k in KEYS if any(k.sequence.startswith(p) for p in sequences)} == set(
        splits["self_reenactment"]
    )


def test_ambiguous_prefixes_and_repeated_keys_are_refused():
    with pytest.raises(InputError, match=r"EMO-1-shout\+laugh, EMO-2"):
        split_by_holding_out("x", KEYS, ["EMO"], [])
    with pytest.raises(InputError, match="every frame once"):
        check_disjoint("x", {"train": (KEYS[0], KEYS[1], KEYS[0])})
    with pytest.raises(InputError, match="2 frames in both"):
        check_disjoint("x", {"train": tuple(KEYS[:3]), "novel_view": tuple(KEYS[1:4])})


@pytest.mark.parametrize("holes", [1, 2])
def test_the_first_hole_is_named_and_the_others_counted(holes, pristine_capture):
    """A grid without a whole timestep passes."""
    clip = read_capture(pristine_capture.union)
    first = min(key.timestep for key in clip.files)
    rest = {key: files for key, files in clip.files.items() if key.timestep != first}
    for files in (clip.files, rest):
        require_full_grid(replace(clip, files=files))
    camera = [*clip.cameras][1]
    gone = sorted((key for key in clip.files if key.camera == camera), key=lambda key: key[:3])[:holes]
    files = {key: value for key, value in clip.files.items() if key not in gone}
    with pytest.raises(InputError) as caught:
        require_full_grid(replace(clip, files=files), "a/capture")
    assert (caught.value.file, caught.value.key) == ("a/capture", f"frame {gone[0]}")
    assert ("1 more missing" in caught.value.found) == (holes == 2)
