"""Pages with avatars in Chromium, opened from the disk: what WebGL draws is what headbench's renderer draws."""

import cv2
import numpy as np
import pytest

from headbench.methods.avatars.harmonics import direction_of, orbit_camera
from headbench.methods.avatars.web.export import decode, draw, encode

SIDE = 200
pytestmark = pytest.mark.commands


@pytest.fixture
def opened(new_tab):
    """Open a page; afterwards there was no message, and no request but for the file."""
    faults = new_tab.faults

    def start(path, expected=""):
        tab = new_tab()
        tab.on("console", lambda message: faults.append(message.text))
        tab.on("request", lambda request: request.url != path.as_uri() and faults.append(request.url))
        tab.goto(path.as_uri())
        if not expected:
            tab.get_by_text("ms of script").wait_for()
        return tab

    return start


def pixels(tab, values, azimuth=0.0, side=SIDE, sharp=True):
    """(side, side, 3) of the canvas with sliders at values, in [0, 1]; not smoothed unless ``sharp`` is False."""
    shown = tab.evaluate(
        """([values, azimuth, side, sharp]) => {
            const {state, show} = window.avatar, canvas = document.getElementById("view");
            Object.assign(canvas.style, {width: side + "px", height: side + "px"});
            state.exact = true; state.sharp = sharp; state.values = values; state.camera.azimuth = azimuth; show();
            const copy = Object.assign(document.createElement("canvas"), {width: side, height: side});
            const context = copy.getContext("2d", {willReadFrequently: true});
            context.drawImage(canvas, 0, 0);
            return [...context.getImageData(0, 0, side, side).data];
        }""",
        [list(map(float, values)), azimuth, side, sharp],
    )
    return np.array(shown).reshape(side, side, 4)[..., :3] / 255


def test_webgl_draws_what_the_renderer_draws(exported, opened):
    tab = opened(exported.page)
    page, view = decode(encode(exported.baked, exported.view)), exported.view
    for azimuth, moved in (
        (0.0, {}),
        (0.5, {page.sliders[0].name: 0.1, "neck turn": 0.3, "jaw open": 0.3, "eyes sideways": 0.2}),
    ):
        values = np.array([moved.get(slider.name, 0.0) for slider in page.sliders])
        camera = orbit_camera(direction_of(azimuth, 0.0), view["distance"], np.array(view["target"]), SIDE)
        wanted = draw(page.moved(values, camera.center), camera)
        assert wanted.std() > 0.02
        assert cv2.PSNR(pixels(tab, values, azimuth), wanted.astype(np.float64), 1.0) > 40


def test_a_slider_and_a_drag_change_what_is_seen(exported, opened):
    tab = opened(exported.page)
    before = tab.locator("#view").screenshot()
    slider = tab.get_by_label("jaw open")
    slider.focus()
    tab.keyboard.press("End")
    tab.wait_for_timeout(300)
    opened_jaw = tab.locator("#view").screenshot()
    assert opened_jaw != before
    tab.mouse.move(100, 200)
    tab.mouse.down()
    tab.mouse.move(180, 200, steps=3)
    tab.mouse.up()
    tab.wait_for_timeout(200)
    assert tab.locator("#view").screenshot() != opened_jaw
    tab.get_by_role("button", name="Reset").click()
    tab.wait_for_timeout(300)
    assert tab.locator("#view").screenshot() == before
    assert tab.get_by_role("heading", level=1).text_content() == "<script>x</script>"


@pytest.mark.parametrize("width", [640, 900, 390])
def test_sliders_and_words_are_inside_the_page(exported, opened, width):
    tab = opened(exported.page)
    tab.set_viewport_size({"width": width, "height": 620})
    ends = tab.evaluate(
        """() => [...document.querySelectorAll("aside input")].map(input => {
            const panel = input.closest("aside"), {right, left} = input.getBoundingClientRect();
            return [left, right, panel.getBoundingClientRect().left + panel.clientWidth];
        })"""
    )
    assert len(ends) > 5
    assert [(right, inner) for _, right, inner in ends if right > inner] == []
    assert min(right - left for left, right, _ in ends) > 40
    assert tab.evaluate(
        "[...document.querySelectorAll('aside, .note')].every(e => e.scrollWidth <= e.clientWidth)"
    )


def test_an_enlarged_picture_has_the_detail_of_the_training(exported, opened):
    """A picture of many pixels, reduced to those of the training, is the picture that was trained."""
    tab, trained, view = opened(exported.page), exported.more["trained"], exported.view
    side = round(2 * np.tan(np.radians(15)) * view["distance"] / trained["pixel"])
    rest = np.zeros(len(exported.baked.sliders))
    small = pixels(tab, rest, side=side, sharp=False)
    assert np.abs(small - pixels(tab, rest, side=side)).max() < 0.1  # nothing is enlarged
    reduced = {
        sharp: cv2.resize(
            pixels(tab, rest, side=4 * side, sharp=sharp), (side, side), interpolation=cv2.INTER_AREA
        )
        for sharp in (True, False)
    }
    smoothed, sharp = (cv2.PSNR(reduced[how], small, 1.0) for how in (False, True))
    assert smoothed > 30
    assert smoothed > sharp


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_background_follows_the_reader(exported, new_tab, scheme):
    tab = new_tab(color_scheme=scheme)
    tab.goto(exported.page.as_uri())
    tab.get_by_text("ms of script").wait_for()
    shot = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    corner, panel = shot[4, 4].astype(int), shot[-4, -40].astype(int)
    assert np.abs(corner - panel).max() <= 2
    assert (corner.mean() < 60) == (scheme == "dark")
    tab.get_by_label("Background").select_option("white")
    tab.wait_for_timeout(300)
    shot = cv2.imdecode(np.frombuffer(tab.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert shot[4, 4].min() == 255


def test_a_recorded_sequence_plays(exported, opened):
    tab = opened(exported.page)
    if not exported.more["sequences"]:
        assert not tab.locator("#recorded").is_visible()
        return
    tab.get_by_label("Sequence", exact=True).select_option(index=len(exported.more["sequences"]) - 1)
    tab.get_by_role("button", name="Play").click()
    seen = set()
    for _ in range(1500):  # the page's policy forbids what wait_for_function does
        tab.wait_for_timeout(20)
        seen.add(tab.evaluate("window.avatar.state.moment"))
        if len(seen) > 1:
            break
    assert len(seen) > 1
    tab.get_by_role("button", name="Pause").click()
    moment = tab.evaluate("window.avatar.state.moment")
    tab.wait_for_timeout(300)
    assert tab.evaluate("window.avatar.state.moment") == moment
    assert tab.evaluate("window.avatar.state.values.some(value => value !== 0)")


def test_a_picture_shows_its_expression_in_full(exported, opened):
    tab = opened(exported.page)
    name, high = exported.baked.sliders[0].name, exported.baked.sliders[0].high
    face = tab.get_by_role("button", name=f"{name} at its end")
    face.click()
    assert float(tab.get_by_role("slider", name=name).input_value()) == pytest.approx(high, rel=0.01)
    assert face.get_attribute("aria-pressed") == "true"
    face.press("Enter")
    assert tab.get_by_role("slider", name=name).input_value() in ("0", "0.0")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious_in_an_avatar_page(exported, new_tab, serious, scheme):
    tab = new_tab(1000, 700, color_scheme=scheme)
    tab.goto(exported.page.as_uri())
    tab.get_by_text("ms of script").wait_for()
    assert serious(tab) == []


def test_a_damaged_file_says_so(run, exported, opened, tmp_path):
    text = exported.page.read_text()
    start = text.index("octet-stream") + 400
    (tmp_path / "page.html").write_text(text[:start] + "AAAA" + text[start + 4 :])
    tab = opened(tmp_path / "page.html", expected="Cannot be shown")
    tab.get_by_text("Cannot be shown").wait_for()
