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


@pytest.mark.parametrize(
    ("name", "expected"), [("flame2020", "flame2020.pkl"), ("", "flame2023.pkl"), ("own", "")]
)
def test_the_way_to_use_a_capture_names_its_head_model(pristine_recording, tmp_path, name, expected):
    head = str(pristine_recording.head) if name == "own" else ""
    changes = {"head": head, "head_model": "" if head else name}
    findings = prepare_nersemble(pristine_recording.settings(tmp_path / "out", **changes))
    assert f"--head {expected or head} --out" in findings.text
