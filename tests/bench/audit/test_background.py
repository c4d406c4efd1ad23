"""The background of renders is compared with the capture's before they are scored."""

import cv2
import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.audit.background import check_background
from headbench.bench.audit.naming import Render
from headbench.bench.errors import InputError
from headbench.bench.io.images import write_png

HEAD = (slice(2, 5), slice(2, 6))


def picture(ground):
    image = np.full((6, 8, 3), ground, np.uint8)
    image[HEAD] = 90
    return image


@pytest.fixture(params=["masks", "no masks"])
def capture(request, toy, monkeypatch):
    """Toy captures of a grey head on white."""
    mask = np.zeros((6, 8), np.uint8)
    mask[HEAD] = 255
    monkeypatch.setattr(toy.ToyClip, "image", lambda self, key: picture(255))
    monkeypatch.setattr(toy.ToyClip, "mask", lambda self, key: mask if request.param == "masks" else None)
    return toy.ToyClip


@pytest.mark.parametrize(
    ("ground", "others", "code"),
    [(255, [], 0), (240, [], 0), (0, [], 2), (0, ["--any-background"], 0)],
)
def test_images_on_another_background_are_refused(run, cell, capture, tmp_path, capsys, ground, others, code):
    for path in (cell.folder / "renders").glob("*/*.png"):
        write_png(tmp_path / "images" / path.name, picture(ground))
    out = tmp_path / "theirs"
    arguments = ["--like", str(run), "--label", "theirs", "--out", str(out), "--trust", *others]
    assert cli.main(["evaluate", str(tmp_path / "images"), *arguments]) == code
    assert (out / "rows.parquet").exists() == (code == 0)
    if code:
        message = capsys.readouterr().err
        assert all(part in message for part in ("RGB 255, 255, 255", "RGB 0, 0, 0", "--any-background"))


@pytest.mark.parametrize(("coverage", "refused"), [(0, False), (255, True)])
def test_images_with_coverage_are_judged_on_the_background(capture, tmp_path, coverage, refused):
    """RGBA on black: where nothing covers the background, it shows."""
    clip, path = capture("subject1"), tmp_path / "a.png"
    image = np.dstack([picture(0), np.full((6, 8), coverage, np.uint8)])
    image[HEAD][..., 3] = 255
    cv2.imwrite(str(path), image)
    renders = {key: Render(path, path) for key in clip.splits["novel_view"]}
    if not refused:
        check_background(clip, renders)
        return
    with pytest.raises(InputError, match="--any-background"):
        check_background(clip, renders)


def test_some_poor_frames_are_accepted(capture, tmp_path):
    clip = capture("subject1")
    renders = {}
    for number, key in enumerate(clip.splits["novel_view"]):
        renders[key] = Render(tmp_path / f"{number}.png")
        write_png(renders[key].image, picture(0 if number == 0 else 255))
    check_background(clip, renders)
