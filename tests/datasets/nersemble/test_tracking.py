"""VHAP's tracked parameters: found, checked, split into an export's files."""

import shutil

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.ga.layout import DECLARATION_FILE
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.teeth import with_teeth
from headbench.datasets.nersemble.command import prepare_nersemble
from headbench.datasets.nersemble.names import UNION10_SEQUENCES, PrepareSettings, union10_held_out
from headbench.datasets.nersemble.prepare import RECORD_FILE
from headbench.datasets.nersemble.tracking import find_tracked, read_tracked

from ..head.toy import toy_head
from ..tiny_capture import edit_json
from .recordings import SUBJECT, tracked_arrays, write_recording, write_tracked

COUNT = 5


@pytest.fixture
def head():
    return toy_head(16)


def written(path, head, **changes):
    arrays = tracked_arrays(head, COUNT) | changes
    write_tracked(path, {key: value for key, value in arrays.items() if value is not None})
    return path


def test_an_export_keeps_every_vertex_but_for_one_shift(head, tmp_path):
    tracked = read_tracked(written(tmp_path / "t.npz", head), timesteps=COUNT, head=head)
    arrays = tracked_arrays(head, COUNT)
    exported = [tracked.parameters(timestep) for timestep in range(COUNT)]
    moved = np.concatenate([parameters["translation"] for parameters in exported])
    np.testing.assert_allclose(moved.mean(axis=0), 0, atol=1e-7)
    np.testing.assert_allclose(moved + tracked.shift, arrays["translation"], atol=1e-6)
    for key in ("rotation", "neck_pose", "jaw_pose", "eyes_pose", "expr"):
        stacked = np.concatenate([parameters[key] for parameters in exported])
        np.testing.assert_array_equal(stacked, arrays[key].astype(np.float32))
    assert all(value.dtype == np.float32 for value in exported[0].values())
    np.testing.assert_array_equal(exported[3]["static_offset"], arrays["static_offset"].astype(np.float32))
    assert exported[0]["shape"].shape == (head.shape_basis.shape[2],)


def test_the_canonical_file_is_zero_but_for_identity_and_jaw(head, tmp_path):
    changes = {"dynamic_offset": np.ones((COUNT, len(head.template), 3))}
    tracked = read_tracked(written(tmp_path / "t.npz", head, **changes), timesteps=COUNT)
    assert "dynamic_offset" in tracked.parameters(0)
    canonical = tracked.canonical()
    assert "dynamic_offset" not in canonical
    np.testing.assert_array_equal(canonical["jaw_pose"], [[0.3, 0, 0]])
    assert canonical["jaw_pose"].dtype == np.float64
    zero = {key for key, value in canonical.items() if not value.any()}
    assert zero == {"translation", "rotation", "neck_pose", "eyes_pose", "expr"}


def test_without_a_static_offset_zeros_are_written(head, tmp_path):
    path = written(tmp_path / "t.npz", head, static_offset=None)
    tracked = read_tracked(path, timesteps=COUNT, head=head)
    assert tracked.constant["static_offset"].shape == (1, len(with_teeth(head).template), 3)
    assert not tracked.constant["static_offset"].any()
    with pytest.raises(InputError) as error:
        read_tracked(path, timesteps=COUNT)
    assert error.value.key == "static_offset"


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"expr": None}, "expr"),
        ({"expr": np.zeros((COUNT, 100))}, "expr"),
        ({"shape": np.zeros(300)}, "shape"),
        ({"rotation": np.zeros((COUNT, 4))}, "rotation"),
        ({"eyes_pose": np.zeros((COUNT, 3))}, "eyes_pose"),
        ({"translation": np.full((COUNT, 3), np.nan)}, "translation"),
        ({"translation": np.zeros((COUNT + 1, 3))}, "translation"),
        ({"static_offset": np.zeros((1, 7, 3))}, "static_offset"),
        ({"rotation_matrices": np.zeros((COUNT, 3, 3))}, "rotation_matrices"),
    ],
)
def test_parameters_that_do_not_fit_are_named(changes, key, head, tmp_path):
    path = written(tmp_path / "t.npz", head, **changes)
    with pytest.raises(InputError) as error:
        read_tracked(path, timesteps=COUNT, head=head)
    assert (error.value.file, error.value.key) == (str(path), key)


def place(root, name):
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


def test_the_last_epoch_of_the_latest_run_is_found(tmp_path):
    folder = "901_EMO-1_v16_DS4_wBg_staticOffset"
    for run, epochs in (("2026-01-01_10-00-00", (30, 200)), ("2026-01-02_09-00-00", (9, 30))):
        for epoch in epochs:
            place(tmp_path, f"{folder}/{run}/tracked_flame_params_{epoch}.npz")
    place(tmp_path, f"{folder}/2026-01-02_09-00-00/tracked_flame_params_best.npz")
    place(tmp_path, "901_EMO-10_v16/tracked_flame_params_1.npz")
    place(tmp_path, "902_EMO-1_v16/tracked_flame_params_1.npz")
    found = find_tracked(tmp_path, "901", "EMO-1-shout+laugh")
    assert found == tmp_path / folder / "2026-01-02_09-00-00" / "tracked_flame_params_30.npz"
    assert find_tracked(tmp_path, "901", "FREE") is None
    assert find_tracked(tmp_path / "nowhere", "901", "FREE") is None


def test_two_trackings_of_one_sequence_are_an_error(tmp_path):
    place(tmp_path, "901_FREE_v16_DS4/tracked_flame_params_30.npz")
    place(tmp_path, "901_FREE_v16_DS2/tracked_flame_params_30.npz")
    with pytest.raises(InputError, match="901_FREE_v16_DS2, 901_FREE_v16_DS4"):
        find_tracked(tmp_path, "901", "FREE")


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
