"""Draws the pictures of the README and of the results page: subjects of a suite that was run here, and stored curves."""

from collections.abc import Callable, Sequence
from pathlib import Path

from PIL import Image

from headbench.bench.protocol import evenly
from headbench.reports.contact_sheet import compared_frame, contact_sheet
from headbench.reports.curve.curve import HELD_OUT, CurveData, write_curve
from headbench.reports.drawing import cost_axis, plot_file, start_axes
from headbench.reports.runs import SPLIT_TASK, RunData, unseen_cameras
from headbench.reports.suite.suite import suite_runs

SHOWN = ("ga", "gbs", "ours")
"""Methods beside the ground truth."""


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


def draw_curves(curve: Callable[[str], CurveData], methods: Sequence[str], folder: Path) -> None:
    """Draw the curves over seconds and pictures, and the README's plot: PSNR of methods over seconds, with sizes."""
    for over in ("seconds", "pictures"):
        write_curve(folder / f"curve-{over}.png", curve(over))
    data = curve("seconds")
    lines = {name: [point for point in data.means if point.method == name] for name in methods}
    sizes = [point.values["storage"] for own in lines.values() for point in own]
    note = (
        f"Means over {len(data.subjects)} subjects, whole frames. Area of a circle: size of the avatar, {min(sizes):.0f} to "
        f"{max(sizes):.0f} MB. Held out of every training: a camera, and one of {data.every} timesteps."
    )
    with plot_file(folder / "seconds.png", (8.4, 3.7), 100, methods, note, line="-") as (figure, looks):
        for axes, task in zip(figure.subplots(1, len(data.tasks), sharey=True), data.tasks):
            start_axes(axes, f"PSNR (dB), held-out {HELD_OUT[task]}")
            for name, own in lines.items():
                place = [[p.cost[data.clock] for p in own], [p.values[f"psnr_{HELD_OUT[task]}"] for p in own]]
                areas, colour = [8 * point.values["storage"] for point in own], looks[name][0]
                axes.plot(*place, color=colour, linewidth=1.2)
                axes.scatter(*place, areas, color=colour, alpha=0.75, edgecolors="white", zorder=3)
            axes.set(xlabel=data.axis)
            cost_axis(axes)
        axes.set_ylim(bottom=14)  # the shortest training of `gha` is below
