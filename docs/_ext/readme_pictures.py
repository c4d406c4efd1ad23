"""Draws the pictures of the README and of the results page: subjects of a suite that was run here, and stored curves."""

from pathlib import Path

from PIL import Image

from headbench.bench.progress import counted
from headbench.bench.protocol import SEEN_CAMERAS, UNSEEN_CAMERAS, evenly
from headbench.reports.contact_sheet import compared_frame, contact_sheet
from headbench.reports.curve.curve import HELD_OUT, CurveData, write_curve
from headbench.reports.drawing import cost_axis, plot_file, start_axes
from headbench.reports.runs import SPLIT_TASK, RunData, unseen_cameras
from headbench.reports.suite.suite import suite_runs

SHOWN = ("ga", "gbs", "ours")
"""Methods beside the ground truth."""
TASKS = {
    "novel_view": "Face PSNR (dB), novel views",
    UNSEEN_CAMERAS: "new expressions, unseen cameras",
    SEEN_CAMERAS: "new expressions, seen cameras",
}
"""Titles of the README's plot by task."""


def draw_subjects(suite: Path, path: Path) -> None:
    """Draw a frame of self-reenactment at the unseen camera for each subject, as a JPEG."""
    frames = []
    for data in map(RunData.read, suite_runs(suite)):
        keys = data.keys(SPLIT_TASK)
        unseen, _ = unseen_cameras([data.manifest], keys)
        chosen = evenly([key for key in keys if (key.subject, key.camera) in unseen], 1)
        frames += [compared_frame(data, SPLIT_TASK, key, SHOWN, 150) for key in chosen]
    sheet = suite / "subjects.png"
    contact_sheet(frames, SHOWN, sheet, title="Subjects of the suite, unseen camera")
    Image.open(sheet).convert("RGB").save(path, quality=90)


def draw_curves(curve: CurveData, folder: Path) -> None:
    """Draw the curves over training time, and the README's plot: PSNR of the face over processor seconds, with sizes."""
    write_curve(folder / "curves.png", curve)
    lines, sizes = curve.by_method, [point.values["storage"] for point in curve.means]
    note = (
        f"Means over {counted(len(curve.subjects), 'development subject')}. Area of a circle: size of the avatar, {min(sizes):.1f} to "
        f"{max(sizes):.1f} MB."
    )
    with plot_file(folder / "seconds.png", (8.4, 3.7), 100, lines, note, line="-") as (figure, looks):
        for axes, (task, title) in zip(figure.subplots(1, len(TASKS), sharey=True), TASKS.items()):
            start_axes(axes, title)
            for name, own in lines.items():
                place = [
                    [p.cost[curve.clock] for p in own],
                    [p.values[f"psnr_face_{HELD_OUT[task]}"] for p in own],
                ]
                areas, colour = [8 * point.values["storage"] for point in own], looks[name][0]
                axes.plot(*place, color=colour, linewidth=1.2)
                axes.scatter(*place, areas, color=colour, alpha=0.75, edgecolors="white", zorder=3)
            axes.set(xlabel=curve.axis)
            cost_axis(axes)
