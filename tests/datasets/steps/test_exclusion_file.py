"""The file of exclusions: what is written is read, people's word wins, faults are named."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.datasets.steps.exclude import Exclusions, FrameDecision, read_exclusions, write_exclusions

TEXT = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=20)
FRAMES = st.dictionaries(
    st.integers(0, 10**6), st.builds(FrameDecision, TEXT, st.floats(0, 1e6), st.booleans(), TEXT), max_size=5
)
WORDS = st.dictionaries(
    st.integers(0, 10**6), TEXT.filter(lambda word: word.strip().lower() not in ("", "keep")), max_size=3
)
DECIDED = Exclusions(
    35.0,
    "given",
    ("cam",),
    {
        3: FrameDecision("FREE", 80.0, True, "tongue out"),
        4: FrameDecision("FREE", 70.0, True, "tongue out"),
        5: FrameDecision("FREE", 0.0, False, ""),
    },
    {4: "keep", 5: "hand before the mouth", 7: "blur"},
)


@given(frames=FRAMES, overrides=WORDS, threshold=st.floats(0.1, 1e6), cameras=st.lists(TEXT, max_size=3))
def test_what_is_written_is_read(tmp_path_factory, frames, overrides, threshold, cameras):
    path = tmp_path_factory.mktemp("file") / "tongue.yaml"
    made = Exclusions(threshold, "basis", tuple(cameras), frames, overrides)
    write_exclusions(path, {"900": made, "e1": DECIDED})
    found = read_exclusions(path)
    assert list(found) == ["900", "e1"]
    assert found["900"].frames == frames
    assert found["900"].overrides == overrides
    assert (found["900"].threshold, found["900"].cameras) == (threshold, tuple(cameras))


def test_overrides_win():
    assert DECIDED.reasons() == {3: "tongue out", 5: "hand before the mouth", 7: "blur"}


def _faulty(change):
    content = {
        "format": "headbench-exclusions-1",
        "subjects": {
            "900": {
                "overrides": {1: "keep"},
                "threshold": 35.0,
                "frames": {1: {"sequence": "FREE", "score": 1.0, "excluded": False, "reason": ""}},
            }
        },
    }
    change(content, content["subjects"]["900"])
    return yaml.safe_dump(content)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda top, subject: top.update(format="other"), "format"),
        (lambda top, subject: top.update(subjects=[1]), "subjects"),
        (lambda top, subject: subject.update(threshold="x"), "subjects.900.threshold"),
        (lambda top, subject: subject.update(threshold=float("nan")), "subjects.900.threshold"),
        (lambda top, subject: subject.update(overrides={"a": "keep"}), "subjects.900.overrides.a"),
        (lambda top, subject: subject.update(overrides={1: True}), "subjects.900.overrides.1"),
        (lambda top, subject: subject.update(cameras="cam"), "subjects.900.cameras"),
        (lambda top, subject: subject["frames"].update({-1: {}}), "subjects.900.frames.-1"),
        (lambda top, subject: subject["frames"][1].update(excluded="no"), "subjects.900.frames.1.excluded"),
        (lambda top, subject: subject["frames"][1].pop("score"), "subjects.900.frames.1.score"),
        (
            lambda top, subject: top["subjects"].update({"../x": dict(subject, overrides={}, frames={})}),
            "subjects",
        ),
    ],
)
def test_faults_are_named(tmp_path, change, key):
    path = tmp_path / "tongue.yaml"
    path.write_text(_faulty(change))
    with pytest.raises(InputError) as caught:
        read_exclusions(path)
    assert (caught.value.file, caught.value.key) == (str(path), key)


@pytest.mark.parametrize(
    ("line", "read"),
    [
        ("057: keep", 57),
        ("00057: keep", 57),
        ("0x39: keep", None),
        ("1:30: keep", None),
        ("12345: keep\n      12345: hand", None),
    ],
)
def test_timesteps_are_decimal_numbers(tmp_path, line, read):
    """A timestep copied with its zeros, 00057, is not the octal 47."""
    path = tmp_path / "tongue.yaml"
    text = _faulty(lambda top, subject: subject.update(overrides={12345: "keep"}))
    path.write_text(text.replace("12345: keep", line))
    assert line in path.read_text()
    if read is not None:
        assert [*read_exclusions(path)["900"].overrides] == [read]
        return
    with pytest.raises(InputError):
        read_exclusions(path)


@pytest.mark.parametrize(
    ("written", "read"), [*(({1: word}, {1: "keep"}) for word in ("Keep", "KEEP", " keep ")), (None, {})]
)
def test_keep_however_it_is_written_and_an_emptied_section(tmp_path, written, read):
    path = tmp_path / "tongue.yaml"
    path.write_text(_faulty(lambda top, subject: subject.update(overrides=written)))
    found = read_exclusions(path)["900"]
    assert found.overrides == read
    assert found.reasons() == {}


def test_a_missing_file_says_how_to_make_one(tmp_path):
    with pytest.raises(InputError, match="headbench prepare tongue"):
        read_exclusions(tmp_path / "none.yaml")
