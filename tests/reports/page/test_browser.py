"""The page in Chromium, opened from the disk."""

from dataclasses import replace

import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.engine.store import RunFolder
from headbench.reports.page import sections
from headbench.reports.page.report import PageSettings, write_report

from .test_page import HOSTILE

pytestmark = pytest.mark.commands


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The page of a run, by the names of both; written once."""
    folder, pages = tmp_path_factory.mktemp("pages"), {}

    def written(run, split):
        name = f"{run.name}-apart" if split else f"{run.name}.html"
        if name not in pages:
            write_report(PageSettings((str(run),), str(folder / name), split=split, trust=True))
            pages[name] = folder / name / "index.html" if split else folder / name
        return pages[name]

    return written


@pytest.fixture
def opened(new_tab, written):
    """Open the page of a run at a width; afterwards there was no message, no dialog and no request but for the file."""
    faults, requests, own = new_tab.faults, [], []

    def start(run, width=1200, scheme="light", split=False, address="", **options):
        out = written(run, split)
        own.append(out.as_uri().removesuffix("index.html"))
        tab = new_tab(width, 800, color_scheme=scheme, **options)
        tab.on("console", lambda message: faults.append(message.text))
        tab.on("dialog", lambda dialog: faults.append(dialog.message))
        tab.on("request", lambda request: requests.append(request.url))
        tab.goto(out.as_uri() + address)
        return tab

    yield start
    assert [url for url in requests if not url.startswith(("data:", *own))] == []


def pixels(tab, name):
    """The pixels of the canvas whose label begins so."""
    tab.wait_for_selector(f'#tiles canvas[aria-label^="{name}"]')
    return tab.evaluate(
        """name => {
            const shown = document.querySelector(`#tiles canvas[aria-label^="${name}"]`);
            const copy = Object.assign(document.createElement("canvas"), {width: shown.width, height: shown.height});
            const context = copy.getContext("2d", {willReadFrequently: true});
            context.drawImage(shown, 0, 0);
            return [...context.getImageData(0, 0, copy.width, copy.height).data];
        }""",
        name,
    )


def order(tab):
    """Methods in the first group of the table shown."""
    names = tab.locator("article.table.chosen tbody").first.locator("th.name").all_text_contents()
    return [name.strip() for name in names]


def changed(tab, element, before):
    """Wait until the text of an element is another, and return it."""
    tab.wait_for_function(
        "([id, text]) => document.getElementById(id).textContent !== text", arg=[element, before]
    )
    return tab.locator(f"#{element}").text_content()


def test_frames_follow_keys_and_error_maps(opened, toy_run):
    tab = opened(toy_run)
    first = pixels(tab, "toy")
    label = tab.locator("#where").text_content()
    tab.keyboard.press("ArrowRight")
    changed(tab, "where", label)
    tab.keyboard.press("ArrowLeft")
    tab.wait_for_function("before => document.getElementById('where').textContent === before", arg=label)
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
    assert "scale(1.5)" in tab.locator("#tiles canvas").first.get_attribute("style")
    assert "scale(1.5)" in tab.locator("#tiles canvas").last.get_attribute("style")
    tab.keyboard.press("0")
    assert "scale" not in tab.locator("#tiles canvas").last.get_attribute("style")
    tab.click("#chip-1")
    tab.wait_for_function("document.querySelectorAll('#tiles figure').length === 3")
    assert "the training diverged" in tab.locator("#tiles .reason").nth(2).text_content()


def test_the_held_key_t_shows_the_truth_everywhere(opened, toy_run):
    tab = opened(toy_run)
    truth, render = pixels(tab, "Ground truth"), pixels(tab, "toy")
    assert truth != render
    tab.keyboard.down("t")
    tab.wait_for_function(
        "[...document.querySelectorAll('#tiles canvas')].every(c => c.ariaLabel.startsWith('Ground truth'))"
    )
    canvases = tab.locator("#tiles canvas")
    assert canvases.nth(1).evaluate("c => c.toDataURL()") == canvases.nth(0).evaluate("c => c.toDataURL()")
    tab.keyboard.up("t")
    assert pixels(tab, "toy") == render


def test_the_wheel_zooms_focused_pictures_only(opened, toy_run):
    tab = opened(toy_run)
    pixels(tab, "toy")
    box = tab.locator("#tiles .view").first.bounding_box()
    tab.mouse.move(box["x"] + 20, box["y"] + 20)
    tab.mouse.wheel(0, -300)
    tab.wait_for_timeout(200)
    assert tab.evaluate("state.zoom") == 1
    tab.mouse.click(box["x"] + 20, box["y"] + 20)
    tab.mouse.wheel(0, -300)
    tab.wait_for_function("state.zoom > 1")
    styles = tab.locator("#tiles canvas").evaluate_all("list => list.map(c => c.style.transform)")
    assert len(set(styles)) == 1
    cursors = tab.locator("#tiles .cursor").evaluate_all(
        "list => list.map(c => c.style.left + c.style.visibility)"
    )
    assert len(set(cursors)) == 1
    assert "visible" in cursors[0]
    tab.keyboard.press("Escape")
    assert tab.evaluate("document.activeElement === document.body")


def test_two_fingers_zoom_and_one_steps(opened, toy_run):
    tab = opened(toy_run, 390, has_touch=True)
    pixels(tab, "toy")
    tab.locator("#stage").scroll_into_view_if_needed()
    box = tab.locator("#tiles .view").first.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    client = tab.context.new_cdp_session(tab)

    def touch(kind, *shifts):
        points = [{"x": middle[0] + shift, "y": middle[1], "id": n} for n, shift in enumerate(shifts)]
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    before = tab.locator("#where").text_content()
    touch("touchStart", 0)
    for shift in (-20, -40, -70):
        touch("touchMove", shift)
    touch("touchEnd")
    changed(tab, "where", before)
    touch("touchStart", -10, 10)
    for shift in (15, 20, 30):
        touch("touchMove", -shift, shift)
    touch("touchEnd")
    tab.wait_for_function("state.zoom > 1.5")


def test_a_view_opens_again_by_its_address(opened, toy_run):
    tab = opened(toy_run)
    before = tab.locator("#where").text_content()
    tab.keyboard.press("ArrowRight")
    place = changed(tab, "where", before)
    tab.keyboard.press("e")
    tab.keyboard.press("+")
    tab.wait_for_url("**zoom=1.5**")
    again = opened(toy_run, address="#" + tab.url.partition("#")[2])
    pixels(again, "Error map of toy")
    assert again.locator("#where").text_content() == place
    assert again.evaluate("state.zoom") == 1.5


def test_pictures_apart_are_loaded_when_they_are_shown(opened, toy_run, monkeypatch):
    monkeypatch.setattr(sections, "FILE_BYTES", 300)
    expected = pixels(opened(toy_run), "toy")
    tab = opened(toy_run, split=True)
    assert pixels(tab, "toy") == expected
    tab.keyboard.press("e")
    assert pixels(tab, "Error map of toy") != expected
    loaded, there = tab.evaluate("[files.size, data.files.length]")
    assert 0 < loaded < there


def test_the_wipe_shows_one_left_and_the_other_right(opened, toy_run):
    tab = opened(toy_run)
    truth, render = pixels(tab, "Ground truth"), pixels(tab, "toy")
    tab.keyboard.press("w")
    for share, expected in (("100", truth), ("0", render)):
        tab.locator("#border").fill(share)
        tab.wait_for_timeout(200)
        assert pixels(tab, "Ground truth to the left") == expected


def test_tables_sort_best_first_and_places_lead_to_frames(opened, toy_run, write_run):
    tab = opened(write_run("sorted", {"a": 30.0, "b": 32.0, "c": 31.0}))
    assert order(tab) == ["b", "c", "a"]
    heads = tab.locator("article.table.chosen thead tr:last-child th button")
    lower = tab.locator("article.table.chosen thead tr:last-child th").all_text_contents().index("LPIPS ↓")
    steps = (
        (1, ["a", "c", "b"], "ascending"),
        (lower, ["b", "c", "a"], "ascending"),
        (0, ["a", "b", "c"], "ascending"),
    )
    for column, expected, way in steps:
        heads.nth(column).click()
        assert order(tab) == expected
        assert tab.locator(f'article.table.chosen th[aria-sort="{way}"]').count() == 1
    tab = opened(toy_run)
    tab.wait_for_selector("#worst button")
    button = tab.locator("#worst button").last
    place = button.locator(".note").text_content().rpartition(",")[0]
    button.click()
    tab.wait_for_function("text => document.getElementById('where').textContent.startsWith(text)", arg=place)


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (390, "dark")])
def test_hostile_names_are_text_and_nothing_scrolls_sideways(opened, write_run, width, scheme):
    run = write_run("run", {HOSTILE: 30.0, "other": 31.0})
    manifest = RunFolder(run).read_manifest()
    one = replace(manifest.protocols["novel_view"], keys=(FrameKey("a", "EMO", 0, "a"),))
    replace(manifest, protocols={**manifest.protocols, "novel_view": one}).write(RunFolder(run).manifest)
    tab = opened(run, width, scheme)
    assert order(tab) == ["other", HOSTILE]
    assert HOSTILE in tab.locator("#tiles b").all_text_contents()
    assert tab.locator("img").count() == 0
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (390, "dark")])
def test_axe_finds_nothing_serious_in_the_report(opened, toy_run, serious, width, scheme):
    tab = opened(toy_run, width, scheme)
    tab.wait_for_selector("#worst canvas[width]")
    tab.evaluate("for (const d of document.querySelectorAll('details')) d.open = true")
    assert serious(tab) == []


def test_the_first_picture_stands_before_the_script(opened, toy_run):
    tab = opened(toy_run, java_script_enabled=False)
    shown = tab.locator("#tiles img")
    assert shown.count() == 2
    assert shown.evaluate_all("list => list.map(i => i.complete && i.naturalWidth > 0)") == [True, True]
