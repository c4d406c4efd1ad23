"""The benchmark's training data as captures: the poses, cameras and images are those of the benchmark's own formulas."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.errors import InputError
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import save_head
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.nersemble.benchmark.command import BenchmarkPrepareSettings, prepare_benchmark
from headbench.datasets.nersemble.benchmark.submission import MONO, NVS, tracking_file

from ..head.toy import toy_head
from .benchmark_folder import SCALE, TRAINING, tracking, write_benchmark, write_training
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
    colours = write_training(root, head, {MONO.name: [SERIAL], NVS.name: OTHERS})
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
    assert cli.main([*words, "--test", "EXP-1"]) == 0
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
        assert np.abs(image[200, 200] - colours[sequence][number].astype(float)).max() < 6  # of the codec
        assert image[20, 20].min() > 250
        assert (mask[200, 200] > 240, mask[20, 20]) == (True, 0)


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
        (None, {"test": ("FREE",)}, "FREE"),
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
