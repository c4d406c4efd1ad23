"""Published protocols as data, and what a run and a capture need for them."""

from types import SimpleNamespace

import pytest
import yaml

from headbench.bench.configuration import build_file
from headbench.bench.contracts import FrameKey
from headbench.bench.errors import InputError
from headbench.bench.protocol import FOLDER, NamedProtocol, check_capture, named_protocols, needed
from headbench.bench.registry import discover


def test_every_protocol_names_its_profile_and_source():
    assert len(named_protocols()) >= 8
    for name, protocol in named_protocols().items():
        assert protocol.profile in discover("profiles"), name
        assert protocol.source
        assert protocol.title


CHANGES = [
    ({"mask": "face"}, "mask: expected one of"),
    ({"tasks": {"drive": {}}}, "tasks: novel_view or self_reenactment; found drive"),
    ({"tasks": {"novel_view": {"cameras": "new"}}}, "cameras: expected one of .*, found 'new'"),
    ({"tasks": {"novel_view": {"last": 0}}}, "last: at least 1, or null for all; found 0"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=str)
def test_a_file_with_a_wrong_key_or_value_is_refused(tmp_path, change, message):
    content = yaml.safe_load((FOLDER / "tensorial-2025.yaml").read_text())
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(content | change))
    with pytest.raises(InputError, match=message):
        build_file(NamedProtocol, tmp_path / "p.yaml")


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
