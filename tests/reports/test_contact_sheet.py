import cv2
import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.colors import to_rgb
from PIL import Image

from headbench.bench.errors import InputError
from headbench.reports.contact_sheet import ComparedFrame, contact_sheet
from headbench.reports.drawing import BOX, SheetSection, Tile, TileRow, colour_map, write_sheet
from headbench.reports.runs import evenly_spaced


def picture(seed, height=90, width=60):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2)


def flat(level, height=40, width=30):
    return np.full((height, width, 3), level, np.uint8)


def crop(sheet, place):
    return sheet[place.top : place.top + place.height, place.left : place.left + place.width]


def draw(tmp_path, truth, renders, width=30, **options):
    """Images of a sheet of one frame: the ground truth, then render and error map of each method."""
    frame = ComparedFrame.of("Novel view", ["EMO"], truth, renders, {}, width)
    places = contact_sheet([frame], list(renders), tmp_path / "sheet.png", **options)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB"))
    return {place.column: crop(sheet, place) for place in places}


def test_rows_stand_below_each_other_and_sections_further_apart(tmp_path):
    truths, renders = [picture(i) for i in range(3)], [picture(10 + i) for i in range(3)]
    frames = [
        ComparedFrame.of(section, ["EMO"], truths[i], {"a": renders[i]}, {"a": "PSNR 1 dB"}, 100)
        for i, section in enumerate(["Novel view", "Novel view", "Self-reenactment"])
    ]
    places = contact_sheet(frames, ["a"], tmp_path / "sheet.png", title="Title")
    sheet = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB"))
    assert [(p.row, p.column) for p in places] == [(row, column) for row in range(3) for column in range(3)]
    for i in range(3):
        np.testing.assert_array_equal(crop(sheet, places[3 * i]), truths[i])
        np.testing.assert_array_equal(crop(sheet, places[3 * i + 1]), renders[i])
    tops, lefts = [p.top for p in places[::3]], [p.left for p in places[:3]]
    assert 0 < tops[1] - tops[0] < tops[2] - tops[1]
    assert 0 < lefts[2] - lefts[1] < lefts[1] - lefts[0]  # a render and its error map are closer together


@pytest.mark.parametrize(("width", "factor"), [(60, 1), (100, 1), (199, 3)])
def test_small_images_are_enlarged_by_whole_pixels(tmp_path, width, factor):
    truth, render = picture(0), picture(1)
    images = draw(tmp_path, truth, {"a": render}, width)
    for column, image in enumerate((truth, render)):
        np.testing.assert_array_equal(images[column], image.repeat(factor, axis=0).repeat(factor, axis=1))


def test_large_images_are_reduced_by_area(tmp_path):
    truth = picture(0)
    expected = truth.reshape(45, 2, 30, 2, 3).mean(axis=(1, 3))
    assert np.abs(draw(tmp_path, truth, {})[0] - expected).max() <= 0.5


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
    images = draw(tmp_path, flat(100), renders, scaled_by=scaled_by)
    for index, share in enumerate(shares):
        np.testing.assert_array_equal(images[2 + 2 * index], colour_map(np.full((40, 30), share)))


def test_errors_of_opposite_sign_do_not_cancel_in_a_reduced_map(tmp_path):
    truth = flat(100, 80, 60)
    signs = np.indices(truth.shape).sum(axis=0) % 2
    render = np.where(signs, truth + 20, truth - 20).astype(np.uint8)
    np.testing.assert_array_equal(draw(tmp_path, truth, {"a": render})[2], colour_map(np.ones((40, 30))))


def test_a_missing_render_is_a_grey_box_with_its_reason(tmp_path):
    truth = picture(0, 120, 100)
    images = draw(tmp_path, truth, {"a": truth, "b": "RuntimeError: diverged " * 40}, 100)
    assert sorted(images) == [0, 1, 2]
    sheet = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB"))
    grey = (sheet == np.round(np.array(to_rgb(BOX)) * 255)).all(axis=2)
    columns = np.flatnonzero(grey.sum(axis=0) > 20)
    assert len(columns) == 200  # in place of the render and of its error map
    box = grey[:, columns[:100]]
    box = box[box.sum(axis=1) > 15]
    assert len(box) == 120
    assert 0.5 < box.mean() < 0.99  # text on it


def test_the_same_frames_make_the_same_file(tmp_path):
    frame = ComparedFrame.of("N", ["x"], picture(0), {"a": picture(1)}, {"a": "PSNR $3.00_ dB"})
    for name in ("one.png", "two.png"):
        contact_sheet([frame], ["a"], tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_matplotlibrc_changes_no_sheet(tmp_path):
    draw(tmp_path, picture(0), {})
    first = (tmp_path / "sheet.png").read_bytes()
    with rc_context({"text.usetex": True, "font.size": 30, "figure.facecolor": "red"}):
        draw(tmp_path, picture(0), {})
    assert (tmp_path / "sheet.png").read_bytes() == first


def test_faulty_input_is_refused_and_leaves_no_file(tmp_path):
    with pytest.raises(InputError, match="at least one frame"):
        contact_sheet([], ["a"], tmp_path / "x.png")
    with pytest.raises(InputError, match="render of a"):
        ComparedFrame.of("N", [], picture(0), {"a": picture(0, 30, 30)}, {})
    assert list(tmp_path.iterdir()) == []


def test_marked_images_have_a_frame_outside_their_pixels(tmp_path):
    tiles = [Tile(flat(200), mark="#ff0000"), Tile(flat(255))]
    marked, plain = write_sheet(
        tmp_path / "x.png",
        [SheetSection("A", ["long head " * 20] * 2, [TileRow(["label"], tiles)])],
        title="T",
        subtitle="S " * 300,
        marks={"#ff0000": "a limit is broken"},
    )
    sheet = np.asarray(Image.open(tmp_path / "x.png"))
    assert (crop(sheet, marked) == 200).all()
    assert (crop(sheet, plain) == 255).all()
    for offset in (1, 2, 3):
        assert (sheet[marked.top - offset, marked.left : marked.left + 30] == (255, 0, 0)).all()
    assert (sheet[plain.top - 1, plain.left : plain.left + 30] < 255).all()
    assert (sheet[plain.top - 2, plain.left : plain.left + 30] == 255).all()


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
    assert evenly_spaced(items, count) == chosen
