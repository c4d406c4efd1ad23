import cv2
import numpy as np
import pytest
from PIL import Image

from headbench.bench.errors import InputError
from headbench.reports.contact_sheet import Missing, SheetRow, contact_sheet
from headbench.reports.drawing import BOX, colour_map, shorten, text_width, wrap


def picture(seed, height=90, width=60):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2)


def crop(sheet, place):
    return sheet[place.top : place.top + place.height, place.left : place.left + place.width]


def draw(tmp_path, rows, methods, **options):
    places = contact_sheet(rows, methods, tmp_path / "sheet.png", **{"panel_width": 30, **options})
    sheet = np.asarray(Image.open(tmp_path / "sheet.png").convert("RGB"))
    return sheet, {(place.row, place.column): place for place in places}


def test_images_are_shown_pixel_for_pixel_where_they_fit(tmp_path):
    truths, renders = [picture(i) for i in range(3)], [picture(10 + i) for i in range(3)]
    rows = [
        SheetRow(
            section, ["EMO", f"timestep {i}"], truths[i], {"a": lambda i=i: renders[i]}, {"a": "PSNR 1 dB"}
        )
        for i, section in enumerate(["Novel view", "Novel view", "Self-reenactment"])
    ]
    sheet, places = draw(tmp_path, rows, ["a"], title="Title", panel_width=100)
    for i in range(3):
        np.testing.assert_array_equal(crop(sheet, places[i, "truth"]), truths[i])
        np.testing.assert_array_equal(crop(sheet, places[i, "render a"]), renders[i])
    tops = [places[i, "truth"].top for i in range(3)]
    assert tops == sorted(tops)
    assert tops[1] - tops[0] < tops[2] - tops[1]  # a heading between the sections
    assert len({places[i, "truth"].left for i in range(3)}) == 1


def test_small_images_are_enlarged_by_whole_pixels(tmp_path):
    truth, render = picture(0), picture(1)
    sheet, places = draw(tmp_path, [SheetRow("N", [], truth, {"a": render})], ["a"], panel_width=199)
    for name, image in (("truth", truth), ("render a", render)):
        np.testing.assert_array_equal(crop(sheet, places[0, name]), image.repeat(3, axis=0).repeat(3, axis=1))


def test_large_images_are_reduced_by_area(tmp_path):
    truth = picture(0)
    sheet, places = draw(tmp_path, [SheetRow("N", [], truth, {})], [], panel_width=30)
    expected = truth.reshape(45, 2, 30, 2, 3).mean(axis=(1, 3))
    assert np.abs(crop(sheet, places[0, "truth"]) - expected).max() <= 0.5


def test_error_maps_share_one_scale_in_levels(tmp_path):
    truth = np.full((40, 30, 3), 100, np.uint8)
    errors = {"a": 10, "b": 5}
    renders = {m: truth + np.uint8(e) for m, e in errors.items()}
    sheet, places = draw(tmp_path, [SheetRow("Novel view", [], truth, renders)], ["a", "b"])
    for method, error in errors.items():
        expected = colour_map(np.full((40, 30), error / 10))
        np.testing.assert_array_equal(crop(sheet, places[0, f"error {method}"]), expected)


def test_a_floor_can_be_kept_from_setting_the_scale(tmp_path):
    truth = np.full((40, 30, 3), 100, np.uint8)
    renders = {"a": truth + np.uint8(10), "floor": truth + np.uint8(150)}
    sheet, places = draw(tmp_path, [SheetRow("N", [], truth, renders)], ["a", "floor"], scaled_by=["a"])
    top = colour_map(np.ones((40, 30)))
    np.testing.assert_array_equal(crop(sheet, places[0, "error a"]), top)
    np.testing.assert_array_equal(crop(sheet, places[0, "error floor"]), top)


def test_errors_of_opposite_sign_do_not_cancel_in_a_reduced_map(tmp_path):
    truth = np.full((80, 60, 3), 100, np.uint8)
    signs = np.indices((80, 60, 3)).sum(axis=0) % 2
    render = np.where(signs, truth + 20, truth - 20).astype(np.uint8)
    sheet, places = draw(tmp_path, [SheetRow("N", [], truth, {"a": render})], ["a"], panel_width=30)
    place = places[0, "error a"]
    assert (place.width, place.height) == (30, 40)
    np.testing.assert_array_equal(crop(sheet, place), colour_map(np.ones((40, 30))))


def test_a_missing_render_is_a_labelled_grey_box(tmp_path):
    truth = picture(0, 120, 100)
    row = SheetRow("N", [], truth, {"a": truth, "b": Missing("RuntimeError: diverged " * 40)})
    sheet, places = draw(tmp_path, [row], ["a", "b"], panel_width=100)
    assert (0, "render b") not in places
    pitch = places[0, "error a"].left - places[0, "truth"].left
    group = places[0, "error a"].left - places[0, "render a"].left
    left = places[0, "render a"].left + pitch
    box = sheet[places[0, "truth"].top :, left : left + 100][:120]
    assert group < pitch
    grey = (box == BOX).all(axis=2)
    assert grey[[0, 0, -1, -1], [0, -1, 0, -1]].all()
    assert 0.5 < grey.mean() < 0.99  # text on it


def test_writes_the_same_file_again(tmp_path):
    row = SheetRow("N", ["x"], picture(0), {"a": picture(1)}, {"a": "PSNR 3.00 dB"})
    for name in ("one.png", "two.png"):
        contact_sheet([row], ["a"], tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_faulty_input_is_refused_and_leaves_no_file(tmp_path):
    with pytest.raises(InputError, match="at least one frame"):
        contact_sheet([], ["a"], tmp_path / "x.png")
    row = SheetRow("N", [], picture(0), {"a": picture(0, 30, 30)})
    with pytest.raises(InputError, match="render of a"):
        contact_sheet([row], ["a"], tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


def test_text_keeps_within_its_limit():
    text = "The quick brown fox jumps over an extraordinarily-long-hyphenated-compound-word today"
    for limit in (60, 100, 300):
        lines = wrap(text, 13, limit)
        assert all(text_width(line, 13) <= limit for line in lines)
    assert " ".join(wrap(text, 13, 900)) == text
    assert shorten("short", 13, 500) == "short"
    assert text_width(shorten(text, 13, 80), 13) <= 80


def test_the_colour_map_grows_brighter_steadily():
    colours = colour_map(np.linspace(0, 1, 64)[None])
    lightness = cv2.cvtColor(colours.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0, :, 0]
    steps = np.diff(lightness)
    assert (steps > 0).all()
    assert steps.max() < 2 * steps.mean()  # perceptually uniform
    np.testing.assert_array_equal(colour_map(np.array([[-1.0, 2.0]]))[0], colours[0, [0, -1]])
