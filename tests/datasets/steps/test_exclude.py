"""Leaving frames out by label."""

from __future__ import annotations

import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.datasets.steps.exclude import (
    Exclusions,
    FrameDecision,
    exclude_timesteps,
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


def test_unknown_timestep_and_empty_training_are_refused():
    with pytest.raises(InputError, match="found 8, 9"):
        exclude_timesteps(make_clip(4), {9: "blur", 8: "blur"})
    with pytest.raises(InputError, match="training frames left"):
        exclude_timesteps(make_clip(2), {0: "blur", 1: "blur"})


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


def test_exclusions_of_another_subject_or_numbering_are_refused(tmp_path):
    clip = make_clip(4)
    with pytest.raises(InputError, match="headbench prepare tongue") as caught:
        read_reasons(_decisions(tmp_path / "a.yaml", subject="t"), clip)
    assert caught.value.key == "subjects"
    with pytest.raises(InputError, match="another numbering of timesteps") as caught:
        read_reasons(_decisions(tmp_path / "b.yaml", sequence="other"), clip)
    assert caught.value.key == "subjects.s.frames.1.sequence"
