from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from headbench.bench.configuration import build_file
from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.bench.io.files import digest
from headbench.bench.protocol import (
    FOLDER,
    NamedProtocol,
    TaskFrames,
    check_capture,
    evenly_with_ends,
    make_protocol,
    make_protocol_without_truth,
    make_protocols,
    missing_tasks,
    named_protocols,
    needed,
)
from headbench.bench.registry import discover


def test_every_protocol_names_its_profile_and_source():
    assert len(named_protocols()) >= 8
    for name, protocol in named_protocols().items():
        assert protocol.profile in discover("profiles"), name
        assert protocol.source
        assert protocol.title


CHANGES = [
    ({"mask": "face"}, "mask: expected one of"),
    ({"tasks": {"drive": {}}}, "tasks: novel_view, self_reenactment or cross_reenactment; found drive"),
    ({"tasks": {"cross_reenactment": {}}}, "metrics: CSIM or AED or APD or AKD.*found psnr@ga-training"),
    ({"tasks": {"novel_view": {"share": 1}}}, "share: between 0 and 1, or null; found 1"),
    ({"tasks": {"novel_view": {"cameras": "new"}}}, "cameras: expected one of .*, found 'new'"),
    ({"tasks": {"novel_view": {"last": 0}}}, "last: at least 1, or null for all; found 0"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=str)
def test_a_file_with_a_wrong_key_or_value_is_refused(tmp_path, change, message):
    content = yaml.safe_load((FOLDER / "tensorial-2025.yaml").read_text())
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(content | change))
    with pytest.raises(InputError, match=message):
        build_file(NamedProtocol, tmp_path / "p.yaml")


DIGESTS = {
    "ava-256": "190547d8fa32",
    "few-images": "090d1c25218b",
    "hdtf": "e10eac07fb66",
    "last-10-percent": "b85a585d8289",
    "vfhq-cross": "333f7ca55c77",
    "vfhq-self": "661638fea8af",
}


@pytest.mark.parametrize("name", DIGESTS)
def test_a_protocol_of_pictures_keeps_its_hash(name):
    protocol = named_protocols()[name]
    assert digest(name, asdict(protocol))[:12] == DIGESTS[name]
    assert {metric.partition("@")[0] for metric in protocol.compared} <= {*discover("metrics")}
    assert protocol.grade
    assert protocol.unknown


def test_a_run_cannot_follow_a_protocol_of_pictures():
    with pytest.raises(InputError, match="found vfhq-self, whose methods are given 1 picture.*--truth"):
        needed(["vfhq-self"], {})


@pytest.mark.parametrize(("held_out", "trained"), [(10, 90), (10, 89), (11, 94)])
def test_a_share_is_held_out_to_within_a_frame(held_out, trained):
    share = TaskFrames(share=0.1)
    share.check_share(held_out, trained, "clip s", "p")
    with pytest.raises(InputError, match=r"expected 10 of 100 frames.*found 12.*held_out_frames=10"):
        share.check_share(12, 88, "clip s", "p")


def test_a_run_measures_what_a_protocol_selects():
    assert needed(["cro-2026"], {}) == {
        "tasks": ("novel_view", "self_reenactment"),
        "metric_profiles": ("canonical",),
        "regions": ("face", "foreground"),
    }
    assert needed(["gaussianavatars-2024"], {"tasks": ["novel_view", "self_reenactment"]}) == {
        "metric_profiles": ("canonical", "ga-training")
    }
    both = needed(["cro-2026", "gaussianavatars-2024"], {})
    assert both["metric_profiles"] == ("canonical", "ga-training")
    assert both["regions"] == ("face", "foreground")
    with pytest.raises(InputError, match="regions: expected foreground, by protocol cro-2026, found hair"):
        needed(["cro-2026"], {"regions": ["hair"]})
    with pytest.raises(InputError, match="--protocol: expected one of .*Did you mean 'suite'"):
        needed(["suit"], {})


def capture(held_out, novel=("b",)):
    """A clip that is trained at camera a; ``held_out`` are (sequence, camera) of self-reenactment."""
    splits = {
        "train": [FrameKey("s", "EMO-1", 0, "a")],
        "novel_view": [FrameKey("s", "EMO-1", 0, camera) for camera in novel],
        "self_reenactment": [FrameKey("s", sequence, 1, camera) for sequence, camera in held_out],
    }
    return SimpleNamespace(subject="s", splits=splits)


LACKS = [
    ("tensorial-2025", capture([("EMO-2", "a")]), "sequences: expected FREE in self_reenactment, .*EMO-2"),
    (
        "mogaface-2026-unseen",
        capture([("FREE", "a")]),
        "cameras: expected unseen cameras in self_ree.*, found a",
    ),
    (
        "nersemble-benchmark-nvs",
        capture([("FREE", "a")], ("a",)),
        "cameras: expected unseen cameras in novel",
    ),
    ("suite", capture([("FREE", "a")], ()), r"splits\.novel_view: expected at least one frame, by protocol"),
]


@pytest.mark.parametrize(("name", "clip", "message"), LACKS)
def test_what_a_capture_lacks_is_refused_by_name(name, clip, message):
    with pytest.raises(InputError, match=f"clip s, {message}"):
        check_capture([name], clip)
    check_capture([name], capture([("FREE", "a"), ("FREE", "b")]))


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
