"""Folders of images by key: scored as a run scores its own, in every layout; what is wrong is said before work."""

import shutil

import cv2
import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.audit.command import EvaluateSettings, evaluate
from headbench.bench.errors import InputError
from headbench.bench.io.images import read_png, write_png
from headbench.bench.rows import ALL, COLUMNS
from headbench.bench.runner.store import RunFolder


@pytest.fixture
def renders(run, cell):
    """Renders of the run's one cell, by task."""
    return cell.folder / "renders"


@pytest.fixture
def images(renders, tmp_path):
    """The same images as a stranger would hand them over: in one folder, named by key."""
    folder = tmp_path / "images"
    folder.mkdir()
    for path in renders.glob("*/*.png"):
        shutil.copy(path, folder / path.name)
    return folder


def scored(folder, run, out, label="theirs"):
    evaluate(EvaluateSettings(str(folder), out=str(out), like=str(run), label=label, trust=True))
    rows = pd.read_parquet(RunFolder(out).rows)
    return rows[rows["metric"] == "psnr"].reset_index(drop=True)


def test_images_of_a_run_score_alike_under_their_own_label(run, images, tmp_path):
    theirs = scored(images, run, tmp_path / "out")
    rows = pd.read_parquet(RunFolder(run).rows)
    own = rows[rows["metric"] == "psnr"].reset_index(drop=True)
    assert set(theirs["method"]) == {"theirs"}
    same = [column for column in COLUMNS if column not in ("method", "version")]
    assert theirs[same].equals(own[same])


@pytest.mark.parametrize("layout", [".", "renders", "subject1"])
def test_every_layout_gives_the_same_rows(run, renders, images, tmp_path, layout):
    """Among them that of a run's cell."""
    shutil.copytree(renders, tmp_path / "other" / layout, dirs_exist_ok=True)
    assert scored(tmp_path / "other", run, tmp_path / "a").equals(scored(images, run, tmp_path / "b"))


def test_the_table_shown_holds_the_run_and_the_images(run, images, tmp_path):
    findings = evaluate(
        EvaluateSettings(str(images), out=str(tmp_path / "out"), like=str(run), label="theirs", trust=True)
    )
    lines = [line for line in findings.text.splitlines() if line.startswith(("| toy", "| theirs"))]
    assert len(lines) == 2
    shown = [[cell.strip(" *") for cell in line.split("|")[2:4]] for line in lines]
    assert shown[0] == shown[1]  # the same images have the same numbers


def test_the_rows_stand_in_one_table_with_the_runs_and_verify(run, images, tmp_path):
    from headbench.reports.runs import RunSet

    worse = tmp_path / "worse"
    shutil.copytree(images, worse)
    for path in worse.iterdir():
        write_png(path, read_png(path) + 9)
    scored(worse, run, tmp_path / "out")
    together = RunSet.read([run, tmp_path / "out"])
    assert together.methods == ("toy", "theirs")
    what = {"metric": "psnr", "task": ALL, "region": "full", "seeds": ALL}
    means = [together.rows.select(method=name, **what)["value"].mean() for name in ("toy", "theirs")]
    assert means[1] < means[0]
    assert cli.main(["verify", str(tmp_path / "out"), "--trust"]) == 0
    frame = next((tmp_path / "out").glob("subject1/theirs/seed-0/renders/novel_view/*.png"))
    write_png(frame, read_png(frame) + 1)
    assert cli.main(["verify", str(tmp_path / "out"), "--trust"]) == 1


def test_changed_images_are_scored_again_in_the_same_folder(run, images, tmp_path):
    before = scored(images, run, tmp_path / "out")
    for path in images.iterdir():
        write_png(path, read_png(path) + 9)
    after = scored(images, run, tmp_path / "out")
    assert (after["value"] < before["value"]).all()
    assert set(after["version"]) != set(before["version"])


def test_missing_images_are_counted_before_anything_is_written(run, images, tmp_path):
    gone = sorted(images.iterdir())[:2]
    for path in gone:
        path.unlink()
    with pytest.raises(
        InputError, match=r"an image for each of 5 frames, found 2 without.*looked for as subject1/"
    ):
        scored(images, run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def encoded(shape, suffix=".png"):
    return cv2.imencode(suffix, np.zeros(shape, np.uint8))[1].tobytes()


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (encoded((7, 8, 3)), "8 x 6 pixels, as the ground truth, found 8 x 7"),
        (encoded((6, 8, 4)), "Composite it on the background"),
        (encoded((6, 8)), "8-bit RGB"),
        (encoded((6, 8, 3), ".jpg"), "lossless"),
        (b"no image", "PNG or JPEG"),
    ],
)
def test_images_that_would_mislead_are_refused_by_name(run, images, tmp_path, content, match):
    path = sorted(images.iterdir())[3]
    path.write_bytes(content)
    with pytest.raises(InputError, match=match) as refused:
        scored(images, run, tmp_path / "out")
    assert path.name in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_a_registered_name_is_no_label(run, images, tmp_path):
    with pytest.raises(InputError, match="ga-official"):
        scored(images, run, tmp_path / "out", label="ga")


def test_the_runs_own_folder_is_no_place_to_write(run, images):
    with pytest.raises(InputError, match="a folder of its own"):
        scored(images, run, run)


def test_what_to_score_against_has_to_be_said(images, tmp_path):
    with pytest.raises(ValueError, match="--clip"):
        EvaluateSettings(str(images), out=str(tmp_path / "out"))
