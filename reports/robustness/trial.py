"""One frame of an avatar under trial, and what a trial leaves on disk."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import Avatar, Camera, Frame, FrameKey, HeadPose
from ...bench.io.frames import quantise, write_png
from ...bench.protocol import Protocol
from ...bench.rows import Row
from ...bench.runner.adaptation import MethodNeeds
from ...bench.runner.scoring import FULL
from ...bench.runner.stages import Job
from .stability import Measures, Verdict, measure

ROWS_FILE, RECORD_FILE, SHEET_FILE = "rows.parquet", "record.json", "contact_sheet.png"


@dataclass(frozen=True)
class Trial:
    """A judged frame. ``key`` names pose and view; verdicts stand in the order of `stability.MEASURES`, further ones after."""

    key: FrameKey
    verdicts: Sequence[Verdict]

    @property
    def broken(self) -> list[Verdict]:
        """The limits that do not hold."""
        return [verdict for verdict in self.verdicts if not verdict.passed]


def splats_of(avatar: Avatar, pose: HeadPose) -> Any:
    """Splats of a pose where the avatar is one of splats, else None."""
    give = getattr(avatar, "splats", None)
    return None if give is None else give(pose)


def shoot(
    avatar: Avatar, camera: Camera, pose: HeadPose, splats: Any, background: Sequence[float]
) -> tuple[Frame, Measures]:
    """Render a frame and measure it."""
    frame = avatar.render(camera, pose, background)
    return frame, measure(frame, camera, splats)


def write_frame(path: Path, frame: Frame) -> None:
    """Write the frame as 8-bit PNG; one that is not finite leaves no file, since any level would hide it."""
    if np.isfinite(frame.rgb).all():
        write_png(path, quantise(frame.rgb))
    else:
        path.unlink(missing_ok=True)


def cell_folder(root: Path, job: Job) -> Path:
    """Where the frames of an avatar go."""
    return root / job.clip.subject / job.method.spec.name / f"seed-{job.seed}"


def to_rows(job: Job, task: str, trials: Sequence[Trial], protocol: str) -> list[Row]:
    """Rows as every measurement leaves them; a broken limit has status "failed" and says which."""
    rows = []
    for trial in trials:
        for verdict in trial.verdicts:
            status, reason = "ok", ""
            if verdict.value is None:
                status, reason = "missing", verdict.absent
            elif not verdict.passed:
                status, reason = "failed", str(verdict)
            rows.append(
                Row(
                    method=job.method.spec.name,
                    version=job.method.spec.version,
                    seed=job.seed,
                    task=task,
                    subject=trial.key.subject,
                    sequence=trial.key.sequence,
                    timestep=trial.key.timestep,
                    camera=trial.key.camera,
                    region=FULL,
                    metric=verdict.measure,
                    value=math.nan if verdict.value is None else verdict.value,
                    protocol=protocol,
                    status=status,
                    reason=reason,
                )
            )
    return rows


def summary(job: Job, trials: Sequence[Trial]) -> dict[str, Any]:
    """What a trial of one avatar found: frames, frames outside limits, and the extremes of every measure."""
    broken = [trial for trial in trials if trial.broken]
    ranges: Mapping[str, tuple[float | None, float | None]] = {
        verdicts[0].measure: _range([v.value for v in verdicts])
        for verdicts in zip(*(t.verdicts for t in trials))
    }
    return {
        "subject": job.clip.subject,
        "method": job.method.spec.name,
        "seed": job.seed,
        "frames": len(trials),
        "frames_broken": len(broken),
        "ranges": ranges,
        "broken": [{"key": str(t.key), "limits": [str(v) for v in t.broken]} for t in broken],
    }


def described(protocols: Iterable[Protocol]) -> list[dict[str, Any]]:
    """What a record says of the protocols that its rows name, each once."""
    by_hash = {protocol.hash: protocol for protocol in protocols}
    return [{"id": p.id, "hash": name, **asdict(p)} for name, p in sorted(by_hash.items())]


def needs_of(job: Job) -> MethodNeeds:
    """Cells of equal needs are shown the same frames, and so share a protocol."""
    return MethodNeeds.of(job.method.spec)


def _range(values: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Least and largest finite value; None without any."""
    finite = [v for v in values if v is not None and math.isfinite(v)]
    return (min(finite), max(finite)) if finite else (None, None)


def table(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Summaries for a terminal."""
    lines = [
        (
            f"{'subject':<10} {'method':<16} {'seed':>4} {'frames':>6} {'broken':>6}  "
            f"{'coverage':>13} {'translucent':>13} {'largest splat':>13} {'mean opacity':>13}"
        )
    ]
    for s in summaries:
        shown = [
            "-" if s["ranges"][name][0] is None else "{:.2f} to {:.2f}".format(*s["ranges"][name])
            for name in ("coverage", "translucent", "largest_splat", "mean_opacity")
        ]
        lines.append(
            f"{s['subject']:<10} {s['method']:<16} {s['seed']:>4} {s['frames']:>6} {s['frames_broken']:>6}  "
            + " ".join(f"{text:>13}" for text in shown)
        )
        if s.get("identity") is not None:
            told = ", ".join(
                f"{name} {value:.1f}" for name, value in s["identity"].items() if value is not None
            )
            lines.append(f"  colour difference from the subject's own look (CIEDE2000): {told}")
        lines += [f"  {b['key']}: {'; '.join(b['limits'])}" for b in s["broken"][:5]]
        if len(s["broken"]) > 5:
            lines.append(f"  and {len(s['broken']) - 5} more; all are in {RECORD_FILE}")
    return "\n".join(lines)
