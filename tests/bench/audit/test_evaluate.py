"""Folders of images by key: scored as a run scores its own, in every layout; what is wrong is said before work."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.audit.evaluate import EvaluateSettings, evaluate_folder
from headbench.bench.audit.frames import Render, check_truth, composited
from headbench.bench.contracts import FrameKey
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.images import read_png, write_png
from headbench.bench.rows import ALL, COLUMNS


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
    evaluate_folder(EvaluateSettings(str(folder), out=str(out), like=str(run), label=label, trust=True))
    rows = pd.read_parquet(RunFolder(out).rows)
    return rows[rows["metric"] == "psnr"].reset_index(drop=True)


def test_images_of_a_run_score_alike_in_every_layout(run, renders, images, tmp_path):
    """Among them that of a run's cell; under their own label."""
    theirs = scored(images, run, tmp_path / "out")
    rows = pd.read_parquet(RunFolder(run).rows)
    own = rows[rows["metric"] == "psnr"].reset_index(drop=True)
    assert set(theirs["method"]) == {"theirs"}
    same = [column for column in COLUMNS if column not in ("method", "version")]
    assert theirs[same].equals(own[same])
    for number, layout in enumerate((".", "renders", "subject1")):
        other = tmp_path / f"other-{number}"
        shutil.copytree(renders, other / layout, dirs_exist_ok=True)
        assert scored(other, run, tmp_path / f"out-{number}").equals(theirs)


def test_the_rows_stand_in_one_table_with_the_runs_and_verify(run, images, tmp_path):
    from headbench.reports.runs import RunSet

    before = scored(images, run, tmp_path / "before")
    for path in images.iterdir():
        write_png(path, read_png(path) + 9)
    after = scored(images, run, tmp_path / "out")
    assert (after["value"] < before["value"]).all()
    assert set(after["version"]) != set(before["version"])
    with pytest.raises(InputError, match="methods.theirs.version: .*choose another --out"):
        scored(images, run, tmp_path / "before")
    together = RunSet.read([run, tmp_path / "out"])
    assert together.methods == ("toy", "theirs")
    what = {"metric": "psnr", "task": ALL, "region": "full", "seeds": ALL}
    means = [together.rows.select(method=name, **what)["value"].mean() for name in ("toy", "theirs")]
    assert means[1] < means[0]
    assert cli.main(["verify", str(tmp_path / "out"), "--trust"]) == 0
    frame = next((tmp_path / "out").glob("subject1/theirs/seed-0/renders/novel_view/*.png"))
    write_png(frame, read_png(frame) + 1)
    assert cli.main(["verify", str(tmp_path / "out"), "--trust"]) == 1


def test_less_than_was_scored_is_refused(images, tmp_path):
    given = {"clip": str(tmp_path / "data"), "label": "theirs", "reader": "toy_plugin:READER"}
    settings = EvaluateSettings(
        str(images), out=str(tmp_path / "out"), **given, metrics=("psnr", "toy_plugin:ERROR")
    )
    evaluate_folder(settings)
    with pytest.raises(InputError, match="configuration.metrics: "):
        evaluate_folder(replace(settings, metrics=("psnr",)))


def test_missing_images_are_counted_before_anything_is_written(run, images, tmp_path):
    for path in sorted(images.iterdir())[:2]:
        path.unlink()
    with pytest.raises(
        InputError, match=r"an image for each of 5 frames, found 2 without.*expected as subject1/"
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


def test_labels_and_folders_that_are_taken_are_refused(run, images, tmp_path):
    with pytest.raises(InputError, match="ga-official"):
        scored(images, run, tmp_path / "out", label="ga")
    with pytest.raises(
        InputError, match="configuration.methods: expected toy_plugin:METHOD, as in this run, found theirs"
    ):
        scored(images, run, run)
    scored(images, run, tmp_path / "out")
    with pytest.raises(
        InputError, match="configuration.methods: expected theirs, as in this run, found others"
    ):
        scored(images, run, tmp_path / "out", label="others")


def options(folder, run, out, **others):
    given = {"like": str(run), "label": "theirs", "trust": True, **others}
    return EvaluateSettings(str(folder), out=str(out), **given)


@pytest.fixture
def model(toy, images, tmp_path):
    """The images as GaussianAvatars' render.py leaves them in the folder of a model, and what it saw as their truth."""
    clip, root = toy.read(tmp_path / "subject1"), tmp_path / "model"
    for split, frames in toy.listed("").items():
        for index, (timestep, camera) in enumerate(frames):
            sequence = "EMO" if timestep < 3 else "FREE"
            source = images / f"{sequence}_{timestep:05d}_{camera}.png"
            made = root / split / "ours_600"
            pixels = read_png(source) if source.exists() else np.zeros((6, 8, 3), np.uint8)
            write_png(made / "renders" / f"{index:05d}.png", pixels)
            truth = clip.image(FrameKey("subject1", sequence, timestep, camera))
            write_png(made / "gt" / f"{index:05d}.png", truth)
        (root / split / "ours_30" / "renders").mkdir(parents=True)  # of an earlier iteration, empty
    return root


def test_renders_numbered_by_gaussianavatars_get_their_keys(run, images, model, tmp_path):
    evaluate_folder(options(model, run, tmp_path / "out", names="ga-official"))
    for path in (tmp_path / "out").glob("subject1/theirs/seed-0/renders/*/*.png"):
        np.testing.assert_array_equal(read_png(path), read_png(images / path.name))
    assert scored(images, run, tmp_path / "named").equals(
        pd.read_parquet(RunFolder(tmp_path / "out").rows).query("metric == 'psnr'").reset_index(drop=True)
    )


def another_order(model):
    gt = model / "val/ours_600/gt"
    write_png(gt / "00000.png", read_png(gt / "00001.png"))


TOO_FEW = "3 images, .*transforms_test.json, found 2"
MISFITS = [
    (lambda m: (m / "test/ours_600/renders/00002.png").unlink(), "ga-official", TOO_FEW),
    (lambda m: (m / "val/ours_600/renders/00001.png").rename(m / "val/ours_600/renders/00003.png"),
     "ga-official", "found 3, 00000.png to 00003.png"),
    (another_order, "ga-official", "gt/00000.png: expected the ground truth of .* found .*another order"),
    (lambda m: shutil.rmtree(m / "test"), "ga-official", "names none for the first.*--tasks"),
    (lambda m: None, "gbs-official", "a capture of one camera.*MAP.csv"),
    (lambda m: None, "none.csv", "no such file"),
]  # fmt: skip


@pytest.mark.parametrize(("damage", "names", "match"), MISFITS)
def test_official_renders_that_do_not_fit_are_refused(run, model, tmp_path, damage, names, match):
    damage(model)
    with pytest.raises(InputError, match=match):
        evaluate_folder(options(model, run, tmp_path / "out", names=names))
    assert not (tmp_path / "out").exists()


HEADER = "file,sequence,timestep,camera\n"


def test_a_list_in_csv_names_images(run, images, tmp_path):
    lines = [HEADER]
    for number, path in enumerate(sorted(images.iterdir())):
        sequence, timestep, camera = path.stem.split("_")
        path.rename(images / f"{number}.png")
        lines.append(f"{number}.png,{sequence},{int(timestep)},{camera}\n")
    (tmp_path / "map.csv").write_text("".join(lines))
    evaluate_folder(options(images, run, tmp_path / "out", names=str(tmp_path / "map.csv")))
    assert cli.main(["verify", str(tmp_path / "out"), "--trust"]) == 0


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (HEADER + "../a.png,EMO,0,a\n", "line 2, file"),
        (HEADER + "a.png,EMO,-1,a\n", "line 2, timestep"),
        (HEADER + "a.png,EMO,77,a\n", "a frame of the capture"),
        (HEADER + "a.png,EMO,0,b\nb.png,EMO,0,b\n", "each frame once"),
        (HEADER + "a.png,EMO,0,b\n", "5 without.*expected as .*a.png"),
        ("\xff", "line 1"),
    ],
)
def test_lists_in_csv_that_do_not_fit_are_refused(run, images, tmp_path, text, match):
    (tmp_path / "map.csv").write_text(text)
    with pytest.raises(InputError, match=match):
        evaluate_folder(options(images, run, tmp_path / "out", names=str(tmp_path / "map.csv")))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("masked", [True, False])
def test_ground_truth_of_renders_on_black_is_compared_there(tmp_path, masked):
    """rgb * coverage lies beside the renders; the clip has the same on white."""
    keys = [FrameKey("s", "video", timestep, "0") for timestep in range(2)]
    colours = np.random.default_rng(0).integers(0, 256, (2, 8, 6, 3))
    mask = np.tile(np.array([0, 64, 128, 191, 255, 255], np.uint8), (8, 1))
    part = mask[..., None] / 255
    on_white = np.rint(colours * part + 255 * (1 - part)).astype(np.uint8)
    clip = SimpleNamespace(
        background=np.ones(3),
        image=lambda key: on_white[key.timestep],
        mask=lambda key: mask if masked else None,
    )
    paths = [tmp_path / f"gt_{number:05d}.png" for number in range(2)]
    for path, own in zip(paths, colours):
        write_png(path, np.rint(own * part).astype(np.uint8))
    own = {key: Render(tmp_path / "a.png", tmp_path / "b.png", path) for key, path in zip(keys, paths)}
    check_truth(clip, own, keys)
    swapped = {keys[0]: own[keys[1]], keys[1]: own[keys[0]]}
    with pytest.raises(InputError, match="renders of another capture") if masked else nullcontext():
        check_truth(clip, swapped, keys)


def test_renders_on_black_are_put_on_the_background(tmp_path):
    """Their coverage, 0.8, is the fourth channel, or the red one of another image."""
    background, expected = (
        (1.0, 0.5, 0.0),
        np.full((2, 3, 3), (151, 76, 0)).tolist(),
    )  # 100 + 51, 50 + 25.5 to even, 0
    path, image, mask = (tmp_path / f"{name}.png" for name in ("rgba", "rgb", "mask"))
    cv2.imwrite(str(path), np.full((2, 3, 4), (0, 50, 100, 204), np.uint8))  # blue, green, red, coverage
    write_png(image, np.full((2, 3, 3), (100, 50, 0), np.uint8))
    write_png(mask, np.full((2, 3, 3), (204, 0, 0), np.uint8))
    for render in (Render(path, path), Render(image, mask)):
        assert composited(render, background).tolist() == expected
    with pytest.raises(InputError, match="RGBA"):
        composited(Render(image, image), background)


AVATAR = {"avatar": True, "method": "toy_plugin:METHOD"}


def test_a_stored_avatar_scores_as_in_its_run(run, cell, images, tmp_path):
    """Its frames and, of what is measured of it as a whole, what the run asks for, under the name of its method."""
    out = str(tmp_path / "out")
    words = ["evaluate", "--avatar", str(cell.folder), "--method", AVATAR["method"], "--out", out, "--trust"]
    assert cli.main([*words, "--like", str(run), "--clip", str(tmp_path / "data")]) == 0
    rows = pd.read_parquet(RunFolder(tmp_path / "out").rows)
    own = pd.read_parquet(RunFolder(run).rows)
    same = [column for column in COLUMNS if column != "version"]
    assert rows[same].equals(own[same])
    evaluate_folder(options(cell.avatar, run, out, **AVATAR | {"label": ""}))  # kept, as a run keeps it
    assert cli.main(["verify", out, "--trust"]) == 0


def test_the_speed_of_a_stored_avatar_is_measured_without_frames(run, cell, tmp_path):
    given = {"clip": str(tmp_path / "data"), "reader": "toy_plugin:READER", "metrics": ("toy_plugin:CLOCK",)}
    evaluate_folder(EvaluateSettings(str(cell.folder), out=str(tmp_path / "out"), **given, **AVATAR))
    (row,) = pd.read_parquet(RunFolder(tmp_path / "out").rows).itertuples()
    assert (row.method, row.metric, row.status) == ("toy", "clock", "ok")


def test_an_avatar_of_another_subject_is_refused(run, cell, toy, tmp_path, monkeypatch):
    stored = tmp_path / "stored"
    shutil.copytree(cell.avatar, stored)
    record = json.loads((stored / "avatar.json").read_text())
    record |= {"subject": "subject7", "head_model": "toy", "shape": [0.5, 0.5]}
    (stored / "avatar.json").write_text(json.dumps(record))
    monkeypatch.setattr(toy.ToyClip, "head", SimpleNamespace(version="toy"))
    with pytest.raises(InputError, match="found one of subject7"):
        evaluate_folder(options(stored, run, tmp_path / "out", **AVATAR))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("folder", "others", "match"),
    [
        ("seed-0", {"avatar": True}, "toy"),  # a method of the run that is not registered
        ("elsewhere", {"avatar": True}, "method: expected a method that is registered here, found 'toy'"),
        ("seed-0", {"avatar": True, "method": "gaa"}, "Did you mean"),
        ("nowhere", AVATAR, "no such folder"),
        ("empty", AVATAR, "one without files"),
    ],
)
def test_what_is_no_avatar_of_a_known_method_is_refused(run, cell, tmp_path, folder, others, match):
    shutil.copytree(cell.avatar, tmp_path / "elsewhere")
    (tmp_path / "empty").mkdir()
    place = cell.folder if folder == "seed-0" else tmp_path / folder
    with pytest.raises(InputError, match=match):
        evaluate_folder(options(place, run, tmp_path / "out", **others))
    assert not (tmp_path / "out").exists()
