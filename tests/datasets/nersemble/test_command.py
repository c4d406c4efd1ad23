"""What the command says: which subjects there are, and how to use what it made."""

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.nersemble.command import prepare_nersemble

from .recordings import SUBJECT


@pytest.mark.parametrize("name", ["paper", "ablation"])
def test_missing_subjects_are_named_with_those_there_are(name, pristine_recording, tmp_path):
    with pytest.raises(InputError) as error:
        prepare_nersemble(pristine_recording.settings(tmp_path / "out", subjects=name))
    assert error.value.key == "--subjects"
    assert error.value.found == SUBJECT
    assert f"--subjects {SUBJECT}" in error.value.remedy
    assert ('defaults to "paper"' in error.value.remedy) == (name == "paper")


def test_the_way_to_use_a_capture_names_its_head_model(recording, tmp_path):
    head = str(recording.head)
    for given, name, expected in (
        ("", "flame2020", "--head flame2020.pkl"),
        ("", "", "--head flame2023.pkl"),
        (head, "", f"--head {head}"),
    ):
        findings = prepare_nersemble(
            recording.settings(tmp_path / f"out-{name}-{bool(given)}", head=given, head_model=name)
        )
        assert f"{expected} --out" in findings.text
