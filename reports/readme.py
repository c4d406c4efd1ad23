"""Writes results into the README: the tables, the demo's picture, and their rows.

python -m headbench.reports.readme demo demo-output README.md
python -m headbench.reports.readme suite suite-output README.md
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

from ..bench.audit.bundle import without_paths
from ..bench.engine.scoring import FULL
from ..bench.engine.store import RunFolder
from ..bench.errors import InputError
from ..bench.io.files import write_bytes, write_text
from ..bench.io.images import encode_image, read_png
from ..bench.rows import ALL, Rows
from .runs import RunSet
from .suite.suite import suite_report
from .table_report import table_of, table_text
from .writers import to_markdown

GALLERY = "reports/gallery"
SUITE = f"{GALLERY}/suite"
PICTURE = "contact_sheet.jpg"
RESULTS = "results.md"
OURS = "ours"


def publish_demo(out: Path, readme: Path) -> None:
    """Copy manifest, rows and contact sheet of a run to the README's folder, and write its block."""
    target = RunFolder(readme.parent / GALLERY)
    _copy(RunFolder(out), target)
    # A page's picture, not a measurement: a lossy copy a third the size.
    path, sheet = target.root / PICTURE, read_png(RunFolder(out).contact_sheet)
    write_bytes(path, encode_image(sheet, path.suffix, (cv2.IMWRITE_JPEG_QUALITY, 90), place=path))
    _write(readme, "demo", demo_block(target.root))


def publish_suite(out: Path, readme: Path) -> None:
    """Copy manifest and rows of a suite's run to the README's folder, and write its tables and block."""
    target = readme.parent / SUITE
    _copy(RunFolder(out / "run"), RunFolder(target / "run"))
    write_text(target / RESULTS, suite_results(target))
    _write(readme, "suite", suite_block(target))


def _copy(source: RunFolder, target: RunFolder) -> None:
    """Manifest, without this machine's folders, protocols and rows of a run."""
    manifest = source.read_manifest()
    target.root.mkdir(parents=True, exist_ok=True)
    without_paths(manifest, tuple(dict.fromkeys(method.name for method in manifest.methods))).write(
        target.manifest
    )
    Rows.read(source.rows).in_single_precision().write(target.rows)


def marks(name: str) -> tuple[str, str]:
    """Text before and after a block of the README."""
    return f"<!-- {name}:begin -->", f"<!-- {name}:end -->"


def _write(readme: Path, name: str, block: str) -> None:
    begin, end = marks(name)
    text = readme.read_text(encoding="utf-8")
    if text.count(begin) != 1 or text.count(end) != 1:
        raise InputError(readme, "", f"the marks {begin} and {end} once each", "something else")
    before, rest = text.split(begin)
    _, after = rest.split(end)
    write_text(readme, f"{before}{begin}\n{block}\n{end}{after}")


DEMO_DIGITS = ("psnr=1", "ssim=3", "lpips=3", "fps=0")
"""Of the demo's table: further ones change with the processor, as the README states below the table."""


def demo_block(gallery: Path) -> str:
    """Return the README's block for the stored result of the demo: Markdown."""
    record = RunFolder(gallery).read_manifest()
    machine = record.machine
    timed = [(method, value) for method, value in _minutes(gallery) if value is not None]
    minutes = ", ".join(f"{method} {value:.1f}" for method, value in timed if value >= 0.05)
    cost = (
        f"Minutes of training: {minutes}, on {machine['cores']} cores ({machine['processor']}); the largest process took "
        f"{(record.peak_memory_bytes or 0) / 1e9:.1f} GB."
    )
    picture = f"![Ground truth, renders and error maps of every method]({GALLERY}/{PICTURE})"
    return f"{picture}\n\n{table_text([gallery], 'md', digits=DEMO_DIGITS).strip()}\n\n{cost}"


def _minutes(run_folder: Path) -> list[tuple[str, float | None]]:
    """Minutes of training of every method and subject that was trained; None of one that was interrupted.

    This is not the run's duration, which after a restart is that of its last part.
    """
    rows = Rows.read(RunFolder(run_folder).rows)
    trained = rows.select(method=ALL, condition=ALL, metric="training_time", task="", region=FULL, seeds=ALL)
    ended = trained["status"] == "ok"
    return [
        (str(m), float(v) if ok else None) for m, v, ok in zip(trained["method"], trained["value"], ended)
    ]


def suite_results(folder: Path) -> str:
    """All tables of the stored run of the suite."""
    return suite_report(folder / "run", OURS)


def suite_block(folder: Path) -> str:
    """Return the README's block for the stored results of the suite: Markdown."""
    runs = RunSet.read([folder / "run"])
    minutes = [value for _, value in _minutes(folder / "run")]
    hours = sum(value for value in minutes if value is not None) / 60
    interrupted = (
        f", not counting {minutes.count(None)} that were interrupted and continued" if None in minutes else ""
    )
    return (
        f"{to_markdown(table_of(runs.only([*runs.ranked, *runs.trivial]))).strip()}\n\n"
        f"[Tables by region and by part of FREE, paired differences with tests]({SUITE}/{RESULTS}). "
        f"{len(minutes)} trainings, baselines included, took {hours:.1f} hours{interrupted}."
    )


PUBLISH = {"demo": publish_demo, "suite": publish_suite}

if __name__ == "__main__":
    PUBLISH[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]))
