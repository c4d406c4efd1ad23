"""Official methods around a stand-in repository: what it is given, what is kept, what happens where it fails."""

import os
import re
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from headbench.bench.contracts import Budget, ListedFrames, SharingAvatar, no_progress
from headbench.bench.engine.guard import TrainingView
from headbench.bench.engine.stored import avatar_digest
from headbench.bench.errors import HeadbenchError, InputError, UnavailableError
from headbench.bench.io.documents import read_json
from headbench.bench.io.files import digest_file
from headbench.bench.io.images import read_png
from headbench.bench.process import ProgramError
from headbench.methods.official.ga.windows import inside
from headbench.methods.official.method import (
    RENDERING,
    RENDERING_LOG,
    TRAINING,
    TRAINING_LOG,
)
from headbench.methods.official.workplace import Workplace, check_export

from .conftest import brightness
from .repository import (
    Killed,
    StandIn,
    fit,
    kill_at,
    lip_numbers,
    make_repository,
    rendered,
    settings,
    views,
)


@pytest.fixture(scope="module")
def repository(head, tmp_path_factory):
    """The stand-in, made once."""
    folder = tmp_path_factory.mktemp("official") / "repository"
    return folder, make_repository(folder, *lip_numbers(head))


@pytest.fixture
def method(repository):
    return StandIn(settings(*repository))


@pytest.fixture(scope="module")
def trained(repository, official_clip, tmp_path_factory):
    """Folder of an avatar that tests only copy."""
    out = tmp_path_factory.mktemp("trained") / "avatar"
    fit(StandIn(settings(*repository)), official_clip, out)
    return out


@pytest.fixture
def avatar(method, trained, tmp_path):
    shutil.copytree(trained, tmp_path / "avatar")
    return method.load(tmp_path / "avatar", device="cpu")


def test_an_avatar_is_trained_kept_and_read_again(method, avatar, official_clip, tmp_path):
    assert isinstance(avatar, ListedFrames)
    assert isinstance(avatar, SharingAvatar)
    assert {path.name for path in avatar.files()} == {"point_cloud.ply", "subject.npz", "cfg_args"}
    assert [path.name for path in avatar.shared_files()] == ["head_model.npz"]
    assert not (tmp_path / "avatar" / TRAINING).exists()
    before = {path: digest_file(path) for path in avatar.files()}
    log = (tmp_path / "avatar" / TRAINING_LOG).read_bytes()
    again = fit(method, official_clip, tmp_path / "avatar")
    assert {path: digest_file(path) for path in again.files()} == before
    assert (tmp_path / "avatar" / TRAINING_LOG).read_bytes() == log  # nothing was run
    with pytest.raises(InputError, match="another run"):
        fit(method, official_clip, tmp_path / "avatar", seed=1)


def test_folders_may_be_relative(repository, official_clip, tmp_path, monkeypatch):
    monkeypatch.chdir(repository[0].parent)
    method = StandIn(settings(Path(repository[0].name), repository[1]))
    avatar = fit(method, official_clip, Path(os.path.relpath(tmp_path / "avatar")))
    asked = views(official_clip, "novel_view")
    assert dict(avatar.render_listed(asked, (1.0, 1.0, 1.0), no_progress)).keys() == asked.keys()


def test_the_record_names_commit_and_differences(repository, avatar, tmp_path):
    record = read_json(tmp_path / "avatar" / "training.json")
    assert record["official"]["commit"] == repository[1]
    assert record["official"]["changed"] == []
    assert record["leaks"] == []
    assert any("principal point" in line and "(2 of 3" in line for line in record["differences"])


def test_the_program_gets_a_small_environment(avatar, tmp_path, monkeypatch):
    log = (tmp_path / "avatar" / TRAINING_LOG).read_text()
    names = set(re.findall(r"'(\w+)'", re.search(r"environment (\[.*\])", log)[1]))
    assert "PATH" in names
    assert not {name for name in names if name.startswith(("PYTEST", "VIRTUAL", "PYTHONPATH", "OMP"))}


def test_progress_goes_from_export_to_the_last_iteration(method, official_clip, tmp_path):
    calls = []
    fit(
        method,
        official_clip,
        tmp_path / "a",
        progress=lambda done, total, note="": calls.append((done, total, note)),
    )
    frames = len(official_clip.splits["train"])
    assert [done for done, *_ in calls] == sorted(done for done, *_ in calls)
    assert {total for _, total, _ in calls} == {frames + 20}
    assert calls[0][0] == 1
    assert calls[-1][0] == frames + 20
    assert any(note.startswith("loss 0.") for *_, note in calls)


def test_every_held_out_frame_is_rendered_under_its_key(avatar, official_clip, tmp_path):
    wanted = views(official_clip, "novel_view", "self_reenactment", "train")
    found = rendered(avatar, wanted)
    trained = {key.timestep for key in official_clip.splits["train"]}
    for key, frame in found.items():
        expected = brightness(official_clip.poses[key.timestep], key.timestep in trained)
        assert np.abs(frame.rgb[0, 0, :2] * 255 - expected).max() <= 1.01
        assert np.ptp(frame.rgb, axis=(0, 1)).max() == 0
    assert not (tmp_path / "avatar" / RENDERING).exists()


def test_logs_are_no_part_of_an_avatar(avatar, official_clip, tmp_path):
    folder = tmp_path / "avatar"
    before = avatar_digest(folder)
    list(avatar.render_listed(views(official_clip, "novel_view"), (1.0, 1.0, 1.0), no_progress))
    assert {path.name for path in folder.glob("*.log")} == {TRAINING_LOG, RENDERING_LOG}
    assert avatar_digest(folder) == before
    (folder / "point_cloud.ply").write_bytes(b"another")
    assert avatar_digest(folder) != before


def test_a_list_is_on_disk_where_the_harness_groups_writes(avatar, official_clip):
    wanted = views(official_clip, "novel_view")
    assert dict(avatar.render_listed(wanted, (1.0, 1.0, 1.0), no_progress)).keys() == wanted.keys()


def test_a_frame_on_its_own_cannot_be_had(avatar, official_clip):
    ((camera, pose), *_) = views(official_clip, "novel_view").values()
    with pytest.raises(UnavailableError, match="not single frames"):
        avatar.render(camera, pose)


def test_another_background_than_trained_on_is_refused(avatar, official_clip):
    with pytest.raises(InputError, match="trained on"):
        list(avatar.render_listed(views(official_clip, "novel_view"), (0.0, 0.0, 0.0), no_progress))


def test_a_training_without_an_avatar_is_quoted_itself(method, official_clip, behave, tmp_path, monkeypatch):
    monkeypatch.setattr(
        type(method), "shrink_command", lambda *given: [sys.executable, "-c", "print('smaller')"]
    )
    behave("no ply")
    with pytest.raises(ProgramError, match="left no whole avatar") as caught:
        fit(method, official_clip, tmp_path / "avatar")
    assert "smaller" not in str(caught.value)


def test_an_interrupted_training_ends_its_processes(method, repository, official_clip, behave, tmp_path):
    behave("hang")
    with pytest.raises(Killed):
        fit(method, official_clip, tmp_path / "avatar", progress=kill_at(5, official_clip))
    pids = [int(pid) for pid in (repository[0] / "pids.txt").read_text().split()]
    until = time.monotonic() + 5
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.02)
    assert not any(map(alive, pids))
    behave("")
    calls = []
    fit(method, official_clip, tmp_path / "avatar", progress=lambda done, total, note="": calls.append(done))
    found = re.findall(r"finds (.*)", (tmp_path / "avatar" / TRAINING_LOG).read_text())
    assert found == ["[]", "[]"], "nothing of a broken training is left"
    assert min(calls) > len(official_clip.splits["train"]), "the export was kept"


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat")
    return not state.exists() or state.read_text().rpartition(")")[2].split()[0] != "Z"


def test_a_damaged_export_is_written_again(method, official_clip, behave, tmp_path):
    behave("crash")
    with pytest.raises(ProgramError):
        fit(method, official_clip, tmp_path / "avatar")
    image = next((tmp_path / "avatar" / TRAINING / "input" / "images").iterdir())
    whole = image.read_bytes()
    image.write_bytes(b"")
    behave("crash")
    with pytest.raises(ProgramError):
        fit(method, official_clip, tmp_path / "avatar")
    assert image.read_bytes() == whole


# ------------------------------------------------------------------ what the program is given


@pytest.fixture
def exported(method, official_clip, behave, tmp_path):
    """Folders of a training that failed after its export."""
    behave("crash")
    with pytest.raises(ProgramError):
        fit(method, official_clip, tmp_path / "avatar")
    return Workplace(tmp_path / "avatar" / TRAINING, method.inspect())


def test_no_pixel_of_a_held_out_frame_is_exported(exported, official_clip):
    images = [read_png(path) for path in exported.root.rglob("*.png")]
    keys = official_clip.splits["train"]
    assert len(images) == len(keys)
    shown = {inside(official_clip.cameras[k.camera]).cut(official_clip.images[k]).tobytes(): k for k in keys}
    assert {image.tobytes() for image in images} == shown.keys()
    for split in ("novel_view", "self_reenactment"):
        for key in official_clip.splits[split]:
            cut = inside(official_clip.cameras[key.camera]).cut(official_clip.images[key])
            assert cut.tobytes() not in shown
    # The data are as good as the test only if held-out frames differ from training frames, and are not read at all.
    with pytest.raises(HeadbenchError, match="not a training frame"):
        TrainingView(official_clip).image(official_clip.splits["novel_view"][0])


def test_poses_and_cameras_held_out_are_not_exported(exported, official_clip):
    parameters = list((exported.input / "flame_param").iterdir())
    assert len(parameters) == len({key.timestep for key in official_clip.splits["train"]})
    frames = read_json(exported.input / "transforms_train.json")["frames"]
    assert {frame["camera_id"] for frame in frames} == {key.camera for key in official_clip.splits["train"]}
    for split in ("val", "test"):
        assert read_json(exported.input / f"transforms_{split}.json")["frames"] == []


@pytest.mark.parametrize("case", ["held-out key", "stray image", "image gone", "key twice"])
def test_the_guard_finds_what_must_not_be_there(exported, official_clip, case):
    keys = official_clip.splits["train"]
    places = sorted(path.relative_to(exported.root).as_posix() for path in exported.root.rglob("*.png"))
    images = dict(zip(places, keys, strict=True))
    check_export(exported, images, official_clip)
    if case == "held-out key":
        images[places[0]] = official_clip.splits["novel_view"][0]
    elif case == "stray image":
        (exported.program / "test.JPG").write_bytes(b"")
    elif case == "image gone":
        (exported.root / places[0]).unlink()
    else:
        images[places[0]] = images[places[1]]
    with pytest.raises(InputError):
        check_export(exported, images, official_clip)


@pytest.mark.parametrize(
    ("budget", "found"),
    [(Budget(seconds=5.0), "only iterations"), (Budget(iterations=5, seconds=5.0), "seconds")],
)
def test_a_budget_in_seconds_is_refused(method, official_clip, tmp_path, budget, found):
    with pytest.raises(InputError, match=found):
        fit(method, official_clip, tmp_path / "avatar", budget=budget)
    assert not (tmp_path / "avatar").exists()
