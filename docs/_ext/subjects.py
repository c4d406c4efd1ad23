"""Draws the README's picture: a frame of each subject of a suite that was run here.

python docs/_ext/subjects.py suite-output
"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

from headbench.bench.io.files import write_bytes
from headbench.bench.io.images import encode_image, read_png
from headbench.bench.protocol import evenly
from headbench.reports.cameras import SPLIT_TASK, unseen_cameras
from headbench.reports.contact_sheet import compared_frame, contact_sheet
from headbench.reports.runs import RunData
from headbench.reports.suite.suite import suite_runs

METHODS = ("ga", "gbs", "ours")
PICTURE = Path(__file__).parents[2] / "reports" / "gallery" / "subjects.jpg"


def draw_subjects(out: Path) -> None:
    """Draw a frame of self-reenactment at the unseen camera for each subject."""
    frames = []
    for data in map(RunData.read, suite_runs(out)):
        keys = data.keys(SPLIT_TASK)
        unseen, _ = unseen_cameras([data.manifest], keys)
        chosen = evenly([key for key in keys if (key.subject, key.camera) in unseen], 1)
        frames += [compared_frame(data, SPLIT_TASK, key, METHODS, 150) for key in chosen]
    with TemporaryDirectory() as temporary:
        sheet = Path(temporary) / "sheet.png"
        contact_sheet(frames, METHODS, sheet, title="Subjects of the suite, unseen camera")
        image = encode_image(read_png(sheet), ".jpg", (cv2.IMWRITE_JPEG_QUALITY, 90), place=PICTURE)
    write_bytes(PICTURE, image)


if __name__ == "__main__":
    draw_subjects(Path(sys.argv[1]))
