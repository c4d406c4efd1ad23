"""Captures exported elsewhere: checked, listed, joined anew for the paper's split."""

import shutil

import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.layout import DECLARATION_FILE
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.nersemble.command import prepare_nersemble
from headbench.datasets.nersemble.names import UNION10_SEQUENCES, PrepareSettings, union10_held_out
from headbench.datasets.nersemble.prepare import RECORD_FILE

from ..tiny_capture import edit_json
from .recordings import SUBJECT, write_recording

SEQUENCES = {**dict.fromkeys(UNION10_SEQUENCES, 1), "FREE": 2}


@pytest.fixture(scope="session")
def pristine_download(tmp_path_factory):
    """What a download holds: a UNION10 and its sequences with FREE, and none of our own files."""
    folder = tmp_path_factory.mktemp("download")
    recording = write_recording(folder / "raw", sequences=SEQUENCES, size=(40, 40))
    out = folder / "captures"
    prepare_nersemble(recording.settings(out, sequences="paper"))
    prepare_nersemble(recording.settings(out, sequences="paper", split="union10"))
    shutil.rmtree(next(out.glob("UNION11_*")))
    for path in [*out.rglob(RECORD_FILE), *out.rglob(DECLARATION_FILE), *out.rglob("head_model.npz")]:
        path.unlink()
    return out, recording.head


@pytest.fixture
def download(pristine_download, tmp_path):
    shutil.copytree(pristine_download[0], tmp_path / "captures")
    return tmp_path / "captures"


def check(root, subjects=SUBJECT, **settings):
    return prepare_nersemble(PrepareSettings(union_root=str(root), subjects=subjects, **settings))


def test_a_whole_download_passes(download):
    findings = check(download)
    report = findings.data[SUBJECT]
    assert findings.passed, findings.text
    assert report["test"] == (union10_held_out(SUBJECT),)
    assert report["notes"] == ()
    assert (report["timesteps"], report["cameras"]) == (10, 3)
    assert report["free"].startswith(f"{SUBJECT}_FREE_")
    assert sorted(path.name for path in download.glob("UNION*")) == [report["folder"]]


def test_the_papers_split_is_joined_from_the_same_files(download, pristine_download):
    findings = check(download, rejoin=True)
    assert findings.passed, findings.text
    union = download / findings.data[SUBJECT]["rejoined"]
    clip = read_capture(union, head=pristine_download[1], cy="bottom", leaks="record")
    assert {key.sequence for key in clip.splits["self_reenactment"]} == {"FREE"}
    assert {key.sequence for key in clip.splits["train"]} == set(UNION10_SEQUENCES)
    assert {key.camera for key in clip.splits["novel_view"]} == {"222200037"}
    assert not [*union.rglob("*.png")]
    # A second check still looks at the download's own union, and a second join changes nothing.
    before = {path: path.read_bytes() for path in union.iterdir()}
    again = check(download, rejoin=True)
    assert again.data == findings.data
    assert {path: path.read_bytes() for path in union.iterdir() if path in before} == before


@pytest.mark.parametrize("named", [None, "08"], ids=["no id", "id by index"])
def test_a_held_out_camera_named_by_its_index_is_not_trained_on(named, download, pristine_download):
    """Older exports lack serials: there the frontal camera is the one of index 8."""

    def rename(document):
        for frame in document["frames"]:
            if frame["camera_id"] == "222200037":
                frame["camera_index"] = 8
            if named is None:
                del frame["camera_id"]
            else:
                frame["camera_id"] = f"{frame['camera_index']:02d}"

    for path in download.glob("*/transforms*.json"):
        edit_json(path, rename)
    findings = check(download, rejoin=True)
    assert findings.passed, findings.text
    union = download / findings.data[SUBJECT]["rejoined"]
    clip = read_capture(union, head=pristine_download[1], cy="bottom", leaks="record")
    assert {key.camera for key in clip.splits["novel_view"]} == {"08"}
    assert "08" not in {key.camera for key in clip.splits["train"]}


def test_what_is_missing_is_named(download):
    shutil.rmtree(next(download.glob(f"{SUBJECT}_FREE_*")))
    assert check(download).passed
    for settings, subject, name in (
        ({"rejoin": True}, SUBJECT, "FREE"),
        ({"subjects": "paper"}, "074", "UNION10_074"),
    ):
        findings = check(download, **settings)
        assert not findings.passed
        assert name in findings.data[subject]["fault"]
    with pytest.raises(InputError):
        check(download / "nowhere")


@pytest.mark.parametrize("damage", ["image", "json"])
def test_damage_is_found(damage, download):
    if damage == "image":
        path = next(download.glob(f"{SUBJECT}_EMO-1*/images/*.png"))
        path.write_bytes(path.read_bytes()[:-20])
    else:
        path = next(download.glob("UNION10*")) / "transforms_val.json"
        path.write_text(path.read_text()[:-20])
    findings = check(download)
    assert not findings.passed
    assert str(path.name) in findings.data[SUBJECT]["fault"]
