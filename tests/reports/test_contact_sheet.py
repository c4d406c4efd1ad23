import cv2
import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from headbench.bench.errors import InputError
from headbench.bench.io import figures
from headbench.bench.io.images import read_png
from headbench.bench.protocol import evenly
from headbench.reports.contact_sheet import ComparedFrame, contact_sheet
from headbench.reports.drawing import BOX, SheetSection, Tile, TileRow, colour_map, cost_axis, write_sheet


@pytest.mark.parametrize(
    ("costs", "whole", "logarithmic", "expected"),
    [
        ([1, 4, 16], True, True, [1, 2, 5, 10]),
        ([4.9, 30.0, 117.0], False, True, [5, 10, 20, 50, 100]),
        ([100.0, 600.0], False, True, [100, 200, 500]),
        ([3, 6], True, True, [3, 4, 5, 6]),
        ([0.0, 1.0, 2.0], False, False, [0, 0.5, 1, 1.5, 2]),
    ],
)
def test_numbers_of_an_axis_are_few_and_in_view(costs, whole, logarithmic, expected):
    axes = Figure().subplots()
    axes.plot(costs, costs)
    cost_axis(axes, logarithmic=logarithmic, whole=whole)
    low, high = axes.get_xlim()
    assert [tick for tick in axes.get_xticks() if low <= tick <= high] == pytest.approx(expected)


def picture(seed, height=90, width=60):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2)


def flat(level, height=40, width=30):
    return np.full((height, width, 3), level, np.uint8)


def found(sheet, image):
    """(left, top) of an image on a sheet; it has to lie there pixel for pixel."""
    differences = cv2.matchTemplate(sheet, np.asarray(image, np.uint8), cv2.TM_SQDIFF)
    left, top = cv2.minMaxLoc(differences)[2]
    np.testing.assert_array_equal(sheet[top : top + image.shape[0], left : left + image.shape[1]], image)
    return left, top


def draw(tmp_path, target, renders, width=30, **options):
    """A sheet of one frame: the ground truth, then render and error map of each method."""
    frame = ComparedFrame.of("Novel view", ["EMO"], target, renders, {}, width)
    contact_sheet([frame], list(renders), tmp_path / "sheet.png", **options)
    return read_png(tmp_path / "sheet.png")


def error_map(share):
    return colour_map(np.full((40, 30), share))


def test_rows_stand_below_each_other_and_sections_further_apart(tmp_path):
    targets, renders = [picture(i) for i in range(3)], [picture(10 + i) for i in range(3)]
    frames = [
        ComparedFrame.of(section, ["EMO"], targets[i], {"a": renders[i]}, {"a": "PSNR 1 dB"}, 100)
        for i, section in enumerate(["Novel view", "Novel view", "Self-reenactment"])
    ]
    contact_sheet(frames, ["a"], tmp_path / "sheet.png", title="Title")
    sheet = read_png(tmp_path / "sheet.png")
    places, others = ([found(sheet, image) for image in images] for images in (targets, renders))
    lefts, tops = zip(*places)
    assert [top for _, top in others] == list(tops)
    assert len(set(lefts)) == len({left for left, _ in others}) == 1
    assert 0 < tops[1] - tops[0] < tops[2] - tops[1]
    assert others[0][0] - lefts[0] > 60


@pytest.mark.parametrize(("width", "factor"), [(60, 1), (100, 1), (199, 3)])
def test_small_images_are_enlarged_by_whole_pixels(tmp_path, width, factor):
    target, render = picture(0), picture(1)
    sheet = draw(tmp_path, target, {"a": render}, width)
    for image in (target, render):
        found(sheet, image.repeat(factor, axis=0).repeat(factor, axis=1))


def test_large_images_are_reduced_by_area():
    target = picture(0)
    expected = target.reshape(45, 2, 30, 2, 3).mean(axis=(1, 3))
    frame = ComparedFrame.of("N", [], target, {}, {}, 30)
    assert np.abs(frame.ground_truth - expected).max() <= 0.5


@pytest.mark.parametrize(
    ("errors", "scaled_by", "shares"),
    [
        ({"a": 10, "b": 5}, (), (1.0, 0.5)),
        ({"a": 10, "trivial": 150}, ("a",), (1.0, 1.0)),
        ({"a": 0}, (), (0.0,)),
    ],
)
def test_error_maps_share_one_scale_in_levels(tmp_path, errors, scaled_by, shares):
    renders = {method: flat(100 + error) for method, error in errors.items()}
    sheet = draw(tmp_path, flat(100), renders, scaled_by=scaled_by)
    for share in shares:
        found(sheet, error_map(share))


def test_errors_of_opposite_sign_do_not_cancel_in_a_reduced_map(tmp_path):
    target = flat(100, 80, 60)
    signs = np.indices(target.shape).sum(axis=0) % 2
    render = np.where(signs, target + 20, target - 20).astype(np.uint8)
    found(draw(tmp_path, target, {"a": render}), error_map(1.0))


def test_a_missing_render_is_a_grey_box_with_its_reason(tmp_path):
    target = picture(0, 120, 100)
    sheet = draw(tmp_path, target, {"a": target, "b": "RuntimeError: diverged " * 40}, 100)
    grey = (sheet == np.round(np.array(to_rgb(BOX)) * 255)).all(axis=2)
    columns = np.flatnonzero(grey.sum(axis=0) > 20)
    assert len(columns) == 200  # in place of the render and of its error map
    box = grey[:, columns[:100]]
    box = box[box.sum(axis=1) > 15]
    assert len(box) == 120
    assert 0.5 < box.mean() < 0.99  # text on it


def test_the_same_frames_make_the_same_file_with_any_rc_file(tmp_path):
    frame = ComparedFrame.of("N", ["x"], picture(0), {"a": picture(1)}, {"a": "PSNR $3.00_ dB"})
    contact_sheet([frame], ["a"], tmp_path / "one.png")
    with rc_context({"text.usetex": True, "font.size": 30, "figure.facecolor": "red"}):
        contact_sheet([frame], ["a"], tmp_path / "two.png")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_render_of_another_size_is_refused():
    with pytest.raises(InputError, match="render of a"):
        ComparedFrame.of("N", [], picture(0), {"a": picture(0, 30, 30)}, {})


def test_marked_images_have_a_frame_outside_their_pixels(tmp_path):
    images = flat(200), picture(3)
    tiles = [Tile(images[0], mark="#ff0000"), Tile(images[1])]
    heads = ["long head " * 20] * 2
    section = SheetSection("A", heads, [TileRow(["label"], tiles)])
    marks = {"#ff0000": "a limit is exceeded"}
    write_sheet(tmp_path / "x.png", [section], title="T", subtitle="S " * 300, marks=marks)
    sheet = read_png(tmp_path / "x.png")
    (left, top), (plain_left, plain_top) = (found(sheet, image) for image in images)
    for offset in (1, 2, 3):
        assert (sheet[top - offset, left : left + 30] == (255, 0, 0)).all()
    assert (sheet[plain_top - 1, plain_left : plain_left + 60] < 255).all()
    assert (sheet[plain_top - 2, plain_left : plain_left + 60] == 255).all()


def test_a_sheet_longer_than_matplotlib_draws_becomes_smaller(tmp_path, monkeypatch):
    whole = draw(tmp_path, picture(0), {"a": "failed"}, 60)
    monkeypatch.setattr(figures, "LONGEST", 400)
    small = draw(tmp_path, picture(0), {"a": "failed"}, 60)
    assert max(small.shape) in (399, 400)
    assert small.shape[0] == pytest.approx(whole.shape[0] * 400 / max(whole.shape), abs=1)


def test_the_colour_map_grows_brighter_steadily():
    colours = colour_map(np.linspace(0, 1, 64)[None])
    lightness = cv2.cvtColor(colours.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0, :, 0]
    steps = np.diff(lightness)
    assert (steps > 0).all()
    assert steps.max() < 2 * steps.mean()  # perceptually uniform
    np.testing.assert_array_equal(colour_map(np.array([[-1.0, 2.0]]))[0], colours[0, [0, -1]])


@pytest.mark.parametrize(
    ("items", "count", "chosen"),
    [(range(10), 2, [2, 7]), (range(9), 3, [1, 4, 7]), ("ab", 5, ["a", "b"]), ([], 3, [])],
)
def test_frames_are_spread_evenly(items, count, chosen):
    assert evenly(items, count) == chosen
