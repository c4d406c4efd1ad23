from dataclasses import asdict, replace

import numpy as np
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.bench.io.files import digest
from headbench.bench.protocol import (
    evenly_with_ends,
    make_protocol,
    make_protocol_without_truth,
    make_protocols,
    missing_tasks,
)

SIZE = (8, 6)


@pytest.fixture
def clip(toy, tmp_path):
    return toy.ToyClip(tmp_path / "subject1")


def test_every_field_changes_the_hash(clip):
    protocol = make_protocol("novel_view", [clip])
    changes = {
        "task": "self_reenactment",
        "keys": protocol.keys[1:],
        "excluded": (),
        "clips": (("subject1", "other"),),
        "resolution": "half",
        "background": (0.0, 0.0, 0.0),
        "quantisation": "floor",
        "metric_profile": "3dgs",
        "conditions": (("who drives", "another"),),
    }
    hashes = {replace(protocol, **{name: value}).hash for name, value in changes.items()}
    assert len(hashes | {protocol.hash}) == len(changes) + 1
    assert make_protocol("novel_view", [clip]).hash == protocol.hash


def test_a_protocol_without_conditions_keeps_its_former_hash(clip):
    protocol = make_protocol("novel_view", [clip])
    fields = {name: value for name, value in asdict(protocol).items() if name != "conditions"}
    assert protocol.hash == digest(protocol.id, fields)[:12]


def test_trials_are_keyed_whatever_the_order_they_are_made_in(clip):
    keys = [FrameKey("subject1", "pc1+2", t, "view") for t in range(3)]
    made = make_protocol_without_truth(
        "extremes", [clip, clip], [*keys[::-1], keys[0]], [SIZE, SIZE], {"b": "2", "a": "1"}
    )
    again = make_protocol_without_truth("extremes", [clip], keys, [SIZE], {"a": "1", "b": "2"})
    assert made == again
    assert made.resolution == "8x6"
    assert made.id == "extremes/canonical/1"


def test_keys_do_not_depend_on_the_order_of_the_split(clip):
    before = make_protocol("novel_view", [clip])
    clip.splits["novel_view"] = clip.splits["novel_view"][::-1]
    assert make_protocol("novel_view", [clip]) == before


def test_a_leak_is_refused(clip):
    clip.splits["novel_view"] += clip.splits["train"][:1]
    with pytest.raises(InputError, match="no frame of the training split"):
        make_protocol("novel_view", [clip])


def test_a_task_without_frames_is_refused(clip):
    clip.splits["novel_view"] = ()
    with pytest.raises(InputError, match="at least one frame"):
        make_protocol("novel_view", [clip])


def test_a_task_that_no_clip_can_do_is_left_out_and_named(toy, clip, tmp_path):
    tasks = ("novel_view", "self_reenactment")
    assert [*make_protocols(tasks, [clip], None)] == [*tasks]
    assert missing_tasks(tasks, tasks) == {}
    other = toy.ToyClip(tmp_path / "subject2")
    other.splits["novel_view"] = ()
    assert [*make_protocols(tasks, [other], None)] == ["self_reenactment"]
    assert "one camera" in missing_tasks(tasks, ["self_reenactment"])["novel_view"]
    for clips, asked in (([clip, other], tasks), ([other], ("novel_view",))):
        with pytest.raises(InputError, match="at least one frame"):
            make_protocols(asked, clips, None)


def test_clips_on_different_backgrounds_are_not_one_comparison(toy, clip, tmp_path):
    other = toy.ToyClip(tmp_path / "subject2")
    other.background = np.zeros(3)
    with pytest.raises(InputError, match="one colour"):
        make_protocol("novel_view", [clip, other])


@pytest.mark.parametrize(("count", "timesteps"), [(1, [1]), (2, [0, 2]), (3, [0, 1, 2]), (9, [0, 1, 2])])
def test_a_limit_takes_frames_evenly(clip, count, timesteps):
    assert [key.timestep for key in make_protocol("novel_view", [clip], count).keys] == timesteps


@pytest.mark.parametrize(
    ("count", "most", "chosen"),
    [(0, 3, []), (1, 3, [0]), (5, 1, [0]), (5, 2, [0, 4]), (5, 3, [0, 2, 4]), (5, 9, [0, 1, 2, 3, 4])],
)
def test_evenly_spread_items_include_both_ends(count, most, chosen):
    assert evenly_with_ends(range(count), most) == chosen
