"""The viewer in Chromium: what is moved is seen to move, for each browser alone."""

import re
import time

import cv2
import numpy as np
import pytest

from headbench.reports.view.scene import ViewSettings
from headbench.reports.view.server import serving

pytest.importorskip("viser", reason="viser is not installed")
pytestmark = pytest.mark.commands
CANVAS = {"x": 40, "y": 200, "width": 200, "height": 190}
"""Part of the page beside the panel and below viser's note on software WebGL."""
ALIKE = 0.5
"""Mean difference of two pictures, of 255."""


@pytest.fixture
def opened(new_tab):
    """Open the viewer in a browser of its own; nothing outside of this machine was asked for, and there was no fault."""

    def start(server):
        address = f"127.0.0.1:{server.get_port()}"
        tab = new_tab()
        tab.on(
            "request",
            lambda request: (
                None
                if address in request.url or request.url.startswith(("data:", "blob:"))
                else new_tab.faults.append(request.url)
            ),
        )
        tab.goto(server.address)
        tab.get_by_text("Drawn by trained models").wait_for()
        tab.get_by_text(re.compile(r"\d+x\d+: .*sent in")).wait_for()  # a whole frame, not a draft
        return tab

    return start


def settled(tab, wanted=lambda picture: True):
    """The pixels of the canvas as soon as three pictures of it are the same, and are the picture that is wanted.

    On a busy machine the picture from before an action may stay for longer than three pictures take.
    """
    pictures, end = [tab.screenshot(clip=CANVAS)], time.monotonic() + 60
    while len(pictures) < 3 or len({*pictures[-3:]}) > 1 or not wanted(pictures[-1]):
        assert time.monotonic() < end, "the picture that is wanted never comes to rest"
        tab.wait_for_timeout(400)
        pictures.append(tab.screenshot(clip=CANVAS))
    return pictures[-1]


def alike(picture, other):
    """Whether two pictures differ by less than the camera moves while the browser still slows its motion down."""
    one, two = (cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in (picture, other))
    return np.abs(one.astype(float) - two).mean() < ALIKE


def type_value(tab, label, value):
    """Type the value of a slider, as one would; keys on the slider itself turn the camera too."""
    labelled = f"xpath=//*[normalize-space(text())='{label}']"
    field = tab.locator(f"{labelled}/following::input[not(@type='hidden')][1]")
    field.fill(value)
    field.press("Enter")


def choose(tab, label, option):
    tab.get_by_label(label, exact=True).locator("visible=true").first.click()
    tab.get_by_role("option").filter(has_text=option).first.click()


def serve(scene):
    return serving(scene, ViewSettings(("run",), port=0, expressions=2))


def test_a_slider_moves_one_browser_alone(scene, opened):
    with serve(scene) as server:
        one, two = opened(server), opened(server)
        before = settled(one), settled(two)
        type_value(one, "Open", "0.4")
        settled(one, lambda picture: not alike(picture, before[0]))
        assert alike(settled(two), before[1])
        one.get_by_text("Reset sliders").click()
        settled(one, lambda picture: alike(picture, before[0]))


@pytest.mark.slow
def test_a_camera_shows_the_capture_beside(scene, opened):
    with serve(scene) as server:
        tab = opened(server)
        before = settled(tab)
        choose(tab, "Sequence", "held out")
        choose(tab, "Camera", min(scene.first.clip.cameras))
        settled(tab, lambda picture: picture != before)


def test_splats_are_drawn_by_the_browser(scene, opened):
    with serve(scene) as server:
        tab = opened(server)
        before = settled(tab)
        choose(tab, "Drawn as", "splats")
        tab.get_by_text("splats posed in").wait_for()
        settled(tab, lambda picture: picture != before)
        choose(tab, "Drawn as", "images")
        tab.get_by_text("sent in").wait_for()


@pytest.mark.slow
def test_what_is_saved_comes_as_files(scene, opened):
    with serve(scene) as server:
        tab = opened(server)
        for button, name, start in (
            ("Screenshot", "headbench.png", b"\x89PNG"),
            ("Turntable video", "turntable.webm", b"\x1a\x45\xdf\xa3"),
        ):
            with tab.expect_download() as download:
                tab.get_by_role("button", name=button).click()
            assert download.value.suggested_filename == name
            content = download.value.path().read_bytes()
            assert content.startswith(start)
            assert b"trainedAlgorithmicMedia" in content or b"ompositeWithTrainedAlgorithmicMedia" in content
