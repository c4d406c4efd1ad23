"""The background of renders is compared with the capture's before they are scored."""

import cv2
import numpy as np
import pytest

from headbench.bench import cli
from headbench.bench.audit.evaluate import check_background
from headbench.bench.audit.frames import Render
from headbench.bench.errors import InputError
from headbench.bench.io.images import write_png

HEAD = (slice(2, 5), slice(2, 6))
CORNERS = [(0, 0), (0, -1), (-1, 0), (-1, -1)]
CLOTHES = (255, 90, 90)  # one channel is that of the background


def painted(colour, places=(), other=255):
    """An image of one colour, with another at some places."""
    image = np.full((6, 8, 3), colour, np.uint8)
    for place in places:
        image[place] = other
    return image


def picture(ground):
    return painted(ground, [HEAD], 90)


def mask(places, inside, outside):
    return painted(outside, places, inside)[..., 0]


OF_HEAD = mask([HEAD], 255, 0)


@pytest.fixture
def subjects():
    return ("subject1", "subject2")


@pytest.fixture
def make_capture(toy, monkeypatch):
    """Toy captures with a background, the same image in every frame, and a mask or none."""

    def make(truth, mask=None, ground=255):
        monkeypatch.setattr(toy.ToyClip, "image", lambda self, key: truth)
        monkeypatch.setattr(toy.ToyClip, "mask", lambda self, key: mask)
        monkeypatch.setattr(toy.ToyClip, "background", np.full(3, ground / 255))
        return toy.ToyClip("subject1")

    return make


@pytest.fixture
def capture(make_capture):
    """A capture of a grey head on white."""
    return make_capture(picture(255), OF_HEAD)


def is_refused(clip, renders):
    try:
        check_background(clip, renders)
    except InputError as error:
        return "--any-background" in str(error)
    return False


CASES = [("", ["--any-background"], 0), ("self_reenactment", [], 2)]  # fewer than half of all frames


@pytest.mark.parametrize(("where", "others", "code"), CASES)
def test_images_on_another_background_are_refused(run, capture, tmp_path, capsys, where, others, code):
    for path in run.glob("*/toy/seed-0/renders/*/*.png"):
        place = f"{path.parts[-6]}/{path.parent.name}/{path.name}"
        write_png(tmp_path / "images" / place, picture(0 if where in place else 255))
    out = tmp_path / "theirs"
    arguments = ["--like", str(run), "--label", "theirs", "--out", str(out), "--trust", *others]
    assert cli.main(["evaluate", str(tmp_path / "images"), *arguments]) == code
    assert (out / "rows.parquet").exists() == (code == 0)
    if code:
        message = capsys.readouterr().err
        assert all(part in message for part in ("RGB 255, 255, 255", "RGB 0, 0, 0", "--any-background"))


@pytest.mark.parametrize(
    ("ground", "truth", "mask", "image", "refused"),
    [
        (255, picture(255), OF_HEAD, picture(232), False),
        (255, picture(255), OF_HEAD, picture(230), True),
        (255, picture(255), None, picture((255, 255, 0)), True),
        (0, picture(0), OF_HEAD, picture(23), False),
        (0, picture(0), OF_HEAD, picture(25), True),
        # A white subject: the mask or the corners say what is background. One corner is poor.
        (255, painted(255), mask(CORNERS, 0, 255), painted(90, CORNERS[1:]), False),
        (255, painted(255), None, painted(90, CORNERS[1:]), False),
        (255, painted(255), mask(CORNERS, 255, 0), painted(255, CORNERS, 90), False),
        (255, painted(255), None, painted(255, CORNERS, 90), True),
        # The mask leaves out clothes, which most corners show.
        (255, painted(CLOTHES, CORNERS[:1]), mask([], 0, 0), painted(CLOTHES, CORNERS[:1]), False),
        (255, painted(CLOTHES, CORNERS[:1]), None, painted(CLOTHES, CORNERS[:1]), False),
    ],
)
def test_what_is_certainly_background_decides(make_capture, tmp_path, ground, truth, mask, image, refused):
    clip, path = make_capture(truth, mask, ground), tmp_path / "a.png"
    write_png(path, image)
    assert is_refused(clip, {key: Render(path) for key in clip.splits["novel_view"]}) == refused


@pytest.mark.parametrize(("coverage", "refused"), [(0, False), (255, True)])
def test_images_with_coverage_are_judged_on_the_background(capture, tmp_path, coverage, refused):
    """RGBA on black: where nothing covers the background, it shows."""
    path = tmp_path / "a.png"
    image = np.dstack([picture(0), np.full((6, 8), coverage, np.uint8)])
    image[HEAD][..., 3] = 255
    cv2.imwrite(str(path), image)
    assert is_refused(capture, {key: Render(path, path) for key in capture.splits["novel_view"]}) == refused


@pytest.mark.parametrize(
    ("task", "grounds", "refused"),
    [
        ("novel_view", (0, 255, 255), False),
        ("novel_view", (255, 0, 0), True),
        ("self_reenactment", (0, 255), False),
        ("novel_view", (0, None, None), True),  # none of the two frames' ground truth shows background
    ],
)
def test_more_than_half_of_the_judged_frames_decide(capture, tmp_path, monkeypatch, task, grounds, refused):
    keys = capture.splits[task]
    hidden = {key for key, ground in zip(keys, grounds) if ground is None}
    monkeypatch.setattr(
        type(capture), "image", lambda self, key: painted(90) if key in hidden else picture(255)
    )
    renders = {}
    for number, (key, ground) in enumerate(zip(keys, grounds, strict=True)):
        renders[key] = Render(tmp_path / f"{number}.png")
        write_png(renders[key].image, picture(90 if ground is None else ground))
    assert is_refused(capture, renders) == refused
