"""The reader of a capture is found by what the folder holds, or by name; its settings are checked."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench import registry
from headbench.bench.contracts import no_progress
from headbench.bench.engine.adaptation import MethodNeeds, adapter
from headbench.bench.errors import InputError
from headbench.bench.specs import ResolutionRule
from headbench.datasets.clip import as_capture
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.open import find_reader, open_clip
from headbench.datasets.steps.for_method import align_clip
from headbench.datasets.steps.masks import set_background


def test_a_capture_is_opened_by_the_reader_that_finds_it(pristine_capture):
    assert find_reader(pristine_capture.union).name == "ga"
    clip = open_clip(pristine_capture.union, wishes={"leaks": "record", "unheard of": 1})
    assert clip.fingerprint == read_capture(pristine_capture.union, leaks="record").fingerprint


def test_settings_that_the_reader_lacks_are_refused(pristine_capture):
    with pytest.raises(InputError, match="reader_settings, hed: expected .*head.*found"):
        open_clip(pristine_capture.union, settings={"hed": "x"})


@pytest.mark.parametrize(
    ("data", "found"),
    [("", "an empty folder"), ("a.mp4", "a folder of videos"), (None, "no such file or folder")],
)
def test_what_is_no_capture_is_described(tmp_path, data, found):
    folder = tmp_path / "data"
    if data is not None:
        folder.mkdir()
    if data:
        (folder / data).touch()
    with pytest.raises(InputError, match=rf"a reader knows .*colmap.*{found}"):
        open_clip(folder)


def fails(root):
    raise KeyError(root)


def test_readers_of_plug_ins_beside_the_one_that_fits(pristine_capture, monkeypatch, caplog):
    known = registry.discover("datasets")

    def offer(**changes):
        twin = replace(known["ga"], name="other", spec=replace(known["ga"].spec, name="other", **changes))
        monkeypatch.setattr(registry, "discover", lambda group: {**known, "other": twin})

    offer()
    with pytest.raises(InputError, match=r"one for ga, other. Choose with --reader"):
        open_clip(pristine_capture.union)
    assert open_clip(pristine_capture.union, "ga").poses
    offer(find=f"{__name__}:fails")
    assert find_reader(pristine_capture.union).name == "ga"
    assert "reader other cannot check" in caplog.text


def test_a_clip_of_another_reader_passes_through_steps(plain_folder, pristine_capture):
    clip, same = open_clip(plain_folder, "plain_reader:SPEC"), read_capture(pristine_capture.union)
    assert as_capture(clip) is clip
    assert clip.source_fingerprint == f"plain-{same.fingerprint}"
    changed, expected = (
        align_clip(set_background(one, (0.0, 0.5, 1.0)), ResolutionRule(divide=2)) for one in (clip, same)
    )
    for key in sorted(same.files):
        np.testing.assert_array_equal(clip.image(key), same.image(key))
        np.testing.assert_array_equal(clip.mask(key), same.mask(key))
        np.testing.assert_array_equal(changed.image(key), expected.image(key))
        np.testing.assert_array_equal(changed.mask(key), expected.mask(key))
    assert clip.region_names == same.region_names


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda clip: {"shape": clip.shape[:-1]}, "shape"),
        (lambda clip: {"static_offset": clip.static_offset[:-1]}, "static_offset"),
        (lambda c: {"poses": {t: replace(p, expression=[0.0]) for t, p in c.poses.items()}}, "expression"),
    ],
)
def test_a_clip_of_another_head_model_is_refused(plain_folder, change, key):
    clip = open_clip(plain_folder, "plain_reader:SPEC").source
    vars(clip).update(change(clip))
    with pytest.raises(InputError) as caught:
        as_capture(clip)
    assert caught.value.key == key


def test_a_clip_of_another_reader_is_adapted_to_methods(plain_folder, pristine_capture, tmp_path):
    needs = MethodNeeds(monocular=True, resolution=ResolutionRule(divide=2))
    same = read_capture(pristine_capture.union)
    clips = open_clip(plain_folder, "plain_reader:SPEC").source, same
    adapted = [adapter()(clip, needs, {})(tmp_path, no_progress) for clip in clips]
    key = same.splits["novel_view"][0]
    images = [one.clip.image(one.key(key)) for one in adapted]
    np.testing.assert_array_equal(*images)
