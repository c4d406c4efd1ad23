"""Names: serials, frame numbers, sequences by prefix; the seeded rule against the table in the fact sheet."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.datasets.nersemble import names
from headbench.datasets.nersemble.names import SEQUENCES, match_sequence, numbered, serial_of


@pytest.mark.parametrize(
    ("wanted", "full"),
    [
        *((name, name) for name in SEQUENCES),
        *(("EMO-1", "EMO-1-shout+laugh"), ("EXP-3-cheeks", "EXP-3-cheeks+nose"), ("FR", "FREE")),
        ("SEN-02-same_phr", "SEN-02-same_phrase_thirty_times"),
    ],
)
def test_a_full_name_or_a_unique_prefix_matches(wanted, full):
    assert match_sequence("root", wanted, SEQUENCES) == full


@pytest.mark.parametrize("wanted", ["EMO", "SEN-0", "TALK", "", "EMO-1-shout+laugh-2"])
def test_none_or_several_matches_are_an_error(wanted):
    with pytest.raises(InputError) as error:
        match_sequence("root", wanted, SEQUENCES)
    assert error.value.key == "sequence"
    assert (
        match_sequence("root", "SEN-1", ["SEN-1-one", "SEN-10-ten"]) == "SEN-1-one"
    )  # it ends at the hyphen


@given(st.integers(0, 10**9 - 1), st.integers(0, 10**6 - 1))
def test_names_of_frames_are_taken_apart(serial, number):
    stem = f"cam_{serial:09d}_{number:06d}"
    assert numbered(stem) == (f"{serial:09d}", number)
    assert serial_of(f"cam_{serial:09d}", "cam") == f"{serial:09d}"
    assert numbered(f"{number:06d}") == ("", number)  # of a lone camera


@pytest.mark.parametrize("stem", ["cam_", "cam_22a", "image_1_2_3", "x_222_000000", "cam_1_2_x", "thumbs"])
def test_other_names_are_none_of_ours(stem):
    assert numbered(stem) is None


# Held-out sequences that VHAP's rule gives, computed apart from this code.
HELD_OUT = (
    *("074 EXP-2", "104 EXP-5", "140 EMO-2", "165 EXP-4", "175 EXP-5", "210 EXP-2", "218 EXP-8", "238 EXP-3"),
    *("253 EXP-4", "264 EMO-1", "302 EMO-3", "304 EXP-5", "306 EXP-4", "460 EMO-4"),
)


def test_the_seeded_rule_holds_out_the_known_sequence():
    for line in HELD_OUT:
        subject, held_out = line.split()
        assert names.union10_held_out(subject).startswith(f"{held_out}-")


def test_subjects_of_an_option():
    assert names.chosen_subjects("paper") == [*names.SUBJECTS]
    assert names.chosen_subjects("ablation") == ["306"]
    assert names.chosen_subjects("74, 104") == ["074", "104"]
    for text in ("", "074,74", "074;104", "../x", "all"):
        with pytest.raises(InputError) as error:
            names.chosen_subjects(text)
        assert error.value.key == "--subjects"
