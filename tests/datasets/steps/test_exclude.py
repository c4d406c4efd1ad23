"""Leaving frames out by label."""

from __future__ import annotations

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.datasets.steps.exclude import (
    Exclusions,
    FrameDecision,
    exclude_timesteps,
    read_exclusions,
    read_labels,
    read_reasons,
    write_exclusions,
)

from .clips import make_clip


def test_labelled_frames_leave_every_split_and_are_listed():
    clip = make_clip(4, test=2)
    out = exclude_timesteps(clip, {1: "tongue out", 5: "blur"})
    assert {key.timestep for keys in out.splits.values() for key in keys} == {0, 2, 3, 4}
    assert {(key.timestep, reason) for key, reason in out.excluded.items()} == {
        (1, "tongue out"),
        (5, "blur"),
    }
    assert FrameKey("s", "q", 1, "b") in out.excluded
    assert len(out.excluded) + sum(map(len, out.splits.values())) == len(clip.files)
    assert clip.excluded == {}
    assert len(clip.splits["train"]) == 4
    both = exclude_timesteps(out, {2: "blur"})
    assert both.timesteps("train") == [0, 3]
    assert set(both.excluded.values()) == {"tongue out", "blur"}
    assert (both.steps[-1].name, both.steps[-1].input_fingerprint) == ("exclude_timesteps", out.fingerprint)
    assert len({clip.fingerprint, out.fingerprint, exclude_timesteps(clip, {2: "blur"}).fingerprint}) == 3


def test_labels_are_read_from_json(tmp_path):
    path = tmp_path / "labels.json"
    path.write_text('{"57": "tongue out", "3": "blur"}')
    assert read_labels(path) == {57: "tongue out", 3: "blur"}
    for text in ('{"-1": "blur"}', '{"a": "blur"}', '{"1": 2}', '{"1.5": "blur"}', "[]", ""):
        path.write_text(text)
        with pytest.raises(InputError):
            read_labels(path)


def _decisions(path, *, subject="s", sequence="q"):
    frames = {
        1: FrameDecision(sequence, 80.0, True, "tongue out"),
        2: FrameDecision(sequence, 0.0, False, ""),
    }
    write_exclusions(path, {subject: Exclusions(35.0, "given", ("a",), frames, {2: "blur"})})
    return path


def test_reasons_come_from_a_file_of_exclusions_or_of_labels(tmp_path):
    clip = make_clip(4)
    assert read_reasons(_decisions(tmp_path / "tongue.yaml"), clip) == {1: "tongue out", 2: "blur"}
    labels = tmp_path / "labels.json"
    labels.write_text('{"3": "blur"}')
    assert read_reasons(labels, clip) == {3: "blur"}


def test_exclusions_that_do_not_fit_are_refused(tmp_path):
    clip = make_clip(4)
    for changes, key in (
        ({"subject": "t"}, "subjects"),
        ({"sequence": "other"}, "subjects.s.frames.1.sequence"),
    ):
        with pytest.raises(InputError) as caught:
            read_reasons(_decisions(tmp_path / "a.yaml", **changes), clip)
        assert caught.value.key == key
    with pytest.raises(InputError, match="found 8, 9"):
        exclude_timesteps(clip, {9: "blur", 8: "blur"})
    with pytest.raises(InputError, match="training frames left"):
        exclude_timesteps(make_clip(2), {0: "blur", 1: "blur"})


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


def _faulty(key, value):
    """A file with another value at a dotted key; an ellipsis takes it away."""
    frame = {"sequence": "FREE", "score": 1.0, "excluded": False, "reason": ""}
    subject = {"overrides": {1: "keep"}, "threshold": 35.0, "frames": {"1": frame}}
    place = content = {"format": "headbench-exclusions-1", "subjects": {"900": subject}}
    *outer, last = key.split(".")
    for part in outer:
        place = place[part]
    place[last] = value
    if value is ...:
        del place[last]
    frames = subject["frames"]
    subject["frames"] = {int(timestep): frame for timestep, frame in frames.items()}
    return yaml.safe_dump(content)


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("format", "other", ""),
        ("subjects", [1], ""),
        ("subjects", {"../x": {"threshold": 35.0, "overrides": {}, "frames": {}}}, ""),
        ("subjects.900.threshold", "x", ""),
        ("subjects.900.threshold", float("nan"), ""),
        ("subjects.900.overrides", {"a": "keep"}, ".a"),
        ("subjects.900.overrides", {1: True}, ".1"),
        ("subjects.900.cameras", "cam", ""),
        ("subjects.900.frames", {-1: {}}, ".-1"),
        ("subjects.900.frames.1.excluded", "no", ""),
        ("subjects.900.frames.1.score", ..., ""),
    ],
)
def test_faults_are_named(tmp_path, key, value, named):
    path = tmp_path / "tongue.yaml"
    path.write_text(_faulty(key, value))
    with pytest.raises(InputError) as caught:
        read_exclusions(path)
    assert (caught.value.file, caught.value.key) == (str(path), key + named)


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
    text = _faulty("subjects.900.overrides", {12345: "keep"})
    path.write_text(text.replace("12345: keep", line))
    assert line in path.read_text()
    if read is not None:
        assert [*read_exclusions(path)["900"].overrides] == [read]
        return
    with pytest.raises(InputError):
        read_exclusions(path)
