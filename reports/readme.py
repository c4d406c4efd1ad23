"""Puts the result of a run into the README: the table, the picture, and the rows they are views of.

python -m headbench.reports.readme demo-output README.md
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2

from ..bench.audit.bundle import without_paths
from ..bench.errors import InputError
from ..bench.io.files import atomic_path, write_text
from ..bench.io.images import read_png
from ..bench.rows import ALL, Rows
from ..bench.runner.scoring import FULL
from ..bench.runner.store import RunFolder
from .table_report import table_text

BEGIN, END = "<!-- demo:begin -->", "<!-- demo:end -->"
GALLERY = "reports/gallery"
PICTURE = "contact_sheet.jpg"


def publish(run_folder: Path, readme: Path) -> None:
    """Copy manifest (without this machine's folders), rows and contact sheet of a run beside the README, and write the
    block made of them."""
    source, target = RunFolder(run_folder), RunFolder(readme.parent / GALLERY)
    manifest = source.read_manifest()
    without_paths(manifest, tuple(method.name for method in manifest.methods)).write(target.manifest)
    with atomic_path(target.rows) as temporary:
        shutil.copyfile(source.rows, temporary)
    # A page's picture, not a measurement: a lossy copy a third the size.
    sheet = cv2.cvtColor(read_png(source.contact_sheet), cv2.COLOR_RGB2BGR)
    with atomic_path(target.root / PICTURE) as temporary:
        cv2.imwrite(str(temporary), sheet, [cv2.IMWRITE_JPEG_QUALITY, 90])
    text = readme.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise InputError(readme, "", f"the marks {BEGIN} and {END} once each", "something else")
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    write_text(readme, f"{before}{BEGIN}\n{block(target.root)}\n{END}{after}")


def block(gallery: Path) -> str:
    """Return the README's block for the stored result in ``gallery``: Markdown."""
    record = RunFolder(gallery).read_manifest()
    machine = record.machine
    rows = Rows.read(RunFolder(gallery).rows)
    trained = rows.select(method=ALL, metric="training_time", task="", region=FULL, seeds=ALL)
    trained = trained[trained["status"] == "ok"]
    # Not the run's own length: of a demo that was continued it is that of its last part.
    spent = zip(trained["method"].astype(str), trained["value"].astype(float))
    minutes = ", ".join(f"{method} {value:.1f}" for method, value in spent if value >= 0.05)
    cost = (
        f"Minutes of training: {minutes}, on {machine['cores']} cores ({machine['processor']}); the largest process took "
        f"{(record.peak_memory_bytes or 0) / 1e9:.1f} GB."
    )
    picture = f"![Ground truth, renders and error maps of every method]({GALLERY}/{PICTURE})"
    return f"{picture}\n\n{table_text([gallery], 'md').strip()}\n\n{cost}"


if __name__ == "__main__":
    publish(Path(sys.argv[1]), Path(sys.argv[2]))
