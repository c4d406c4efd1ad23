"""The NeRSemble benchmark: its tracking against its own formula, its zip against what its documentation says."""

import json
import re
import sys
import zipfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.contracts import Frame, no_progress
from headbench.bench.engine.stored import StoredAvatar, avatar_folder
from headbench.bench.errors import InputError
from headbench.bench.io.images import write_png
from headbench.bench.specs import MethodSpec, ResolutionRule
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.nersemble.benchmark import submission
from headbench.datasets.nersemble.benchmark.command import submission_write
from headbench.datasets.nersemble.benchmark.render import read_sequence
from headbench.datasets.nersemble.benchmark.submission import (
    MONO,
    NVS,
    after_encoding,
    check_submission,
    decibels,
    tracking_file,
)

from ..head.toy import toy_head
from ..tiny_capture import edit_json
from .benchmark_folder import SCALE, tracking, write_benchmark
from .recordings import write_video


@pytest.fixture(scope="module")
def head():
    return toy_head(16)


@pytest.fixture
def benchmark(head, tmp_path):
    return write_benchmark(tmp_path / "benchmark", head)


@pytest.mark.parametrize("shape", [None, np.linspace(-2, 2, 6)], ids=["of the file", "of an avatar"])
def test_tracking_gives_the_benchmarks_meshes_and_pictures(head, benchmark, shape):
    """Its own formula: FLAME without rotation and translation, then scale, rotation, translation."""
    sequence = read_sequence(benchmark, MONO, "393", "FREE", head, shape)
    arrays = dict(np.load(tracking_file(benchmark, "393", "FREE")))
    own = sequence.shape if shape is None else shape
    subject = PosedSubject(head, own, np.zeros_like(head.template))
    zero = np.zeros(3)
    still = subject.meshes([replace(pose, rotation=zero, translation=zero) for pose in sequence.poses])
    turned = np.einsum("tij,tvj->tvi", arrays["rotation_matrices"], still)
    world = SCALE * turned + arrays["translation"][:, None]
    ours = subject.meshes(sequence.poses)
    np.testing.assert_allclose(SCALE * ours, world, atol=1e-5)
    calibration = json.loads(
        (benchmark / MONO.name / "393" / "calibration" / "camera_params.json").read_text()
    )
    for serial, camera in sequence.cameras.items():
        W, K = (np.array(calibration[name][serial]) for name in ("world_2_cam", "intrinsics"))
        theirs = (world[0] @ W[:3, :3].T + W[:3, 3]) @ K.T
        own = (ours[0] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]) @ camera.K.T
        assert (own[:, 2] > 0).all()
        np.testing.assert_allclose(own[:, :2] / own[:, 2:], theirs[:, :2] / theirs[:, 2:], atol=1e-2)
    assert {(camera.width, camera.height) for camera in sequence.cameras.values()} == {(512, 512)}


BAD_TRACKING = {
    "expression": {"expression": np.zeros((2, 99), np.float32)},
    "scale": {"scale": np.zeros((1, 1), np.float32)},
    "jaw": {"jaw": np.zeros((3, 3), np.float32)},
    "eyes": {"eyes": np.full((2, 6), np.nan, np.float32)},
}


@pytest.mark.parametrize("key", BAD_TRACKING)
def test_tracking_that_does_not_fit_is_refused(head, benchmark, key):
    path = tracking_file(benchmark, "393", "FREE")
    np.savez(path, **(tracking(head, 2) | BAD_TRACKING[key]))
    with pytest.raises(InputError, match=key):
        read_sequence(benchmark, MONO, "393", "FREE", head)


def test_matrices_that_differ_from_the_angles_are_not_used(head, benchmark, caplog):
    """As the benchmark's own reader does; a warning names them."""
    path = tracking_file(benchmark, "393", "FREE")
    before = read_sequence(benchmark, MONO, "393", "FREE", head)
    assert not caplog.messages
    arrays = dict(np.load(path))
    np.savez(path, **(arrays | {"rotation_matrices": np.eye(3, dtype=np.float32)[[[0, 1, 2], [1, 0, 2]]]}))
    after = read_sequence(benchmark, MONO, "393", "FREE", head)
    np.testing.assert_array_equal(
        [pose.rotation for pose in after.poses], [pose.rotation for pose in before.poses]
    )
    (message,) = caplog.messages
    assert f"{path}, rotation_matrices: entries differ by up to 1" in message


def test_missing_cameras_and_version_1_are_refused(head, benchmark):
    cameras = benchmark / MONO.name / "393" / "calibration" / "camera_params.json"
    edit_json(cameras, lambda document: document["world_2_cam"].pop("220700191"))
    path = tracking_file(benchmark, "393", "FREE")
    for message in ("220700191", "version 1"):
        with pytest.raises(InputError, match=message):
            read_sequence(benchmark, MONO, "393", "FREE", head)
        if path.exists():
            path.rename(path.with_name("flame2023_tracking.npz"))


def test_files_are_those_of_the_documentation():
    nvs, mono = ([video.name for video in track.videos()] for track in (NVS, MONO))
    assert (len(set(nvs)), len(set(mono))) == (15, 80)
    assert "388/GLASSES/cam_222200037.mp4" in nvs
    assert "475/HAIR/cam_222200046.mp4" in nvs
    assert "393/EMO-1-shout+laugh/cam_220700191.mp4" in mono
    assert "486/SEN-10-port_strong_smokey/cam_222200037.mp4" in mono
    assert sum(video.frames or 0 for video in NVS.videos()) == 3 * 3516


SIZE, FRAMES = (32, 48), 3


@pytest.fixture
def track(monkeypatch):
    """The monocular track with one participant, two sequences of three small frames, two cameras."""
    small = replace(
        MONO,
        size=SIZE,
        sequences={"393": {"FREE": None, "EMO-1-shout+laugh": None}},
        serials=MONO.serials[:2],
        totals={"393": 2 * FRAMES},
    )
    monkeypatch.setattr(submission, "TRACKS", {MONO.name: small})
    return small


@pytest.fixture
def frames(track, tmp_path):
    folder = tmp_path / "frames"
    for video in track.videos():
        for timestep in range(FRAMES):
            image = np.full((SIZE[1], SIZE[0], 3), 60 + 20 * timestep, np.uint8)
            write_png(folder / "393" / f"{video.sequence}_{timestep:05d}_{video.serial}.png", image)
    return folder


def written(frames, out, **others):
    return submission_write(str(frames), str(out), MONO.name, **others)


def test_what_is_written_passes_the_check(track, frames, ffmpeg, tmp_path, capsys):
    """Of a folder, and the same of a run."""
    words = ffmpeg()
    out = tmp_path / "out.zip"
    findings = written(frames, out)
    for expected in ("-crf 14", "-vcodec libx264 -pix_fmt yuv420p", "-r 24.3"):
        assert expected in words.read_text()
    with zipfile.ZipFile(out) as archive:
        assert set(archive.namelist()) == {video.name for video in track.videos()}
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
    assert min(video["psnr"] for video in findings.data["videos"]) > 30
    assert cli.main(["submission", "check", str(out)]) == 0
    assert "Nothing that the server would refuse" in capsys.readouterr().out
    target = tmp_path / "run/393/ours/seed-0/renders/self_reenactment"
    target.parent.mkdir(parents=True)
    (frames / "393").rename(target)
    written(tmp_path / "run", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == out.read_bytes()


def removed(pattern):
    return lambda home: [path.unlink() for path in home.glob(pattern)]


LARGER = np.zeros((50, 32, 3), np.uint8)
RENDERS = "seed-0/renders/novel_view"
DAMAGE = {
    "none for 1": removed("FREE_*_222200046.png"),
    "none of timestep 1": removed("FREE_00001_222200046.png"),
    "6 frames": removed("FREE_00002_*.png"),
    "2, 3": removed("FREE_00002_222200046.png"),
    "32x50": lambda home: write_png(home / "FREE_00001_222200046.png", LARGER),
    "--method": lambda home: [(home / name / RENDERS).mkdir(parents=True) for name in ("ga", "ours")],
}


@pytest.mark.parametrize("says", DAMAGE)
def test_frames_that_would_be_refused_are_not_encoded(frames, ffmpeg, tmp_path, says):
    words = ffmpeg()
    DAMAGE[says](frames / "393")
    with pytest.raises(InputError, match=says):
        written(frames, tmp_path / "out.zip")
    assert not words.exists()
    assert not (tmp_path / "out.zip").exists()


def test_without_the_encoder_it_says_where_to_get_it(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    words = ["submission", "write", str(frames), str(tmp_path / "out.zip"), "--track", MONO.name]
    assert cli.main(words) == 3
    assert "apt-get install ffmpeg" in capsys.readouterr().out
    assert not (tmp_path / "out.zip").exists()


FIRST = "393/FREE/cam_222200037.mp4"
WRONG = {
    FIRST: lambda files, make: files.pop(FIRST),
    "no video": lambda files, make: files.update({FIRST: b"junk"}),
    "no video|decoded": lambda files, make: files.update({FIRST: make()[:-900]}),
    "48x32": lambda files, make: files.update({FIRST: make((48, 32))}),
    "every camera": lambda files, make: files.update({FIRST: make(count=2)}),
    "6 frames": lambda files, make: files.update(dict.fromkeys(files, make(count=2))),
}


@pytest.mark.parametrize("says", ["", *WRONG])
def test_what_the_server_would_refuse_is_named(track, tmp_path, says):
    def make(size=SIZE, count=FRAMES):
        path = tmp_path / f"{size[0]}-{count}.mp4"
        write_video(path, [np.full((size[1], size[0], 3), 80, np.uint8)] * count, MONO.fps)
        return path.read_bytes()

    files = {video.name: make() for video in track.videos()}
    files["README.txt"] = b"of mine"
    if says:
        WRONG[says](files, make)
    with zipfile.ZipFile(tmp_path / "s.zip", "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    _, issues = check_submission(tmp_path / "s.zip", None, "", no_progress)
    assert any(line.startswith("README.txt") for line in issues.noted)
    assert len(issues.refused) == bool(says)
    assert re.search(says, "".join(issues.refused)), issues.refused


def test_the_cost_of_the_codec_is_that_of_unrelated_errors():
    error = 255**2 / 10**3  # 30 dB
    assert decibels(error) == pytest.approx(30)
    assert after_encoding(30.0, error) == pytest.approx(30 - 10 * np.log10(2))
    assert after_encoding(30.0, 0.0) == pytest.approx(30)
    rng = np.random.default_rng(0)
    truth = rng.uniform(60, 190, (200, 200))
    render, codec = rng.normal(0, 8, truth.shape), rng.normal(0, 3, truth.shape)
    before, after = (decibels(float(np.mean(e**2))) for e in (render, render + codec))
    assert after_encoding(before, float(np.mean(codec**2))) == pytest.approx(after, abs=0.02)


def test_an_avatar_renders_all_test_frames(benchmark, head, tmp_path, monkeypatch, capsys):
    """Frames that the writer takes, of the size and names of the track; the pose tells them apart, and is for the avatar's shape."""
    from headbench.datasets.nersemble.benchmark import render as module

    places = []

    def shown(camera, pose, background):
        places.append(pose.translation)
        level = 0.5 + 0.2 * np.tanh(5 * pose.rotation[0])
        return Frame(np.full((camera.height, camera.width, 3), level, np.float32), np.ones((512, 512)))

    avatar = SimpleNamespace(render=shown)
    spec = MethodSpec("shown", "shown", "")
    method = SimpleNamespace(spec=spec, create=lambda: SimpleNamespace(load=lambda path, device: avatar))
    record = {"subject": "393", "shape": [0.0], "head_model": "another", "head_digest": ""}
    monkeypatch.setattr(
        module, "open_avatar", lambda folder, _: StoredAvatar(avatar_folder(folder), record, method)
    )
    (tmp_path / "avatar").mkdir()
    words = ["submission", "render", str(tmp_path / "avatar"), "--data", str(benchmark)]
    words += ["--participant", "393", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2  # no files
    save_head(tmp_path / "avatar" / "head_model.npz", head)
    assert cli.main(words) == 0
    files = sorted((tmp_path / "out" / "393").iterdir())
    assert len(files) == 2 * 4 * 4
    assert files[0].name == "EMO-1-shout+laugh_00000_220700191.png"
    assert len({path.read_bytes() for path in files}) > 4
    assert "another shape" not in capsys.readouterr().err
    record |= {"subject": "074", "head_model": head.version, "shape": [9.0] * 6}
    before, places[:] = np.array(places), []
    assert cli.main(words) == 0
    assert "shows 074, with another shape than 393" in capsys.readouterr().err
    last = [*MONO.sequences["393"]][-1]
    for shape, found in ((None, before), (np.full(6, 9.0), places)):
        (*_, pose) = read_sequence(benchmark, MONO, "393", last, head, shape).poses
        np.testing.assert_array_equal(found[-1], pose.translation)
    assert cli.main([*words[:5], "--participant", "074", "--out", str(tmp_path / "o")]) == 2
    method.spec = replace(spec, resolution=ResolutionRule(size=(1024, 1024)))
    assert cli.main([*words[:-1], str(tmp_path / "larger")]) == 2
    assert not (tmp_path / "larger").exists()
