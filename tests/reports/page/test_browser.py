"""The page in Chromium, opened from the disk."""

from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.engine.store import RunFolder
from headbench.reports.page import split
from headbench.reports.page.report import write_report
from headbench.reports.page.settings import PageSettings

from .test_page import HOSTILE


@pytest.fixture
def opened(new_tab, tmp_path):
    """Open the page of a run at a width; afterwards there was no message, no dialog and no request but for the file."""
    faults, requests = new_tab.faults, []

    def start(run, width=1200, scheme="light", split=False):
        out = tmp_path / "page.html"
        write_report(PageSettings((str(run),), str(out), split=split, trust=True))
        out = out / "index.html" if split else out
        tab = new_tab(width, 800, color_scheme=scheme)
        tab.on("console", lambda message: faults.append(message.text))
        tab.on("dialog", lambda dialog: faults.append(dialog.message))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(out.as_uri())
        return tab

    yield start
    beside = {url for url in requests if "/page.html/pictures/" in url and url.startswith("file:")}
    assert {Path(url).name for url in {*requests} - beside if not url.startswith("data:")} <= {
        *("page.html", "index.html")
    }


def pixels(tab, name):
    """The pixels of the canvas whose label begins so."""
    tab.wait_for_selector(f'#viewer canvas[aria-label^="{name}"]')
    return tab.evaluate(
        """name => {
            const shown = document.querySelector(`#viewer canvas[aria-label^="${name}"]`);
            const copy = Object.assign(document.createElement("canvas"), {width: shown.width, height: shown.height});
            const context = copy.getContext("2d", {willReadFrequently: true});
            context.drawImage(shown, 0, 0);
            return [...context.getImageData(0, 0, copy.width, copy.height).data];
        }""",
        name,
    )


def order(tab):
    """Methods in the first group of the table shown."""
    names = tab.locator(".part.chosen tbody").first.locator("td:first-child").all_text_contents()
    return [name.strip() for name in names]


def test_frames_follow_scrubber_keys_and_error_maps(opened, toy_run):
    tab = opened(toy_run)
    first = pixels(tab, "toy")
    label = tab.locator("#moment").text_content()
    assert tab.locator("figcaption").nth(1).text_content().startswith("toy")
    tab.keyboard.press("ArrowRight")
    tab.wait_for_function("before => document.getElementById('moment').textContent !== before", arg=label)
    tab.keyboard.press("ArrowLeft")
    tab.wait_for_function("before => document.getElementById('moment').textContent === before", arg=label)
    truth = pixels(tab, "Ground truth")
    tab.keyboard.press("e")
    errors = pixels(tab, "Error map of toy")
    colours = tab.evaluate("data.colours")
    differences = [
        sum(abs(truth[4 * i + c] - first[4 * i + c]) for c in range(3)) for i in range(len(first) // 4)
    ]
    expected = [colours[min(255, int(d * 255 / (3 * 50) + 0.5))] for d in differences]
    assert [errors[4 * i : 4 * i + 3] for i in range(len(expected))] == expected
    tab.keyboard.press("e")
    assert pixels(tab, "toy") == first
    tab.keyboard.press("+")
    assert "scale(1.5)" in tab.locator("#panels canvas").first.get_attribute("style")
    tab.keyboard.press("0")
    assert "scale(1)" in tab.locator("#panels canvas").last.get_attribute("style")
    assert "the training diverged" in tab.locator("#panels .reason").nth(2).text_content()


def test_pictures_apart_are_loaded_when_they_are_shown(opened, toy_run, tmp_path, monkeypatch):
    monkeypatch.setattr(split, "FILE_BYTES", 300)
    expected = pixels(opened(toy_run), "toy")
    (tmp_path / "page.html").unlink()
    tab = opened(toy_run, split=True)
    assert pixels(tab, "toy") == expected
    tab.keyboard.press("e")
    assert pixels(tab, "Error map of toy") != expected
    loaded, there = tab.evaluate("[files.size, data.files.length]")
    assert 0 < loaded < there


def test_the_slider_shows_one_left_and_the_other_right(opened, toy_run):
    tab = opened(toy_run)
    truth, render = pixels(tab, "Ground truth"), pixels(tab, "toy")
    tab.click("#between summary")
    tab.select_option("#right", label="toy")
    for share, expected in (("100", truth), ("0", render)):
        tab.locator("#border").fill(share)
        tab.wait_for_timeout(200)
        found = pixels(tab, "Ground truth to the left")
        row = len(found) // 6  # bytes of a line of the 8 x 6 images
        assert found[4 : row - 4] == expected[4 : row - 4]


def test_tables_sort_and_places_lead_to_frames(opened, toy_run, write_run):
    tab = opened(write_run("sorted", {"a": 30.0, "b": 32.0, "c": 31.0}))
    assert order(tab) == ["a", "b", "c"]
    head = tab.locator(".part.chosen thead tr:last-child th button").nth(1)
    for expected, way in ((["b", "c", "a"], "descending"), (["a", "c", "b"], "ascending")):
        head.click()
        assert order(tab) == expected
        assert tab.locator(f'.part.chosen th[aria-sort="{way}"]').count() == 1
    tab = opened(toy_run)
    tab.wait_for_selector("#worst button")
    button = tab.locator("#worst button").last
    moment = button.text_content().split("timestep ")[1].split(",")[0]
    button.click()
    tab.wait_for_function(
        "t => document.getElementById('moment').textContent.startsWith(`Timestep ${t},`)", arg=moment
    )


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (390, "dark")])
def test_hostile_names_are_text_and_nothing_scrolls_sideways(opened, write_run, width, scheme):
    run = write_run("run", {HOSTILE: 30.0, "other": 31.0})
    manifest = RunFolder(run).read_manifest()
    one = replace(manifest.protocols["novel_view"], keys=(FrameKey("a", "EMO", 0, "a"),))
    replace(manifest, protocols={**manifest.protocols, "novel_view": one}).write(RunFolder(run).manifest)
    tab = opened(run, width, scheme)
    assert order(tab) == [HOSTILE, "other"]
    assert tab.locator("#panels b").nth(1).text_content() == HOSTILE
    assert tab.locator("img").count() == 0
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
