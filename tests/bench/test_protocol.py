from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.protocol import make_protocol


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
    }
    hashes = {replace(protocol, **{name: value}).hash for name, value in changes.items()}
    assert len(hashes | {protocol.hash}) == len(changes) + 1
    assert make_protocol("novel_view", [clip]).hash == protocol.hash


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


def test_clips_on_different_backgrounds_are_not_one_comparison(toy, clip, tmp_path):
    other = toy.ToyClip(tmp_path / "subject2")
    other.background = np.zeros(3)
    with pytest.raises(InputError, match="one colour"):
        make_protocol("novel_view", [clip, other])


@pytest.mark.parametrize(("count", "timesteps"), [(1, [1]), (2, [0, 2]), (3, [0, 1, 2]), (9, [0, 1, 2])])
def test_a_limit_takes_frames_evenly(clip, count, timesteps):
    assert [key.timestep for key in make_protocol("novel_view", [clip], count).keys] == timesteps
