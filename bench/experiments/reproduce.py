"""Reproduction of a paper's results: from recordings to captures, runs, figures, and its claims as met, missed or not run."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from ..condition import PLAIN, Condition
from ..contracts import Progress, no_progress
from ..engine.config import RunConfig, resolve_cells, resolve_metrics, with_methods
from ..engine.plan import check_settings
from ..engine.run import run
from ..engine.store import RunFolder
from ..errors import InputError
from ..executors.settings import Execution, ExecutionOptions, check_executor
from ..io.documents import checked, read_json
from ..io.files import digest, write_json, write_text
from ..options import iterations
from ..protocol import needed
from ..registry import get, unknown
from ..specs import CommandResult, MethodSpec, command
from .forecast import TIMESTEPS, Amounts, Rates, bytes_left, forecast, measure, runs_of
from .specs import MOVED_LINES

if TYPE_CHECKING:
    from ...datasets.nersemble.names import PrepareSettings
    from ...datasets.nersemble.plan import PreparationPlan
    from ...reports.claims import JudgedClaim

log = logging.getLogger(__name__)
OURS = "ours"
COMPARISON, ABLATION = "table-3", "table-4"
"""Folders of the captures and runs of the comparison and of the ablations."""
ABLATION_TABLE = "Table 4"
PLAN_FILE, CLAIMS = "plan.json", "claims"


@dataclass(frozen=True)
class ReproduceSettings(ExecutionOptions):
    """Reproduces the tables of a paper from recordings of NeRSemble with VHAP's tracking: measures a plan of hours and disk,
    converts the recordings, leaves out frames that show the tongue, trains and measures all methods, draws the figures, and lists
    the paper's claims as met, missed or not run. If it is interrupted, the same command continues it.
    """

    paper: tyro.conf.Positional[Literal["tensorial-2025"]]
    """Name of the paper."""

    data: str
    """Folder with the raw recordings, which holds the participants' folders."""

    tracking: str
    """Folder with VHAP's results."""

    head: str
    """Head model of the tracking (flame2023.pkl), beside FLAME_masks.pkl."""

    out: str
    """Folder for captures, runs, figures and claims.md."""

    flame2020: str | None = None
    """FLAME 2020, to which the tracking is refitted for methods that need it, such as gbs."""

    methods: tuple[str, ...] = ("insta", "ga", "gbs", "gha", OURS)
    """Methods of the comparison."""

    preset: str = "paper"
    """Preset, as for `headbench run`."""

    iterations: tuple[str, ...] = ()
    """METHOD=NUMBER: iterations of methods, instead of those of the preset."""

    subjects: str = "paper"
    """Ids of the comparison's subjects separated by commas, or "paper", its nine."""

    ablation: str = "ablation"
    """Id of the subject of the ablations, "ablation" (306), or "" to leave them out."""

    sequences: str = "paper"
    """Sequences, as for `headbench prepare nersemble`."""

    downscale: int = 4
    """Width and height of the recordings are divided by this."""

    device: str = "cuda"
    """Device, such as cuda or cpu; methods that do not support it run on the CPU."""

    timed: int = 200
    """Iterations that are timed for the plan."""

    until: Literal["plan", "captures", "claims"] = "claims"
    """Last step: "plan" measures and prints the plan; "captures" also converts the recordings and finds the frames with the tongue,
    to review them before anything is trained."""

    def __post_init__(self) -> None:
        """Refuse invalid numbers, and settings that no run can have."""
        for name, least in (("timed", 2), ("downscale", 1)):
            if (value := getattr(self, name)) < least:
                raise InputError("command line", f"--{name}", f"at least {least}", str(value))
        trained = {*self.methods, *([OURS] if self.ablation else [])}
        for name in iterations(self.iterations):
            if name not in trained:
                raise unknown("command line", "--iterations", name, trained)
        planned_runs(self)

    def preparation(self, part: str) -> PrepareSettings:
        """Settings of the conversion of the recordings of one part."""
        from ...datasets.nersemble.names import PrepareSettings

        return PrepareSettings(
            root=self.data,
            out=str(Path(self.out) / "captures" / part),
            subjects=self.parts[part],
            sequences=self.sequences,
            tracking=self.tracking,
            head=self.head,
            downscale=self.downscale,
        )

    @property
    def parts(self) -> dict[str, str]:
        """Subjects of each part."""
        return {COMPARISON: self.subjects} | ({ABLATION: self.ablation} if self.ablation else {})

    @property
    def tongue(self) -> dict[str, Path]:
        """Folder of the decisions on frames that show the tongue, by part."""
        return {part: Path(self.out) / "tongue" / part for part in self.parts}


@command("run reproduce", group="compare", writes="out")
def reproduce(settings: ReproduceSettings, progress: Progress = no_progress) -> CommandResult:
    """Reproduce a paper from NeRSemble recordings: plan, captures, all methods, figures, and its claims."""
    from ...datasets.nersemble.command import prepare_nersemble
    from ...datasets.nersemble.names import chosen_subjects
    from ...datasets.nersemble.plan import plan_subject
    from ...reports.claims import claims_text

    out, runs = Path(settings.out), planned_runs(settings)
    for config in runs.values():
        check_settings(resolve_cells(config))
        resolve_metrics(config)
        check_executor(settings.execution, config.device)
    recordings = {
        part: [plan_subject(settings.preparation(part), each) for each in chosen_subjects(subjects)]
        for part, subjects in settings.parts.items()
    }
    for job in (job for plans in recordings.values() for each in plans for job in each.jobs):
        if job.tracked is None:
            name = f"{job.recorded.subject} {job.recorded.name}"
            raise InputError(settings.tracking, name, "VHAP's tracked_flame_params_*.npz", "none")
    plan = _plan(settings, runs, recordings, progress)
    if settings.until == "plan":
        return CommandResult(plan["text"], plan)
    captures: dict[str, dict[str, str]] = {}
    for part in settings.parts:
        prepared = prepare_nersemble(settings.preparation(part), progress)
        captures[part] = {subject: str(each["union"]) for subject, each in prepared.data.items()}
        _leave_out_tongue(settings, part, captures[part], progress)
    if settings.until == "captures":
        sheets = "\n".join(f"Review the frames left out: {folder}" for folder in settings.tongue.values())
        return CommandResult(f"{plan['text']}\n\n{sheets}", {"captures": captures, "plan": plan})
    _draw_steps(settings, next(iter(captures[COMPARISON].values())), progress)
    failed: set[str] = set()
    verdicts: Sequence[JudgedClaim] = ()
    for config in runs.values():
        failed |= {*run(config, _execution(settings, config)).rows.failed}
        verdicts = _write_claims(settings, runs)  # so that a killed reproduction has those of finished runs
    files = f"Plan: {out / 'plan.md'}, claims: {out / CLAIMS}.md, figures: {out / 'figures'}"
    text = [claims_text(verdicts), files]
    data = {"plan": plan, "claims": [verdict.record() for verdict in verdicts], "failed": sorted(failed)}
    return CommandResult("\n\n".join(text), data, not failed)


def planned_runs(settings: ReproduceSettings) -> dict[str, RunConfig]:
    """The configuration of each run by the name of its folder; methods that do not support the device have runs of their own."""
    runs: dict[str, RunConfig] = {}
    for part in settings.parts:
        methods = settings.methods if part == COMPARISON else (OURS,)
        specs: list[MethodSpec] = [get("methods", name) for name in methods]
        devices = [settings.device if s.computes_on(settings.device) else s.devices[0] for s in specs]
        decisions = settings.tongue[part] / "tongue.yaml"
        for device in dict.fromkeys(devices):
            name = part if device == settings.device else f"{part}-{device}"
            config = RunConfig(
                data=str(Path(settings.out) / "captures" / part),
                out=str(Path(settings.out) / "runs" / name),
                methods=tuple(methods),
                preset=settings.preset,
                metrics=_metrics(settings.paper),
                reader_settings={"head": settings.head, "exclude": str(decisions)},
                device=device,
                settings=iterations(settings.iterations),
                heads={"flame2020": settings.flame2020} if settings.flame2020 else {},
                **needed([settings.paper], {}),
            )
            chosen = [spec.name for spec, own in zip(specs, devices) if own == device]
            runs[name] = with_methods(config, chosen)
            if part == ABLATION:
                moved = Condition(MOVED_LINES, (OURS,), dict(specs[0].ablations[MOVED_LINES]))
                runs[name] = replace(runs[name], conditions=(PLAIN, moved))
    return runs


def _plan(
    settings: ReproduceSettings,
    runs: Mapping[str, RunConfig],
    recordings: Mapping[str, Sequence[PreparationPlan]],
    progress: Progress,
) -> dict[str, Any]:
    """Hours and disk of all steps, from rates that are measured once; refused without room for what is not there yet."""
    from ...reports.writers import pipe_table

    out = Path(settings.out)
    made_for = digest({name: value for name, value in settings.others.items() if name != "until"})
    stored = read_json(out / PLAN_FILE) if (out / PLAN_FILE).exists() else {}
    if stored.get("settings") != made_for:
        first, execution = recordings[COMPARISON][0], settings.execution
        if execution.executor != "slurm":
            execution = replace(execution, executor="inline")  # trainings at once would take longer
        rates = measure(runs, first, settings.timed, execution, out / "plan", progress)
        write_json(out / PLAN_FILE, {"settings": made_for, "rates": asdict(rates)})
    else:
        rates = checked(stored["rates"], Rates, out / PLAN_FILE, "rates")
    found = forecast(rates, runs, {part: Amounts.of(plans) for part, plans in recordings.items()})
    left, free = bytes_left(rates, runs, recordings), shutil.disk_usage(out).free
    how = (
        f"Measured on {TIMESTEPS} timesteps of a training sequence and the held-out one of subject "
        f"{recordings[COMPARISON][0].subject} with {settings.timed} iterations, on one device. Trainings slow down as splats are "
        "added: a lower bound."
    )
    table = pipe_table(found.pop("lines"))
    text = f"{table}\n\n{how} {found['bytes'] / 1e9:.3g} GB, of which {left / 1e9:.3g} are to be written; {free / 1e9:.1f} GB free."
    write_text(out / "plan.md", f"{text}\n")
    if settings.until != "plan":
        log.info("%s", text)  # before hours of work
        if free < left:
            expected = f"{left / 1e9:.1f} GB of free space"
            raise InputError(out, "", expected, f"{free / 1e9:.1f} GB", "Give an --out on another disk.")
    return {**found, "text": text}


def _metrics(paper: str) -> tuple[str, ...]:
    """The metrics that the paper prints, and the time of the trainings."""
    from ...reports.papers import paper_named

    keys = [key for table in paper_named(paper).tables for key in table.keys]
    return (*dict.fromkeys(key.rpartition("/")[2] for key in keys), "training_time")


def _execution(settings: ReproduceSettings, config: RunConfig) -> Execution:
    """Execution of a run; jobs on the CPU ask for no GPU."""
    execution = settings.execution
    slurm = replace(execution.slurm, gpus=0) if config.device == "cpu" else execution.slurm
    return replace(execution, slurm=slurm)


def _leave_out_tongue(
    settings: ReproduceSettings, part: str, captures: Mapping[str, str], progress: Progress
) -> None:
    """Find the frames that show the tongue, unless that is done; decisions that a person has changed are kept."""
    from ...datasets.steps.exclude import read_exclusions
    from ...datasets.steps.tongue.command import DECISIONS_FILE, TongueSettings, tongue

    out = settings.tongue[part]
    path = out / DECISIONS_FILE
    decided = read_exclusions(path) if path.exists() else {}
    for subject, capture in captures.items():
        if subject not in decided:
            tongue(TongueSettings(capture, str(out), head=settings.head), progress)


def _draw_steps(settings: ReproduceSettings, capture: str, progress: Progress) -> None:
    """Figures 7 and 8: jaw bases and expression clusters of the first subject."""
    from ...datasets.inspect.command import StepsSettings, steps

    chosen = StepsSettings(capture, str(Path(settings.out) / "figures"), head=settings.head)
    steps(replace(chosen, set=(f"exclude={settings.tongue[COMPARISON] / 'tongue.yaml'}",)), progress)


def _write_claims(settings: ReproduceSettings, runs: Mapping[str, RunConfig]) -> Sequence[JudgedClaim]:
    """Judge the claims by the finished runs, write them, and return the verdicts."""
    from ...reports.claims import claims_text, judge, values_text
    from ...reports.papers import paper_named
    from ...reports.protocols import under
    from ...reports.runs import RunSet
    from ..protocol import protocol_named

    paper, finished = paper_named(settings.paper), {}
    for part in settings.parts:
        folders = [Path(config.out) for config in runs_of(part, runs).values()]
        folders = [folder for folder in folders if RunFolder(folder).rows.exists()]
        if folders:
            read = RunSet.read(folders)
            finished[part] = under(read, settings.paper, protocol_named(settings.paper))
    of_table = {t.table: ABLATION if t.table == ABLATION_TABLE else COMPARISON for t in paper.tables}
    verdicts = judge(paper, {table: finished[part] for table, part in of_table.items() if part in finished})
    parts = [f"# Claims of {paper.citation}", claims_text(verdicts), values_text(verdicts)]
    for part, read in finished.items():
        parts.append(f"{part}: subjects {', '.join(sorted(read.rows.subjects))}. {read.part}")
    text = "\n\n".join(parts)
    write_text(Path(settings.out) / f"{CLAIMS}.md", f"{text}\n")
    write_json(Path(settings.out) / f"{CLAIMS}.json", [verdict.record() for verdict in verdicts])
    return verdicts
