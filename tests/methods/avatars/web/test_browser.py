"""Pages with avatars in Chromium, opened from the disk: what WebGL draws is what headbench's renderer draws."""

import cv2
import numpy as np
import pytest

from headbench.methods.avatars.views import direction_of, orbit_camera
from headbench.methods.avatars.web.export import draw
from headbench.methods.avatars.web.payload import decode, encode

SIDE = 200


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


def pixels(tab, values, azimuth=0.0):
    """(SIDE, SIDE, 3) of the canvas with sliders at values, in [0, 1]."""
    shown = tab.evaluate(
        """([values, azimuth, side]) => {
            const {state, show} = window.avatar, canvas = document.getElementById("view");
            Object.assign(canvas.style, {width: side + "px", height: side + "px"});
            state.exact = true; state.values = values; state.camera.azimuth = azimuth; show();
            const copy = Object.assign(document.createElement("canvas"), {width: side, height: side});
            const context = copy.getContext("2d", {willReadFrequently: true});
            context.drawImage(canvas, 0, 0);
            return [...context.getImageData(0, 0, side, side).data];
        }""",
        [list(map(float, values)), azimuth, SIDE],
    )
    return np.array(shown).reshape(SIDE, SIDE, 4)[..., :3] / 255


def test_webgl_draws_what_the_renderer_draws(exported, opened):
    tab = opened(exported.page)
    page, view = decode(encode(exported.baked, exported.view)), exported.view
    for azimuth, moved in (
        (0.0, {}),
        (0.5, {"neck turn": 0.3, "jaw open": 0.3, "expression 1": 0.1, "eyes sideways": 0.2}),
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
    assert tab.get_by_role("heading").text_content() == "<script>x</script>"


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


def test_a_damaged_file_says_so(run, exported, opened, tmp_path):
    text = exported.page.read_text()
    start = text.index("octet-stream") + 400
    (tmp_path / "page.html").write_text(text[:start] + "AAAA" + text[start + 4 :])
    tab = opened(tmp_path / "page.html", expected="Cannot be shown")
    tab.get_by_text("Cannot be shown").wait_for()
