"""The benchmark's training data as captures: the poses, cameras and images are those of the benchmark's own formulas."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.loaders import load_head
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.nersemble.benchmark import prepare, render, submission
from headbench.datasets.nersemble.benchmark.command import BenchmarkPrepareSettings, prepare_benchmark
from headbench.datasets.nersemble.benchmark.prepare import plan_participant
from headbench.datasets.nersemble.benchmark.submission import MONO, NVS, tracking_file
from headbench.datasets.nersemble.recording import participant

from ..head.flame_files import write_flame
from ..head.flame_stand_in import stand_in, write_stand_in
from ..head.toy import toy_head
from ..tiny_capture import silhouette
from .benchmark_folder import SCALE, TRAINING, shaded, tracking, write_benchmark, write_training
from .recordings import write_video

SERIAL = MONO.serials[0]
OTHERS = ["222200038", "222200040"]


@pytest.fixture(scope="module")
def head():
    return toy_head(16)


@pytest.fixture(scope="module")
def pristine(head, tmp_path_factory):
    root = tmp_path_factory.mktemp("benchmark")
    write_benchmark(root, head)
    calibration = root / MONO.name / "393/calibration/camera_params.json"
    value = json.loads(calibration.read_text())
    for serial, matrix in zip(OTHERS, [*value["world_2_cam"].values()][1:]):
        value["world_2_cam"][serial], value["intrinsics"][serial] = matrix, value["intrinsics"][SERIAL]
    nvs = root / NVS.name / "393/calibration"
    nvs.mkdir(parents=True)
    (nvs / "camera_params.json").write_text(json.dumps(value))
    colours = write_training(root, head, (MONO, [SERIAL]), (NVS, OTHERS))
    save_head(root / "head.npz", head)
    return root, colours


def settings(root, out, **changes):
    return BenchmarkPrepareSettings(
        **{"data": str(root), "head": str(root / "head.npz"), "out": str(out)} | changes
    )


def test_a_monocular_capture_is_the_benchmarks(head, pristine, tmp_path):
    """Projected vertices by the benchmark's formula; images as they are, on white; every training frame."""
    root, colours = pristine
    words = ["prepare", "benchmark", str(root), "--head", str(root / "head.npz"), "--out", str(tmp_path)]
    assert [cli.main([*words, "--test", "EXP-1"]) for _ in ("first", "continued")] == [0, 0]
    clip = read_capture(tmp_path / f"UNION2_393_{MONO.name}")
    counts = [len(clip.splits[name]) for name in ("train", "novel_view", "self_reenactment")]
    assert counts == [3, 0, 4]
    value = json.loads((root / MONO.name / "393/calibration/camera_params.json").read_text())
    W, K = (np.array(value[name][SERIAL]) for name in ("world_2_cam", "intrinsics"))
    subject = PosedSubject(clip.head, clip.shape, clip.static_offset)
    camera = clip.cameras[SERIAL]
    for key in (*clip.splits["train"], *clip.splits["self_reenactment"]):
        number = key.timestep - (3 if key in clip.splits["self_reenactment"] else 0)
        sequence = next(name for name in TRAINING if name.startswith(key.sequence))
        arrays, pose = dict(np.load(tracking_file(root, "393", sequence))), clip.poses[key.timestep]
        zero = np.zeros(3)
        still, posed = subject.meshes([replace(pose, rotation=zero, translation=zero), pose])
        world = SCALE * still @ arrays["rotation_matrices"][number].T + arrays["translation"][number]
        theirs = (world @ W[:3, :3].T + W[:3, 3]) @ K.T
        own = (posed @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]) @ camera.K.T
        np.testing.assert_allclose(own[:, :2] / own[:, 2:], theirs[:, :2] / theirs[:, 2:], atol=2e-2)
        image, mask = clip.image(key), clip.mask(key)
        difference = np.abs(image - shaded(colours[sequence][number], *MONO.size))[mask > 240]
        assert np.median(difference) < 6  # of the codec
        assert image[mask == 0].min() == 255
        covered = silhouette(posed[: len(head.template)], head.faces, camera)  # without teeth
        assert np.mean((mask > 127) != covered) < 0.002


def test_novel_views_are_prepared_without_tracking(pristine, tmp_path):
    """All cameras that have videos, the mean head where their axes meet, every second frame."""
    root, _ = pristine
    text = prepare_benchmark(settings(root, tmp_path / "out", track=NVS.name, every=2)).text
    assert "headbench track" in text
    clip = read_capture(tmp_path / "out" / f"UNION2_393_{NVS.name}")
    assert len(clip.splits["train"]) == len(OTHERS) * (2 + 2)
    assert [*clip.cameras] == OTHERS
    assert {camera.width for camera in clip.cameras.values()} == {1100}
    centre = clip.poses[0].translation
    for camera in clip.cameras.values():
        seen = camera.world_to_camera[:3, :3] @ centre + camera.world_to_camera[:3, 3]
        np.testing.assert_allclose(seen[:2], 0, atol=1e-5)


def of_another(home, head):
    path = home / "sequences/EXP-1-head/tracking/flame2023_tracking_v2.npz"
    np.savez(path, **tracking(head, 4, person=1))


def no_videos(home, head):
    (home / "sequences/HAIR").mkdir()


def on_grey(home, head):
    path = home / f"sequences/EXP-1-head/images/cam_{SERIAL}.mp4"
    write_video(path, [np.full((512, 512, 3), 90, np.uint8)] * 4, 24.3)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (None, ""),
        (
            of_another,
            r"^393: the tracking of EXP-1-head has another shape of the head than that of EMO-2\S+, by up to [1-9]",
        ),
        (no_videos, "^393: no videos of HAIR, which are left out"),
        (on_grey, rf"EXP-1-head/images/cam_{SERIAL}.mp4, frame 0: expected white .*RGB (8[5-9]|9[0-5]), "),
    ],
)
def test_what_is_doubtful_has_a_warning(head, pristine, tmp_path, caplog, change, says):
    root = shutil.copytree(pristine[0], tmp_path / "benchmark")
    if change:
        change(root / MONO.name / "393", head)
    plan = plan_participant(root, MONO, participant(root / MONO.name, "393"), head, tmp_path / "out")
    shapes = [job.tracked.constant["shape"] for job in plan.jobs]
    np.testing.assert_array_equal(*shapes)
    assert len(caplog.messages) == bool(says)
    assert re.search(says, "".join(caplog.messages))


def no_masks(home, head):
    shutil.rmtree(home / "sequences/EXP-1-head/alpha_maps")


def longer(home, head):
    path = home / "sequences/EXP-1-head/tracking/flame2023_tracking_v2.npz"
    np.savez(path, **tracking(head, 9))


def old(home, head):
    path = home / "sequences/EXP-1-head/tracking/flame2023_tracking_v2.npz"
    path.rename(path.with_name("flame2023_tracking.npz"))


def smaller(home, head):
    for kind in ("images", "alpha_maps"):
        path = home / f"sequences/EXP-1-head/{kind}/cam_{SERIAL}.mp4"
        write_video(path, [np.zeros((64, 64, 3), np.uint8)] * 4, 24.3)


@pytest.mark.parametrize(
    ("damage", "changes", "says"),
    [
        (no_masks, {}, "alpha maps"),
        (longer, {}, "4 rows.*9"),
        (old, {}, "version 1"),
        (smaller, {}, "512x512 pixels.*64x64"),
        (None, {"test": ("EXP-1", "EMO-2")}, "train on"),
        (None, {"test": ("FREE",)}, "--test.*FREE"),
        (None, {"track": NVS.name, "data": "nowhere"}, "nowhere.nvs.*Name the folder that holds nvs/"),
        (None, {"participants": "404"}, "404"),
        (None, {"every": 0}, "--every"),
    ],
)
def test_data_that_cannot_be_prepared_are_refused(head, pristine, tmp_path, damage, changes, says):
    root, out = tmp_path / "benchmark", tmp_path / "out"
    shutil.copytree(pristine[0], root)
    if damage:
        damage(root / MONO.name / "393", head)
    with pytest.raises(InputError) as error:
        prepare_benchmark(settings(root, out, **changes))
    assert re.search(says, str(error.value), re.DOTALL)
    assert not [*out.glob("*/images")]


PAGE = Path(__file__).parents[3] / "docs" / "howto" / "nersemble-benchmark.md"
SMALL = replace(
    MONO,
    size=(96, 96),
    sequences={"393": {"FREE": None, "EMO-1-shout+laugh": None}},
    serials=MONO.serials[:2],
    totals={"393": 2 * 2},
)
"""The monocular track with one participant, two sequences of two small frames, two cameras."""


@pytest.mark.commands
def test_the_loop_of_the_page_ends_in_a_submission(tmp_path, monkeypatch, ffmpeg, capsys):
    """The commands as the page prints them, with two training sequences, a small preset and a stand-in for FLAME."""
    for module in (submission, render, prepare):
        monkeypatch.setattr(module, "MONO", SMALL)
    monkeypatch.setattr(submission, "TRACKS", {SMALL.name: SMALL})
    monkeypatch.chdir(tmp_path)
    write_stand_in(tmp_path, with_eyelids=False)
    flame = stand_in("flame2023")
    write_flame(
        tmp_path / "flame2023.pkl", replace(flame, expression_basis=flame.expression_basis[:, :, ::-1])
    )
    head = load_head("flame2023.pkl")
    write_training(write_benchmark(tmp_path / "BENCHMARK", head, SMALL), head, (SMALL, [SERIAL]))
    ffmpeg()
    block = re.search(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL)[1]
    download, *lines = block.replace("UNION18", f"UNION{len(TRAINING)}").replace("fast", "smoke").splitlines()
    assert download.startswith("pip install nersemble_benchmark")
    for line in lines:
        program, *words = shlex.split(line, comments=True)
        assert (program, cli.main(words)) == ("headbench", 0), line
    found = capsys.readouterr()
    assert not re.search("expected white|another shape|rotation_matrices|failed", found.err)
    assert found.out.endswith("Nothing that the server would refuse.\n")
