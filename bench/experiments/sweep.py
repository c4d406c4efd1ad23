"""``headbench run sweep``: smaller and faster avatars derived without training, as conditions of a run with a source."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from ..condition import PLAIN, Condition, Named
from ..contracts import Avatar, Clip, Progress, no_progress
from ..engine.config import RunOptions, default_names, with_methods
from ..engine.guard import TrainingView
from ..engine.plan import trained
from ..engine.run import run
from ..engine.store import RunFolder
from ..errors import InputError
from ..executors.settings import ExecutionOptions
from ..io.files import check_kind, check_name, output_inside
from ..io.lock import locked
from ..registry import get, resolve
from ..specs import CommandResult, MethodSpec, command


@dataclass(frozen=True)
class SweepSettings(RunOptions, ExecutionOptions):
    """Quality against size and frame time of variants derived from a run's avatars without training."""

    run: tyro.conf.Positional[str]
    """Folder of a finished run."""

    out: str | None = None
    """Folder to write, a run folder itself; default: `sweep` in the folder of the run. The same sweep in it is continued."""

    methods: tuple[str, ...] = ()
    """Methods to derive from; default: all that provide variants."""

    variants: tuple[str, ...] = ()
    """Variants to derive, by name; default: all. The trained avatar itself is always measured."""

    frames: int | None = None
    """Maximum number of scored frames per subject and task, evenly spaced; default: that of the run."""

    task: str = "novel_view"
    """Task whose frames give the quality in the plot."""

    metric: str = ""
    """Metric of quality in the plot; default: the first of frames that the run has."""

    time: str = ""
    """Metric of frame time in the plot, in ms: latency_p50 (default), processor_time on a machine with other work."""

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"frames is {self.frames}; at least 1")


@command("run sweep", group="compare")
def sweep_run(settings: SweepSettings, progress: Progress = no_progress) -> CommandResult:
    """Derive smaller and faster avatars without training, and measure them.

    The trained avatars are measured again with their variants, so that frame times are comparable. Writes
    ``points.csv`` and ``pareto.png`` into the run folder. A restart keeps existing measurements and adds
    variants.

    Raises
    ------
    InputError
        The folder is not a finished run, a method derives no variants, or no method has the variant.
    """
    execution, source = settings.execution, RunFolder(Path(settings.run))
    source.read_manifest()  # before a folder is created
    out = Path(settings.out) if settings.out else source.root / "sweep"
    check_kind(out, "a run")
    with nullcontext() if settings.out else output_inside(source.root), locked(out):
        config, jobs = trained(source.root, settings.methods, settings, out)
        able = [job for job in jobs if job.method.spec.variants]
        unable = sorted({job.method.spec.name for job in jobs} - {job.method.spec.name for job in able})
        if not able or (settings.methods and unable):
            found = ", ".join(unable) or "none"
            raise InputError(settings.run, "methods", "methods that derive variants", found)
        methods: dict[str, dict[str, None]] = {}
        for job in able:
            derive = resolve(job.method.spec.variants)
            for variant in derive(job.cell.avatar, TrainingView(job.form.clip), job.device):
                name = check_name(variant.name, job.method.spec.variants, "name of a variant")
                methods.setdefault(name, {})[job.method.spec.name] = None
        for name in settings.variants:
            if name not in methods:
                raise InputError(
                    "sweep", "variants", f"a variant of these methods: {', '.join(methods)}", repr(name)
                )
        conditions = [
            Condition(name, tuple(names), derive=Named("variant", {"name": name}))
            for name, names in methods.items()
            if not settings.variants or name in settings.variants
        ]
        # Cost of avatars, independent of the run's metrics.
        costs = [name for name in default_names("metrics") if get("metrics", name).kind == "avatar"]
        metrics = dict.fromkeys((*config.metrics, *costs))
        config = replace(
            with_methods(config, {job.method.spec.name for job in able}),
            frames_per_task=config.frames_per_task if settings.frames is None else settings.frames,
            metrics=tuple(name for name in metrics if get("metrics", name).kind != "training"),
            conditions=(PLAIN, *conditions),
            source=settings.run,
        )
        clips = list({job.clip.subject: job.clip for job in able}.values())
        run(config, execution, clips=clips, is_locked=True, reports=False)
        shown: CommandResult = resolve(get("reports", "pareto").implementation)(
            (str(out),), out, settings.task, settings.metric, settings.time
        )
        return shown


def variant(method: MethodSpec, trained: Path, out: Path, clip: Clip, device: str, *, name: str) -> Avatar:
    """Create a named variant of a trained avatar, see `MethodSpec.variants`; the registered change "variant".

    Raises `InputError` if the avatar has no such variant.
    """
    known = []
    for each in resolve(method.variants)(trained, clip, device):
        if each.name == name:
            return each.make(out)  # type: ignore[no-any-return]
        known.append(each.name)
    raise InputError(trained, "variant", f"one of {', '.join(known)}", name)
