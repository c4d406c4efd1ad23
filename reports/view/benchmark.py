"""``headbench doctor bench viewer``: frame rate in a browser while a slider moves, and time of each step."""

from __future__ import annotations

import importlib
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import product
from typing import Any

import numpy as np

from ...bench.benchmarks import Row, findings
from ...bench.contracts import Progress
from ...bench.engine.adaptation import AdaptedClip
from ...bench.io.images import encode_image
from ...bench.registry import resolve
from ...bench.specs import CommandResult
from .drawing import draw, splats_of
from .scene import Scene, ShownAvatar
from .server import serving
from .session import THREADS
from .settings import ViewSettings
from .state import FreeView, Sliders, State

UNTRAINED = "headbench.methods.benchmarks.untrained:untrained"
"""Creates a capture and an avatar of any size; referred to by name, since this package imports no method."""

SPLATS, QUICK_SPLATS = (20_000, 60_000), (2_000,)
WINDOW = 1280, 720
SECONDS, QUICK_SECONDS = 8.0, 1.0
DRAFT = 0.25
"""Scale of the draft whose processor time is measured."""
LEAST_RATE = 8.0
"""Updates a second demanded of images of the smaller avatar, browser included, on two cores without a GPU."""
MOVE_MS = 30
SOFTWARE_WEBGL = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
COUNT_UPLOADS = """
window.uploads = 0;
for (const name of ["texImage2D", "texSubImage2D"]) {
  const given = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...values) { window.uploads++; return given.apply(this, values); };
}"""
MOVE_SLIDER = """([x, y, every]) => { let step = 0; window.moving = setInterval(() => { step++;
  for (const made of [PointerEvent, MouseEvent]) document.dispatchEvent(new made(
    made === PointerEvent ? "pointermove" : "mousemove",
    {clientX: x + 40 * Math.sin(step / 10), clientY: y, bubbles: true, buttons: 1})); }, every); }"""


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Serve untrained avatars, move a slider in Chromium; passed if images of the first reach `LEAST_RATE`.

    Without Playwright and Chromium the rates of a browser are missing, and the check is skipped.
    """
    counts, seconds = (QUICK_SPLATS, QUICK_SECONDS) if quick else (SPLATS, SECONDS)
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    rows: list[Row] = []
    for done, (count, mode) in enumerate(product(counts, ("images", "splats"))):
        progress(done, 2 * len(counts), f"{count} splats, {mode}")
        clip, avatar = resolve(UNTRAINED)(count, 550, 802, version="2023", timesteps=4)
        scene = Scene([ShownAvatar("ours", avatar, clip, AdaptedClip(clip), {})], {}, ())
        row = {"splats": count, "drawn as": mode, **_stages(scene, mode == "splats")}
        rows.append(row | (_in_browser(scene, mode, chromium, seconds) if chromium else {}))
    note = (
        f"A window of {WINDOW[0]}x{WINDOW[1]}, WebGL in software. pack: JPEG of an image. draft CPU: processor time of a "
        f"draft of {DRAFT:g} of the sides; 30 updates a second need less than 33. sent: by the server while a slider "
        "moves.\nuploads: textures that the browser gave to WebGL; one image takes two."
    )
    faults = []
    if not chromium:
        note += (
            "\nThe browser's rates are missing: there is no Chromium. Install it: apt-get install chromium."
        )
    elif not quick and rows[0]["sent a second"] < LEAST_RATE:
        faults = [f"{rows[0]['sent a second']:.1f} updates a second, fewer than {LEAST_RATE:g}"]
    return findings({"The viewer": rows}, note, faults)


def _stages(scene: Scene, splats: bool, repeats: int = 8) -> dict[str, float]:
    """Medians of milliseconds, with another expression each time."""
    view = FreeView.of(next(iter(scene.first.clip.cameras.values())))
    drawn, packed, drafted = [], [], []
    for number in range(repeats):
        state = State(Sliders({scene.first.version: (0.1 * number + 0.05,)}), splats=splats)
        start = time.perf_counter()
        if splats:
            splats_of(scene, scene.first, state, view)
            drawn.append(time.perf_counter() - start)
            continue
        image = draw(scene, state, view, WINDOW, 0.99).image
        between = time.perf_counter()
        encode_image(image, ".jpg", place="the viewer")
        drawn.append(between - start)
        packed.append(time.perf_counter() - between)
        # The time of the processor, which other programs on it do not change much.
        begun = time.process_time()
        with resolve(THREADS)(1):
            draw(scene, state, view, WINDOW, DRAFT)
        drafted.append(time.process_time() - begun)
    stages = {"pose and draw ms": drawn} | ({"pack ms": packed, "draft CPU ms": drafted} if packed else {})
    return {name: 1e3 * float(np.median(values)) for name, values in stages.items()}


def _in_browser(scene: Scene, mode: str, chromium: str, seconds: float) -> dict[str, float]:
    """Rates while a slider is dragged; Playwright wants a thread without a running event loop."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(_browse, scene, mode, chromium, seconds).result()


def _browse(scene: Scene, mode: str, chromium: str, seconds: float) -> dict[str, float]:
    with serving(scene, ViewSettings(("bench",), port=0)) as server, _page(chromium) as page:
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.get_by_text("Drawn by trained models").wait_for()
        if mode == "splats":
            page.get_by_label("Drawn as", exact=True).locator("visible=true").first.click()
            page.get_by_role("option").filter(has_text="splats").first.click()
            page.get_by_text("splats posed in").wait_for()
        page.wait_for_timeout(1000)
        box = page.get_by_role("slider").nth(2).bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.evaluate(MOVE_SLIDER, [x, y, MOVE_MS])
        (session,) = server.sessions.values()
        sent, first, start = session.updates, page.evaluate("window.uploads"), time.perf_counter()
        page.wait_for_timeout(1e3 * seconds)
        last, elapsed = page.evaluate("window.uploads"), time.perf_counter() - start
        return {
            "sent a second": (session.updates - sent) / elapsed,
            "uploads a second": (last - first) / elapsed,
        }


@contextmanager
def _page(chromium: str) -> Iterator[Any]:
    playwright = importlib.import_module("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=SOFTWARE_WEBGL)
        page = browser.new_page(viewport=dict(zip(("width", "height"), WINDOW)))
        page.add_init_script(COUNT_UPLOADS)
        yield page
        browser.close()
