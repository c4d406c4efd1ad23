"""``make pictures``: the page of an avatar of a finished demo, a report, and thirty synthetic people.

The page is ``docs/pictures/avatar.webp``; a report, for example of a subject of the suite, ``reports/gallery/report.jpg``. These need
Chromium. The people are ``docs/pictures/people.webp``.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from headbench.datasets.synthetic.history import over_time
from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.plan import FRONTAL, SyntheticSettings, load_geometry, plan_subject
from headbench.datasets.synthetic.renderer import CaptureRenderer

ROOT = Path(__file__).parents[2]
WIDTH = 1440
"""Of a window, pixels."""
PEOPLE = (91001, 91002, 91003)
"""Seeds of the people, ten subjects and one row each."""
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def avatar_page(demo: Path) -> Path:
    """Make the page of an avatar of a demo."""
    headbench, page = Path(sys.executable).with_name("headbench"), ROOT / "build" / "avatar.html"
    avatar, capture = next(demo.glob("*/ours/seed-*")), next((demo / "capture").glob("UNION*"))
    subprocess.run([headbench, "export", "html", avatar, "--capture", capture, "--out", page], check=True)
    return page


def picture(browser: Browser, path: Path, height: int, scale: float) -> Image.Image:
    """A page after its pictures are there, as large as a window ``height`` pixels high."""
    page = browser.new_page(viewport={"width": WIDTH, "height": height}, color_scheme="light")
    page.goto(path.resolve().as_uri())
    page.wait_for_timeout(1500)
    image = Image.open(BytesIO(page.screenshot())).convert("RGB")
    page.close()
    return image.resize((round(scale * WIDTH), round(scale * height)), Image.Resampling.LANCZOS)


def people() -> Image.Image:
    """Thirty subjects at rest, from the front."""
    geometry, rest, rows = load_geometry("procedural"), dict.fromkeys(CONTROLS, 0.0), []
    for seed in PEOPLE:
        row = []
        for index in range(10):
            settings = SyntheticSettings(10, 1, 4, (275, 401), "procedural", seed, 0.0, 9)
            plan = plan_subject(Path("unused"), index, geometry, settings)
            renderer = CaptureRenderer(plan)
            (skin,) = over_time([rest], 1.0, plan.person)
            renderer.set_pose(geometry.translation.pose(rest, plan.person.name, None), rest, skin)
            image = Image.fromarray(renderer.render(FRONTAL, 1)[0])
            row.append(np.asarray(image.resize((110, 160), Image.Resampling.LANCZOS)))
        rows.append(np.concatenate(row, axis=1))
    return Image.fromarray(np.concatenate(rows))


def main(demo: Path, report: Path) -> None:
    """Take the pictures of a demo's folder, and of a report, the file ``report.html``."""
    pictures = ROOT / "docs" / "pictures"
    people().save(pictures / "people.webp", quality=80)
    names = ("chromium", "chromium-browser", "google-chrome")
    program = next(filter(None, map(shutil.which, names)), None)
    if program is None:
        raise SystemExit("Chromium is not installed.")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(FLAGS))
        picture(browser, avatar_page(demo), 1800, 0.6).save(pictures / "avatar.webp", quality=60)
        picture(browser, report, 1270, 0.8).save(ROOT / "reports" / "gallery" / "report.jpg", quality=88)
        browser.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
