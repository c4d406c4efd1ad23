"""The whole way from raw recordings to captures: what comes out, resuming, refusing, full disks."""

import errno
import tracemalloc
from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.files import write_json
from headbench.bench.io.lock import locked
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import read_head, save_head
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.nersemble import prepare, sequence
from headbench.datasets.nersemble import prepare as image_pool
from headbench.datasets.nersemble.command import prepare_nersemble
from headbench.datasets.nersemble.prepare import RECORD_FILE
from headbench.datasets.nersemble.recording import COLOUR_FILE, read_calibration

from ..tiny_capture import edit_json, edit_npz
from .recordings import HEIGHT, SEQUENCES, SUBJECT, WIDTH, colour_of, tone, world_cameras, write_recording


@pytest.mark.parametrize("name", ["paper", "ablation"])
def test_missing_subjects_are_named_with_those_there_are(name, pristine_recording, tmp_path):
    with pytest.raises(InputError) as error:
        prepare_nersemble(pristine_recording.settings(tmp_path / "out", subjects=name))
    assert error.value.key == "--subjects"
    assert error.value.found == SUBJECT
    assert f"--subjects {SUBJECT}" in error.value.remedy
    assert ('defaults to "paper"' in error.value.remedy) == (name == "paper")


@pytest.mark.parametrize(
    ("name", "expected"), [("flame2020", "flame2020.pkl"), ("", "flame2023.pkl"), ("own", "")]
)
def test_the_way_to_use_a_capture_names_its_head_model(pristine_recording, tmp_path, name, expected):
    head = str(pristine_recording.head) if name == "own" else ""
    changes = {"head": head, "head_model": "" if head else name}
    findings = prepare_nersemble(pristine_recording.settings(tmp_path / "out", **changes))
    assert f"--head {expected or head} --out" in findings.text


IMAGES = 3 * sum(SEQUENCES.values())


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder by its name."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def prepared(recording, out, **changes):
    findings = prepare_nersemble(recording.settings(out, **changes))
    return findings.data[SUBJECT], findings


def error_of_a_full_disk(module, function, fails, *preparation) -> InputError:
    """Prepare with no room for the files that ``fails`` says."""
    original = getattr(module, function)

    def write(path, *content):
        if fails(path):
            raise OSError(errno.ENOSPC, "No space left on device")
        original(path, *content)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, function, write)
        with pytest.raises(InputError, match="No space left") as error:
            prepared(*preparation)
    return error.value


@pytest.fixture(scope="session")
def whole(pristine_recording, tmp_path_factory):
    """A prepared capture that tests only read: folder and findings."""
    out, calls = tmp_path_factory.mktemp("whole"), []
    findings = prepare_nersemble(pristine_recording.settings(out), lambda *call: calls.append(call))
    assert [(done, total) for done, total, _ in calls] == [(n, IMAGES) for n in range(1, IMAGES + 1)]
    assert {note for _, _, note in calls} == {f"{SUBJECT} {name}" for name in SEQUENCES}
    return out, findings


@pytest.fixture(scope="session")
def clip(whole):
    return read_capture(whole[1].data[SUBJECT]["union"])


def test_free_is_the_test_and_the_frontal_camera_the_novel_view(clip, whole):
    assert whole[1].passed
    assert whole[1].data[SUBJECT]["missing"] == [
        "no colour correction for EMO-1-shout+laugh, FREE: colours are as recorded."
    ]
    train, free = SEQUENCES["EMO-1-shout+laugh"], SEQUENCES["FREE"]
    counts = {name: len(keys) for name, keys in clip.splits.items()}
    assert counts == {"train": 2 * train, "novel_view": train, "self_reenactment": 3 * free}
    assert {key.sequence for key in clip.splits["self_reenactment"]} == {"FREE"}
    assert {key.camera for key in clip.splits["novel_view"]} == {"222200037"}
    assert clip.subject == SUBJECT


def test_images_are_the_frames_on_white(clip):
    for key in clip.files:
        first = 0 if key.sequence != "FREE" else SEQUENCES["EMO-1-shout+laugh"]
        colour = colour_of([*clip.cameras].index(key.camera), tone(key.sequence, key.timestep - first))
        image, mask = clip.image(key), clip.mask(key)
        assert image.shape == (HEIGHT // 2, WIDTH // 2, 3)
        assert np.abs(image[HEIGHT // 4, WIDTH // 4].astype(int) - colour).max() <= 4
        assert (image[:6] >= 250).all()
        assert mask[HEIGHT // 4, WIDTH // 4] >= 252
        assert (mask[:6] <= 5).all()


def test_cameras_and_meshes_stand_to_each_other_as_tracked(clip, pristine_recording):
    """In one world: each sequence was shifted by a mean of its own, and the reader brings them together again."""
    aligned = read_calibration(pristine_recording.calibration_file).aligned()
    subject = PosedSubject(clip.head, clip.shape, clip.static_offset)
    renamed = {"expr": "expression", "neck_pose": "neck", "jaw_pose": "jaw", "eyes_pose": "eyes"}
    first = 0
    for name, length in SEQUENCES.items():
        tracked = np.load(next(pristine_recording.tracking.rglob(f"*{name}*/**/*.npz")), allow_pickle=False)
        for local in range(length):
            pose = clip.poses[first + local]
            moved = {
                renamed.get(key, key): tracked[key][local] for key in (*renamed, "rotation", "translation")
            }
            expected, found = subject.meshes([replace(pose, **moved), pose])
            for serial, camera in clip.cameras.items():
                before, after = aligned.world_to_camera[serial], camera.world_to_camera
                np.testing.assert_allclose(
                    found @ after[:3, :3].T + after[:3, 3],
                    expected @ before[:3, :3].T + before[:3, 3],
                    atol=1e-6,
                )
        first += length


@pytest.mark.parametrize(("release", "images"), [("v1", False), ("paper2023", True)])
def test_earlier_releases_show_the_same_frames(release, images, clip, tmp_path):
    recording = write_recording(tmp_path, release=release, images=images)
    again = read_capture(prepared(recording, tmp_path / "out")[0]["union"])
    assert again.splits == clip.splits
    for key in again.files:
        shown, expected = (each.image(key)[HEIGHT // 4, WIDTH // 4].astype(int) for each in (again, clip))
        assert np.abs(shown - expected).max() <= 8


def test_a_finished_call_does_nothing(whole, pristine_recording, monkeypatch):
    out, first = whole
    before = contents(out)
    stamps = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    monkeypatch.setattr(image_pool, "read_frames", None)  # decoding would fail
    again, _ = prepared(pristine_recording, out)
    assert (again["written"], again["kept"]) == (0, IMAGES)
    assert contents(out) == before
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == stamps
    assert again["frames"] == first.data[SUBJECT]["frames"]


def test_a_broken_run_continues_and_ends_the_same(whole, pristine_recording, tmp_path):
    out, calls = tmp_path / "out", count()
    late = error_of_a_full_disk(
        image_pool, "write_image", lambda path: next(calls) >= 20, pristine_recording, out
    )
    assert late.file.endswith(".png")
    assert "start again" in str(late)
    assert not [*out.rglob("transforms*.json")], "nothing half done reads as a capture"
    there = len([*out.rglob("images/*.png")])
    again, _ = prepared(pristine_recording, out)
    assert 0 < there < IMAGES
    assert (again["written"], again["kept"]) == (IMAGES - there, there)
    assert contents(out) == contents(whole[0])


def test_broken_and_missing_images_are_made_again(whole, pristine_recording, tmp_path):
    out = tmp_path / "out"
    prepared(pristine_recording, out, workers=1)  # the same bytes come out with any number
    assert contents(out) == contents(whole[0])
    folder = next(out.glob(f"{SUBJECT}_FREE_*"))
    (folder / "images" / "00001_01.png").unlink()
    (folder / "fg_masks" / "00002_01.png").unlink()
    (folder / "images" / ".tmp-headbench-abc.png").write_bytes(b"half")  # left by a killed call
    again, _ = prepared(pristine_recording, out)
    assert again["written"] >= 1
    assert contents(out) == contents(whole[0])
    # A machine that went down can leave a name without content; without a record of completion it is noticed.
    record = folder / RECORD_FILE
    edit_json(record, lambda value: value.update(images_complete=False))
    (folder / "images" / "00003_02.png").write_bytes(b"")
    cv2.imwrite(str(folder / "images" / "00004_00.png"), np.zeros((4, 4, 3), np.uint8))
    prepared(pristine_recording, out)
    assert contents(out) == contents(whole[0])


@pytest.mark.parametrize("change", [{"downscale": 4}, {"every": 2}, {"edges": "plain"}, {"colour": "none"}])
def test_other_settings_never_mix_with_images_that_are_there(change, recording, tmp_path):
    out = tmp_path / "out"
    matrices = {camera.id: np.eye(3) * 0.9 for camera in world_cameras()}
    write_json(recording.calibration_file.with_name(COLOUR_FILE), matrices)
    for camera in world_cameras():
        recording.write_background(camera.id, np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    prepared(recording, out, tracking="")
    before = contents(out)
    if "downscale" in change:  # the folder's name tells
        assert prepared(recording, out, tracking="", **change)[0]["written"] == IMAGES
        assert before.items() <= contents(out).items()
        return
    with pytest.raises(InputError) as error:
        prepared(recording, out, tracking="", **change)
    assert error.value.file.endswith(RECORD_FILE)
    assert contents(out) == before


def test_a_folder_of_another_tool_is_left_alone(pristine_recording, whole, tmp_path):
    name = next(whole[0].glob(f"{SUBJECT}_FREE_*")).name
    image = tmp_path / "out" / name / "images" / "00000_00.png"
    image.parent.mkdir(parents=True)
    cv2.imwrite(str(image), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="unknown origin"):
        prepared(pristine_recording, tmp_path / "out")
    assert not [*(tmp_path / "out").rglob(RECORD_FILE)]


def test_without_tracking_images_come_first_and_parameters_later(whole, pristine_recording, tmp_path):
    out = tmp_path / "out"
    first, findings = prepared(pristine_recording, out, tracking="")
    assert findings.passed
    assert first["union"] is None
    assert "no tracked parameters" in first["missing"][0]
    assert len([*out.rglob("transforms_backup.json")]) == 2
    assert not [*out.rglob("transforms.json")]
    second, _ = prepared(pristine_recording, out)
    assert (second["written"], second["kept"]) == (0, IMAGES)
    assert contents(out) == contents(whole[0])
    third, _ = prepared(pristine_recording, out, tracking="")
    assert third["union"] is not None
    assert contents(out) == contents(whole[0])


def test_new_tracking_replaces_the_old_and_keeps_the_images(recording, whole, tmp_path):
    out = tmp_path / "out"
    union = prepared(recording, out)[0]["union"]
    file = next(recording.tracking.rglob("*FREE*/**/*.npz"))
    edit_npz(file, lambda arrays: arrays["translation"].__iadd__(np.array([0, 0.5, 0], np.float32)))
    # Broken off on the way: no capture of old and new.
    error_of_a_full_disk(prepare, "save_npz", lambda path: path.name == "00003.npz", recording, out)
    for folder in (union, next(out.glob(f"{SUBJECT}_FREE_*"))):
        with pytest.raises(InputError):
            read_capture(folder)
    result, _ = prepared(recording, out)
    assert result["written"] == 0
    moved, still = (read_capture(next(folder.glob("UNION*"))) for folder in (out, whole[0]))
    first = SEQUENCES["EMO-1-shout+laugh"]
    shift = moved.poses[first].translation - still.poses[first].translation
    np.testing.assert_allclose(shift, [0, 0.5, 0], atol=1e-6)
    np.testing.assert_array_equal(moved.poses[0].translation, still.poses[0].translation)


def test_other_heads_and_frames_are_refused_before_any_work(recording, tmp_path):
    with pytest.raises(InputError, match="very frames") as error:
        prepared(recording, tmp_path / "out", every=2)
    assert error.value.key == "translation"
    head = read_head(recording.head)
    save_head(recording.head, replace(head, expression_basis=head.expression_basis[..., :3]))
    with pytest.raises(InputError, match="the head model the sequence was tracked with") as error:
        prepared(recording, tmp_path / "out")
    assert error.value.key == "expr"
    assert not (tmp_path / "out").exists()


def test_flame_itself_is_never_copied(recording, tmp_path):
    save_head(recording.head, replace(read_head(recording.head), version="flame2023"))
    result, _ = prepared(recording, tmp_path / "out")
    assert not [*(tmp_path / "out").rglob("head_model.npz")]
    with pytest.raises(InputError, match="flame2023"):
        read_capture(result["union"])
    assert read_capture(result["union"], head=recording.head).head.version == "flame2023"


def test_videos_without_masks_say_so_and_write_no_masks(videos, tmp_path):
    result, _ = prepared(videos, tmp_path / "out", every=1)
    assert any("no masks" in sentence for sentence in result["missing"])
    assert not [*(tmp_path / "out").rglob("fg_masks")]
    clip = read_capture(result["union"])
    assert clip.mask(clip.splits["train"][0]) is None


def test_a_video_that_ends_early_stops_the_run(videos, tmp_path, monkeypatch):
    true_probe = sequence.probe_video

    def lying_index(path):
        count, size = true_probe(path)
        return count + 2, size

    monkeypatch.setattr(sequence, "probe_video", lying_index)
    with pytest.raises(InputError) as error:
        prepared(videos, tmp_path / "out", tracking="")
    assert error.value.key in ("frame 4", "frame 6")
    assert error.value.file.endswith(".mp4")
    assert not [*(tmp_path / "out").rglob("transforms*.json")]


def test_colours_are_corrected(recording, tmp_path):
    swap = [[0, 1.0, 0], [1.0, 0, 0], [0, 0, 1.0]]
    matrices = {camera.id: swap for camera in world_cameras()}
    write_json(recording.calibration_file.with_name(COLOUR_FILE), matrices)
    result, _ = prepared(recording, tmp_path / "out")
    assert result["missing"] == []
    clip = read_capture(result["union"])
    red, green, blue = colour_of(0, tone("EMO-1-shout+laugh", 0))
    pixel = clip.image(clip.splits["train"][0])[HEIGHT // 4, WIDTH // 4].astype(int)
    assert np.abs(pixel - [green, red, blue]).max() <= 4


def test_a_check_writes_nothing(pristine_recording, tmp_path):
    findings = prepare_nersemble(pristine_recording.settings(tmp_path / "out", check=True))
    assert findings.data["images"] == IMAGES
    assert not (tmp_path / "out").exists()


BAD_OPTIONS = [
    *(({"downscale": 0}, "--downscale"), ({"downscale": 100}, "downscale"), ({"every": -1}, "--every")),
    *(({"workers": -1}, "--workers"), ({"union_root": "x"}, "--root"), ({"root": ""}, "--root")),
    *(
        ({"sequences": "FREE"}, "sequences"),
        ({"sequences": ""}, "sequences"),
        ({"sequences": "EXP-1"}, "sequence"),
    ),
    *(({"tracking": "nowhere"}, ""), ({"cameras": "1"}, "world_2_cam")),
]


@pytest.mark.parametrize(("change", "key"), BAD_OPTIONS)
def test_bad_options_are_named(change, key, pristine_recording, tmp_path):
    with pytest.raises(InputError) as error:
        prepare_nersemble(pristine_recording.settings(tmp_path / "out", **change))
    assert error.value.key == key
    assert not (tmp_path / "out").exists()


def test_a_subject_is_prepared_by_one_process_at_a_time(whole, pristine_recording, tmp_path):
    union = tmp_path / whole[1].data[SUBJECT]["union"].name
    with locked(union, beside=True), pytest.raises(InputError, match="no other process"):
        prepared(pristine_recording, tmp_path)


def test_images_are_never_enlarged(recording, tmp_path):
    edit_json(recording.calibration_file, lambda value: value.update(height=2 * HEIGHT, width=2 * WIDTH))
    with pytest.raises(InputError) as error:
        prepared(recording, tmp_path / "out", downscale=1)
    assert error.value.key == "downscale"
    assert prepared(recording, tmp_path / "out", downscale=2)[0]["written"] == IMAGES


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length_of_a_recording(tmp_path):
    peaks = []
    for frames in (6, 60):
        sequences = {"EMO-1-shout+laugh": frames, "FREE": 2}
        recording = write_recording(
            tmp_path / str(frames), images=False, sequences=sequences, size=(800, 800)
        )
        tracemalloc.start()
        prepared(recording, tmp_path / f"out-{frames}", downscale=1, workers=2)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 10 * 800 * 800 * 3, "as much as ten of the 54 frames more"
