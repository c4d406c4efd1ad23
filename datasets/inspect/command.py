"""``headbench inspect``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import write_json
from ...bench.specs import CommandResult, command
from ...bench.terminal import table
from ..options import CaptureOptions

if TYPE_CHECKING:
    from ..clip import CaptureClip
    from .statistics import ExpressionSpace, SequenceRow, SplitRow
from typing import Literal


@dataclass(frozen=True)
class StepsSettings(CaptureOptions):
    """Plot the jaw bases and expression clusters of a capture's training frames."""

    capture: tyro.conf.Positional[str]
    """Capture, in a layout that a reader knows."""

    out: str
    """Folder for jaw_bases.png, expression_clusters.png and steps.json."""

    bases: int = 16
    """Maximum number of jaw bases."""

    clusters: int = 16
    """Maximum number of expression clusters."""

    seed: int = 0
    """Seed of the choice of landmarks in long captures."""

    variant: Literal["paper", "official"] = "paper"
    """"official" shows the result of the published code: jaw bases from held-out poses (a leak, which is stated)."""


JAW_PICTURE, CLUSTER_PICTURE = "jaw_bases.png", "expression_clusters.png"


@command("inspect steps", group="inspect", writes="out")
def steps(settings: StepsSettings, progress: Progress = no_progress) -> CommandResult:
    """Plot the jaw bases and expression clusters of a capture's training frames."""
    from ..images import write_image
    from ..steps.clusters import cluster_expressions
    from ..steps.figures import draw_clusters, draw_jaw_bases, find_jaw_bases

    for name in ("bases", "clusters"):
        if getattr(settings, name) < 1:
            raise InputError(f"--{name}", "", "at least 1", str(getattr(settings, name)))
    clip = settings.open(settings.capture, progress)
    jaws = find_jaw_bases(clip, settings.bases, variant=settings.variant)
    clusters = cluster_expressions(
        clip, settings.clusters, seed=settings.seed, variant=settings.variant, progress=progress
    )
    out = Path(settings.out)
    write_image(out / JAW_PICTURE, draw_jaw_bases(clip, jaws))
    write_image(out / CLUSTER_PICTURE, draw_clusters(clip, clusters, progress))
    data = {
        "subject": clip.subject,
        "clip": clip.fingerprint,
        "jaw_bases": jaws.record(),
        "expression_clusters": clusters.record(),
    }
    write_json(out / "steps.json", data)
    sizes = np.sort(np.bincount(clusters.labels))[::-1]
    lines = [
        f"subject {clip.subject}, {len(clusters.timesteps)} training timesteps",
        (
            f"{len(jaws.bases)} jaw bases, opening up to {jaws.angles[:, 0].max():.1f}°; "
            f"every training pose has one within {jaws.largest_gap:.1f}°"
        ),
        f"{len(sizes)} expression clusters of {', '.join(map(str, sizes))} timesteps",
        *(f"Leak: {note}" for note in jaws.record()["leaks"]),
        f"Pictures: {out / JAW_PICTURE}, {out / CLUSTER_PICTURE}",
    ]
    return CommandResult("\n".join(lines), data)


@dataclass(frozen=True)
class InspectSettings(CaptureOptions):
    """Capture to inspect, and number of frames to show."""

    clip: Annotated[str, tyro.conf.Positional]
    """Capture, in a layout that a reader knows; of the reader ga a UNION folder, a sequence folder, or the union's."""

    out: str = "inspection"
    """Folder for inspection.png and inspection.json."""

    timesteps: int = 3
    """Rows of overlays."""

    cameras: int = 4
    """Number of columns of overlays: held-out cameras first, then evenly over the rig."""


PICTURE, NUMBERS = "inspection.png", "inspection.json"


@command("inspect", group="inspect", writes="out")
def inspect(settings: InspectSettings, progress: Progress = no_progress) -> CommandResult:
    """Plot a capture: camera rig, splits, tracked mesh over images, motion."""
    from ..images import write_image
    from .figure import draw_figure
    from .statistics import expression_space, sequence_rows, split_rows

    for name in ("timesteps", "cameras"):
        if getattr(settings, name) < 1:
            raise InputError(f"--{name}", "", "at least 1", str(getattr(settings, name)))
    clip = settings.open(settings.clip, progress)
    splits, sequences, space = split_rows(clip), sequence_rows(clip), expression_space(clip)
    out = Path(settings.out)
    picture = draw_figure(
        clip,
        splits,
        sequences,
        space,
        timesteps=settings.timesteps,
        cameras=settings.cameras,
        progress=progress,
    )
    write_image(out / PICTURE, picture)
    data = summary(clip, splits, sequences, space)
    write_json(out / NUMBERS, data)
    text = _text(clip, splits, sequences, space)
    return CommandResult(f"{text}\n\nPicture: {out / PICTURE}", {**data, "picture": str(out / PICTURE)})


def summary(
    clip: CaptureClip, splits: Sequence[SplitRow], sequences: Sequence[SequenceRow], space: ExpressionSpace
) -> dict[str, Any]:
    """All values of the figure, as plain types."""
    record = clip.steps[0].parameters if clip.steps else {}
    held_out = {key.camera for key in clip.splits.get("novel_view", ())}
    return {
        "subject": clip.subject,
        "fingerprint": clip.fingerprint,
        "head_model": clip.head.version,
        "vertices": len(clip.head.template),
        "expressions": clip.head.expression_basis.shape[2],
        "background": clip.background.tolist(),
        "cy": record.get("cy", ""),
        "leaks": record.get("leaks", []),
        "eyelids": record.get("eyelids", ""),
        "synthetic": bool(record.get("synthetic")),
        "splits": [asdict(row) for row in splits],
        "excluded": {
            str(t): reason for t, reason in sorted({k.timestep: r for k, r in clip.excluded.items()}.items())
        },
        "cameras": [
            {
                "id": name,
                "held_out": name in held_out,
                "size": [camera.width, camera.height],
                "focal_px": float(camera.K[0, 0]),
                "principal_point_off_centre_px": (
                    camera.K[:2, 2] - np.array([camera.width, camera.height]) / 2
                ).tolist(),
                "position_m": camera.center.tolist(),
            }
            for name, camera in clip.cameras.items()
        ],
        "sequences": [asdict(row) for row in sequences],
        "expression_space": {
            "explained_variance": space.explained.tolist(),
            "components_for_95_percent": space.kept,
            "novelty_of_test_mm": {str(t): value for t, value in space.novelty_mm.items()},
            "outside_of_training": {name: found._asdict() for name, found in space.novelty.items()},
        },
    }


def _text(
    clip: CaptureClip, splits: Sequence[SplitRow], sequences: Sequence[SequenceRow], space: ExpressionSpace
) -> str:
    from .figure import space_summary

    lines = [f"subject {clip.subject}, head model {clip.head.version}, {len(clip.cameras)} cameras", ""]
    counts = [
        [row.split, *map(str, (row.images, row.timesteps, row.cameras, row.sequences))] for row in splits
    ]
    lines += [table(["split", "images", "timesteps", "cameras", "sequences"], counts), ""]
    heads = "sequence, timesteps, jaw deg, head deg, head mm, expression mm, rms sigma"
    motion = []
    for row in sequences:
        low, _, high = row.jaw_deg
        head = (
            f"{row.head_deg:.1f} {row.head_mm:.1f} {row.reach_mm[1]:.1f} {row.expression_sigma:.2f}".split()
        )
        name = f"{row.sequence} (held out)" if row.held_out else row.sequence
        motion.append([name, str(row.timesteps), f"{low:.1f} to {high:.1f}", *head])
    lines += [table(heads.split(", "), motion), "", space_summary(space) + "."]
    if clip.steps and clip.steps[0].parameters.get("eyelids"):
        lines.append(f"Eyelids: {clip.steps[0].parameters['eyelids']}.")
    for name, found in space.novelty.items():
        lines.append(
            f"{name}: {found.outside:.0%} of the expression lies outside the span of training, {found.beyond:.0%} of the "
            "timesteps beyond its range."
        )
    return "\n".join(lines)
