"""A command as somebody outside writes it: the worst frames of a run; nothing of headbench imported but its root."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from headbench import ALL, CommandResult, CommandSpec, InputError, Progress, RunData


@dataclass(frozen=True)
class WorstSettings:
    """The frames that each method of a finished run renders worst."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    metric: str = "psnr"
    """Metric of frames that says which are worst."""

    region: str = "full"
    """Part of the frame it is taken over."""

    count: int = 3
    """Frames to list of each method and task."""


WORST = CommandSpec(
    name="worst",
    group="inspect",
    summary="List the worst frames of each method of a finished run.",
    settings="outside_command:WorstSettings",
    function="outside_command:worst",
)


def worst(settings: WorstSettings, progress: Progress) -> CommandResult:
    """List the worst frames of each method of a finished run."""
    run = RunData.read(Path(settings.run))
    metrics = {spec.name: spec for spec in run.metrics if spec.per_frame}
    if settings.metric not in metrics:
        raise InputError("command line", "--metric", f"one of {', '.join(metrics)}", settings.metric)
    spec = metrics[settings.metric]
    lines, data = [], []
    for task in run.tasks:
        for method in run.methods:
            rows = run.rows.select(
                method=method, metric=spec.name, task=task, region=settings.region, seeds=ALL
            )
            measured = rows[rows["status"] == "ok"].sort_values("value", ascending=spec.higher_is_better)
            for row in measured.head(settings.count).itertuples():
                frame = f"{row.subject} {row.sequence} {row.timestep} {row.camera} seed {row.seed}"
                lines.append(f"{task} {method}: {row.value:.{spec.digits}f} {spec.unit}  {frame}")
                data.append({"task": task, "method": method, "frame": frame, "value": row.value})
    if not data:
        raise InputError("command line", "--region", "one that the run measured", settings.region)
    return CommandResult("\n".join(lines), data)
