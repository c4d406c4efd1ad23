"""Presets: the seeded rule against the table in the fact sheet, and the options' subjects."""

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.nersemble import names as presets
from headbench.datasets.nersemble.names import SEQUENCES
from headbench.datasets.synthetic.plan import SERIALS

# Held-out sequences that VHAP's rule gives, computed apart from this code.
HELD_OUT = {
    "074": "EXP-2",
    "104": "EXP-5",
    "140": "EMO-2",
    "165": "EXP-4",
    "175": "EXP-5",
    "210": "EXP-2",
    "218": "EXP-8",
    "238": "EXP-3",
    "253": "EXP-4",
    "264": "EMO-1",
    "302": "EMO-3",
    "304": "EXP-5",
    "306": "EXP-4",
    "460": "EMO-4",
}


@pytest.mark.parametrize("subject", HELD_OUT)
def test_the_seeded_rule_holds_out_the_known_sequence(subject):
    assert presets.union10_held_out(subject).startswith(f"{HELD_OUT[subject]}-")


def test_presets_name_what_exists():
    assert set(presets.PAPER_SEQUENCES) <= set(SEQUENCES)
    assert len(SEQUENCES) == len(set(SEQUENCES)) == 26
    assert SERIALS[8] == presets.NOVEL_VIEW_CAMERA
    assert presets.ABLATION_SUBJECT not in presets.SUBJECTS
    assert len(presets.SUBJECTS) == 9


def test_subjects_of_an_option():
    assert presets.chosen_subjects("paper") == [*presets.SUBJECTS]
    assert presets.chosen_subjects("ablation") == ["306"]
    assert presets.chosen_subjects("74, 104") == ["074", "104"]


@pytest.mark.parametrize("text", ["", "074,74", "074;104", "../x", "all"])
def test_other_options_are_refused(text):
    with pytest.raises(InputError) as error:
        presets.chosen_subjects(text)
    assert error.value.key == "--subjects"
