"""Names: serials, frame numbers, sequences by prefix."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.datasets.nersemble.names import SEQUENCES, match_sequence, numbered, serial_of


@given(st.sampled_from(SEQUENCES))
def test_a_full_name_matches_itself(name):
    assert match_sequence("root", name, SEQUENCES) == name


@pytest.mark.parametrize(
    ("wanted", "full"),
    [
        ("EMO-1", "EMO-1-shout+laugh"),
        ("EXP-3-cheeks", "EXP-3-cheeks+nose"),
        ("SEN-01", "SEN-01-cramp_small_danger"),
        ("FR", "FREE"),
        ("SEN-02-same_phr", "SEN-02-same_phrase_thirty_times"),
    ],
)
def test_a_unique_prefix_matches(wanted, full):
    assert match_sequence("root", wanted, SEQUENCES) == full


@pytest.mark.parametrize("wanted", ["EMO", "SEN-0", "TALK", "", "EMO-1-shout+laugh-2"])
def test_none_or_several_matches_are_an_error(wanted):
    with pytest.raises(InputError) as error:
        match_sequence("root", wanted, SEQUENCES)
    assert error.value.key == "sequence"


def test_a_number_ends_at_the_hyphen():
    assert match_sequence("root", "SEN-1", ["SEN-1-one", "SEN-10-ten"]) == "SEN-1-one"


@given(st.integers(0, 10**9 - 1), st.integers(0, 10**6 - 1))
def test_names_of_frames_are_taken_apart(serial, number):
    stem = f"cam_{serial:09d}_{number:06d}"
    assert numbered(stem) == (f"{serial:09d}", number)
    assert serial_of(f"cam_{serial:09d}", "cam") == f"{serial:09d}"


@pytest.mark.parametrize("stem", ["cam_", "cam_22a", "image_1_2_3", "x_222_000000", "cam_1_2_x", "thumbs"])
def test_other_names_are_none_of_ours(stem):
    assert numbered(stem) is None


def test_a_lone_camera_has_no_serial_in_the_name():
    assert numbered("000012") == ("", 12)
