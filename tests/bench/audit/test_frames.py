"""Lists of the frames to render: images named by them are scored; what does not fit is refused."""

import csv
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.contracts import FrameKey
from headbench.bench.engine.store import RunFolder
from headbench.bench.io.images import read_png, write_png


def listed(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("renamed", [False, True])
def test_the_ground_truth_by_the_listed_names_scores_perfectly(run, toy, tmp_path, renamed):
    out, images = tmp_path / "frames", tmp_path / "images"
    assert cli.main(["frames", str(run), "--out", str(out), "--trust", "--images"]) == 0
    frames, names = listed(out / "frames.csv"), listed(out / "MAP.csv")
    assert [row["file"] for row in frames] == [row["file"] for row in names]
    clip = toy.read("subject1")
    for number, row in enumerate(names):
        key = FrameKey(row["subject"], row["sequence"], int(row["timestep"]), row["camera"])
        np.testing.assert_array_equal(read_png(out / row["file"]), clip.image(key))
        if renamed:
            row["file"] = f"mine/{number}.png"
        write_png(images / row["file"], clip.image(key))
    arguments = ["--like", str(run), "--label", "theirs", "--out", str(tmp_path / "theirs"), "--trust"]
    if renamed:
        pd.DataFrame(names).to_csv(out / "MAP.csv", index=False)
        arguments += ["--names", str(out / "MAP.csv")]
    assert cli.main(["evaluate", str(images), *arguments]) == 0
    rows = pd.read_parquet(RunFolder(tmp_path / "theirs").rows)
    assert (rows[(rows["metric"] == "ssim") & (rows["region"] == "full")]["value"] > 0.9999).all()
    psnr = rows[(rows["metric"] == "psnr") & (rows["region"] == "full")]["value"]
    assert len(psnr)
    assert (psnr >= 100).all()


def test_cameras_sizes_and_pose_files_are_the_captures(run, toy, tmp_path, monkeypatch):
    moved = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0.25], [0, 0, 1, 2], [0, 0, 0, 1]])

    def read(path):
        clip = toy.ToyClip(path)
        K = np.array([[20.0, 0, 3], [0, 10, 2], [0, 0, 1]])
        clip.cameras = {name: replace(c, K=K, world_to_camera=moved) for name, c in clip.cameras.items()}
        return clip

    def pose_files(path):
        return {t: Path(os.path.relpath(path), f"{t}.npz") for t in range(3)}

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(toy, "read", read)
    monkeypatch.setattr(toy, "pose_files", pose_files, raising=False)
    monkeypatch.setattr(toy, "READER", replace(toy.READER, pose_files="toy_plugin:pose_files"))
    assert cli.main(["frames", str(run), "--out", str(tmp_path / "frames"), "--trust"]) == 0
    data = Path(RunFolder(run).read_manifest().configuration.data)
    for row in listed(tmp_path / "frames" / "frames.csv"):
        assert (int(row["width"]), int(row["height"])) == toy.SIZE
        assert row["background"] == "#ffffff"
        pose = [[float(row[f"world_to_camera_{i}{j}"]) for j in range(4)] for i in range(3)]
        np.testing.assert_array_equal(pose, moved[:3])
        assert [float(row[name]) for name in ("fx", "fy", "cx", "cy")] == [20, 10, 3, 2]
        known = data / "subject1" / f"{row['timestep']}.npz"
        assert (
            os.path.realpath(row["pose_file"]) == str(known)
            if int(row["timestep"]) < 3
            else not row["pose_file"]
        )


def test_an_edited_list_of_names_is_kept(run, tmp_path):
    arguments = ["frames", str(run), "--out", str(tmp_path / "frames"), "--trust"]
    assert cli.main(arguments) == 0
    assert cli.main(arguments) == 0
    path = tmp_path / "frames" / "MAP.csv"
    path.write_text(path.read_text().replace("00000", "x"))
    edited = path.read_text()
    assert cli.main(arguments) == 2
    assert path.read_text() == edited


def test_a_capture_is_listed_as_its_run_is(run, tmp_path):
    assert cli.main(["frames", str(run), "--out", str(tmp_path / "a"), "--trust"]) == 0
    capture, reader = str(tmp_path / "data"), ["--reader", "toy_plugin:READER"]
    assert cli.main(["frames", capture, "--out", str(tmp_path / "b"), *reader]) == 0
    assert listed(tmp_path / "a/frames.csv") == listed(tmp_path / "b/frames.csv")
    options = ["--tasks", "novel_view", "--frames-per-task", "2"]
    assert cli.main(["frames", capture, "--out", str(tmp_path / "c"), *reader, *options]) == 0
    assert [row["task"] for row in listed(tmp_path / "c/frames.csv")] == ["novel_view"] * 2
    assert cli.main(["frames", capture, "--out", str(tmp_path / "d"), *reader, "--frames-per-task", "0"]) == 2
    for options in (["--tasks", "novel_view"], ["--frames-per-task", "2"], ["--reader", "ga"]):
        assert cli.main(["frames", str(run), "--out", str(tmp_path / "d"), "--trust", *options]) == 2
    assert not (tmp_path / "d").exists()
