"""``make pictures``: screenshots of the pages of a finished demo, the README's picture, and thirty synthetic people.

The report, the page of an avatar, a leaderboard and this site, at three widths in both schemes, as ``docs/pictures/*-after.webp``;
a report, for example of a subject of the suite, as ``reports/gallery/report.jpg``. These need Chromium. The people are ``docs/pictures/people.webp``.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from headbench.datasets.synthetic.history import over_time
from headbench.datasets.synthetic.performance import CONTROLS
from headbench.datasets.synthetic.plan import FRONTAL, SyntheticSettings, load_geometry, plan_subject
from headbench.datasets.synthetic.renderer import CaptureRenderer

ROOT = Path(__file__).parents[2]
SIZES = {1440: 1800, 1024: 1365, 390: 2000}
"""Height of a picture by width, pixels of the page."""
STORED = 0.6
"""Scale of stored pictures, except those of phones."""
PEOPLE = (91001, 91002, 91003)
"""Seeds of the people, ten subjects and one row each."""
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def pages_of(demo: Path, work: Path) -> dict[str, Path]:
    """Make the pages that a demo does not leave."""
    headbench = str(Path(sys.executable).with_name("headbench"))
    avatar = next(demo.glob("*/ours/seed-*"))
    capture = next((demo / "capture").glob("UNION*"))
    bundles = work / "bundles"
    bundles.mkdir(parents=True)
    for line in (
        ["export", "html", avatar, "--capture", capture, "--out", work / "avatar.html"],
        ["bundle", demo, "--out", bundles / "demo.zip", "--by", "headbench"],
        ["report", "leaderboard", bundles, "--out", work],
    ):
        subprocess.run([headbench, *map(str, line)], check=True)
    return {
        "report": demo / "report.html",
        "avatar": work / "avatar.html",
        "leaderboard": work / "leaderboard.html",
        "site": ROOT / "build" / "docs" / "index.html",
    }


def picture(page: Page, path: Path) -> Image.Image:
    """A page after its pictures are there, as large as the window."""
    page.goto(path.resolve().as_uri())
    page.wait_for_timeout(1500)
    return Image.open(BytesIO(page.screenshot())).convert("RGB")


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
    """Take the pictures of a demo's folder, and the README's of a file ``report.html``."""
    people().save(ROOT / "docs" / "pictures" / "people.webp", quality=80)
    work = ROOT / "build" / "pictures"
    shutil.rmtree(work, ignore_errors=True)
    names = ("chromium", "chromium-browser", "google-chrome")
    program = next(filter(None, map(shutil.which, names)), None)
    if program is None:
        raise SystemExit("Chromium is not installed.")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(FLAGS))
        for name, path in pages_of(demo, work).items():
            for width, height in SIZES.items():
                for scheme in ("light", "dark"):
                    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
                    image = picture(page, path)
                    page.close()
                    scale = 0.8 if width < 600 else STORED
                    small = image.resize(
                        (round(scale * width), round(scale * height)), Image.Resampling.LANCZOS
                    )
                    small.save(ROOT / "docs" / "pictures" / f"{name}-{width}-{scheme}-after.webp", quality=60)
        page = browser.new_page(viewport={"width": 1440, "height": 1270}, color_scheme="light")
        readme = picture(page, report).resize((1152, 1016), Image.Resampling.LANCZOS)
        readme.save(ROOT / "reports" / "gallery" / "report.jpg", quality=88)
        browser.close()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
