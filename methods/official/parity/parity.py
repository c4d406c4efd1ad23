"""Comparison of a native method with its authors' code: one capture, equal settings, the same image in each
iteration."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Literal

import tyro

from ....bench.condition import Condition, Named, label_of
from ....bench.configuration import build
from ....bench.contracts import Progress, no_progress
from ....bench.doctor import table as aligned
from ....bench.engine.config import RunConfig, parse_size, resolve_cells
from ....bench.engine.plan import check_settings
from ....bench.engine.run import run
from ....bench.engine.store import RunFolder
from ....bench.engine.stored import TRAINING_FILE
from ....bench.errors import InputError
from ....bench.executors.settings import ExecutionOptions, check_executor
from ....bench.io.documents import read_json
from ....bench.io.files import write_json, write_text
from ....bench.io.lock import locked
from ....bench.options import DependentOptions
from ....bench.progress import log_to_file
from ....bench.registry import get
from ....bench.rows import FULL, Rows
from ....bench.specs import CommandResult, command
from ...flashavatar.spec import FlashAvatarConfig
from ...rgbavatar.spec import RGBAvatarConfig
from ...shared.config import PAPER_ITERATIONS, SplatTraining

WITHOUT_PERCEPTUAL_LOSS = 15_000
"""Iterations up to which the authors' code of FlashAvatar has no perceptual loss, which the native method never has."""


@dataclass(frozen=True)
class ParitySettings(ExecutionOptions):
    """Trains both on one capture with the published settings for a run of this length and the same image in each iteration, and
    scores all renders by one implementation of the metrics. This is repeated with other orders of the images, since the order
    itself changes results by half a decibel. Writes parity.md, parity.json and the run. The same command continues a run that
    was killed. Exit code 1: the mean PSNR over orders differs by more than the tolerance, or a training failed.
    """

    method: tyro.conf.Positional[Literal["flashavatar", "ga", "gbs", "ours", "rgbavatar"]]
    """The native method. The authors' code of method ours is TensorialGaussianAvatar (`tga-official`)."""
    checkout: str
    """Folder of a checkout of the authors' repository; it is not changed."""
    out: str
    """Folder to write."""
    data: str | None = None
    """Capture to train on, of one subject or several. Default: a synthetic one is made in OUT/capture, of --subjects heads, SIZE, with
    --cameras and --timesteps."""
    head: str | None = None
    """Head model of captures that do not contain one: FLAME pickle or npz."""
    iterations: int = 1_000
    """Length of each training; with rgbavatar, steps of ten images."""
    orders: int = 5
    """Number of orders of the images, each with one training of either method. A single order on one capture gives no interval."""
    device: Literal["cuda", "cpu-shim"] = "cuda"
    """Device of the authors' code: CUDA, or headbench's CPU renderer instead of its rasteriser
    (docs/explanation/methods/official.md), which shows differences of training and head model, not of the rasterisers."""
    python: str = ""
    """Interpreter for the authors' code, as settings.ga-official.python of `headbench run`. Default with cpu-shim: this one."""
    commit: str | None = None
    """Expected commit; default: the one that the adapter was written for; "" accepts any."""
    frames: int | None = None
    """Held-out frames scored for each task, evenly spread; default: all."""
    tolerance: float = 0.3
    """Difference of PSNR, in decibels, within which the two count as equivalent; also the limit of the mean difference."""
    samples: int | None = None
    """Number of splats on the head. gbs: initial number, 5,000 by default; published: 50,000, whose differences for each expression
    take gigabytes. flashavatar: 13,500 by default, as published; others only on heads of another topology than FLAME's.
    rgbavatar: the same, 60,000 by default."""
    subjects: int = 2
    """Heads of the synthetic capture; both methods are trained on each with every order."""
    size: str = "96x136"
    """Width x height of the synthetic capture's images in pixels."""
    cameras: int = 8
    """Views of the synthetic capture, including the held-out one."""
    timesteps: int = 24
    """Timesteps of the synthetic capture."""
    dependent = (
        DependentOptions(("subjects", "size", "cameras", "timesteps"), "data", False),
        DependentOptions(("samples",), "method", ("flashavatar", "gbs", "rgbavatar")),
    )

    def __post_init__(self) -> None:
        """Raise ValueError for invalid settings."""
        parse_size(self.size)
        if self.method == "flashavatar" and self.iterations > WITHOUT_PERCEPTUAL_LOSS:
            raise ValueError(
                f"iterations must be at most {WITHOUT_PERCEPTUAL_LOSS} with flashavatar, as the native method has no perceptual loss"
            )
        if (
            min(self.iterations, self.orders, self.subjects) < 1
            or (self.samples is not None and self.samples < 10)
            or not self.tolerance > 0
        ):
            raise ValueError(
                "iterations, orders and subjects must be at least 1, samples 10, the tolerance above 0"
            )


OFFICIAL = {
    "flashavatar": "flashavatar-official",
    "ga": "ga-official",
    "gbs": "gbs-official",
    "ours": "tga-official",
    "rgbavatar": "rgbavatar-official",
}
SAMPLES = {"flashavatar": FlashAvatarConfig().samples, "gbs": 5_000, "rgbavatar": RGBAvatarConfig().samples}
"""Default numbers of splats."""
METRICS = {"psnr": "dB", "ssim": ""}
TASKS = ("novel_view", "self_reenactment")
CONFIDENCE = 0.95
_VERTICES = re.compile(rb"element vertex (\d+)")

_ON_TEXELS: dict[str, tuple[Condition, ...]] = {
    "flashavatar": (Condition("as-tracked", as_tracked=True),),
    "rgbavatar": (Condition("as-tracked", as_tracked=True, clip=Named("packed-chart")),),
}
"""Both get the capture's head model and views, for rgbavatar with a chart if it has none. Their poses have no rotation of the neck
(`rigid-head`), which the official code does not have."""
RGBAVATAR_VALUES = (
    *("use_pose_weight=False", "num_basis_in=100"),
    *("random_bg_color=False", "bg_color=[1.0, 1.0, 1.0]"),
)
"""Entries of the official configuration of rgbavatar: weights depend on the expression alone, since the motion of the head would include
that of the camera, and the background is white."""
CAUSES = {
    "flashavatar": (
        "rounding: a difference in the last digit changes the PSNR of a training",
        "near plane: 0.2 m in the official code, 0.01 m in the native method",
    ),
    "ga": (
        "random numbers besides the order: positions of the children of split splats, initial colours",
        "near plane: 0.2 m in the official code, 0.01 m in the native method",
    ),
    "gbs": (
        "random numbers besides the order: initial positions of splats, positions of the children of split splats",
        "skinning weights: from a grid in the official code once splats have moved or split, those of the surface point in the native method",
        "the official code stores differences for every splat and expression, also where the mask is 0; the native method does not",
        "near plane: 0.2 m in the official code, 0.01 m in the native method",
    ),
    "ours": (
        "random numbers besides the order: initial values of planes, lines and networks, children of split splats",
        "near plane: 0.2 m in the official code, 0.01 m in the native method",
    ),
    "rgbavatar": (
        "random numbers besides the order: the initial network, which has 100 inputs in the official code",
        "near plane: 0.2 m in the official code, 0.01 m in the native method",
    ),
}
"""Reasons for differences at equal settings and order, by native method; the avatar's record adds the changes of its
adapter."""


OPTIONS = ("checkout", "python", "commit", "device")
"""Settings of the official method that are options of the command, by their names."""


@dataclass(frozen=True)
class Difference:
    """Difference of one metric in one task, official minus native, over orders."""

    task: str
    metric: str

    pairs: tuple[tuple[str, int], ...]
    """Subjects and orders for which both methods have complete results."""
    native: tuple[float, ...]
    official: tuple[float, ...]
    """Mean over frames, then sequences, for each pair."""
    difference: float

    half_width: float | None
    """Half width of its 95 % interval (Student's t over pairs); None with a single pair."""

    def equivalence_p(self, margin: float) -> float | None:
        """P-value of two one-sided t-tests over pairs against differences of the margin and beyond; None with a single pair.

        D. Schuirmann, Journal of Pharmacokinetics and Biopharmaceutics 15, 1987. It is at most 5 % where the 90 % interval lies within
        the margin. Orders on one capture are treated as independent of each other.
        """
        from scipy.stats import t as student_t

        differences = [b - a for a, b in zip(self.native, self.official, strict=True)]
        if len(differences) < 2:
            return None
        error = stdev(differences) / math.sqrt(len(differences))
        distance = margin - abs(self.difference)
        if error == 0.0:
            return 0.0 if distance > 0 else 1.0
        return float(student_t.sf(distance / error, len(differences) - 1))


@command("run parity", group="compare", writes="out", kinds=("captures",))
def compare(settings: ParitySettings, progress: Progress = no_progress) -> CommandResult:
    """Compare a method with its authors' code on one capture at equal settings."""
    out = Path(settings.out)
    config = run_config(settings, out)
    check_executor(settings.execution, config.device)
    try:
        methods = resolve_cells(config)
        check_settings(methods)
    except InputError as error:
        raise _with_options(error, OFFICIAL[settings.method]) from error
    native, official = (method.spec.name for method, _ in methods)
    condition = methods[0][1].name
    with log_to_file(out / "parity.log"):
        if settings.data is None:
            _make_capture(settings, out, progress)
        rows = run(config, settings.execution).rows
    differences = differences_of(rows, native, official, config.seeds, condition)
    run_folder = RunFolder(Path(config.out))
    cells = {
        name: _cells(run_folder, rows, label_of(name, condition), config.seeds) for name in (native, official)
    }
    changed = sorted({line for cell in cells[official] for line in cell["differences"]})
    causes = [*CAUSES[settings.method], *changed]
    parts = (settings, native, official, differences, cells, causes, rows)
    write_text(out / "parity.md", _text(*parts, markdown=True))
    text = _text(*parts, markdown=False)
    data = {
        "native": native,
        "official": official,
        "iterations": settings.iterations,
        "settings": {name: config.settings[name] for name in config.methods},
        "differences": [
            asdict(each)
            | ({"equivalence_p": each.equivalence_p(settings.tolerance)} if each.metric == "psnr" else {})
            for each in differences
        ],
        "avatars": cells,
        "causes": causes,
        "run": "run",
    }
    write_json(out / "parity.json", data)
    too_far = any(d.metric == "psnr" and abs(d.difference) > settings.tolerance for d in differences)
    return CommandResult(text, data, bool(differences) and not too_far and not rows.failed)


def _with_options(error: InputError, official: str) -> InputError:
    """The error, naming options of this command instead of settings of a run."""
    place = f"settings.{official}"
    names = re.compile(rf"(?:--set )?{re.escape(place)}\.({'|'.join(OPTIONS)})\b")
    file, key, *texts = (
        names.sub(r"--\1", text)
        for text in (error.file, error.key, error.expected, error.found, error.remedy)
    )
    if file == place and key in OPTIONS:
        file, key = "command line", f"--{key}"
    return InputError(file, key, *texts)


def run_config(settings: ParitySettings, out: Path) -> RunConfig:
    """The comparison, with settings that make both methods equivalent."""
    official = OFFICIAL[settings.method]
    of_theirs: dict[str, Any] = {
        "checkout": settings.checkout,
        "python": settings.python,
        "device": settings.device,
        "order": "native",
    }
    if settings.commit is not None:
        of_theirs["commit"] = settings.commit
    samples = settings.samples or SAMPLES.get(settings.method, 0)
    if settings.method == "gbs":
        of_theirs["arguments"] = ("--init_face_point_number", str(samples))
    if settings.method == "flashavatar":
        of_theirs |= {"samples": samples, "masks": "native", "start": "native"}
    if settings.method == "rgbavatar":
        of_theirs |= {"samples": samples, "motion": "root", "values": RGBAVATAR_VALUES}
    of_both = {"budget": {"iterations": settings.iterations}}
    values: dict[str, Any] = {
        "data": settings.data or str(_capture(out)),
        "out": str(out / "run"),
        "methods": (settings.method, official),
        "preset": "paper",
        "seeds": tuple(range(settings.orders)),
        "tasks": TASKS,
        "metrics": tuple(METRICS),
        "regions": (),
        "frames_per_task": settings.frames,
        "device": "cuda" if settings.device == "cuda" else "cpu",
        "reader_settings": {} if settings.head is None else {"head": settings.head},
        "settings": {
            settings.method: {**of_both, **as_theirs(settings.method, settings.iterations, samples)},
            official: {**of_both, **of_theirs},
        },
    }
    if settings.method in _ON_TEXELS:
        values |= {"clip": Named("rigid-head"), "conditions": _ON_TEXELS[settings.method]}
    return build(RunConfig, values, "parity")


def as_theirs(native: str, iterations: int, samples: int) -> dict[str, Any]:
    """Settings that make a native run of any length equivalent to the run of the authors' program.

    ``samples`` is the initial number of splats of gbs, and that of flashavatar and rgbavatar. The authors' program raises
    the harmonics' degree every 1,000 iterations regardless of the length (flashavatar: 500), removes large splats from the
    first regular reset of opacities, has lines in the whole head (method "ours"), and here uses all images equally often.
    """
    if native == "rgbavatar":
        variants = {"frame_variant": "official", "color_init_variant": "official"}
        return {"samples": samples, "inputs": ("expression",), "random_background": False, **variants}
    if native == "flashavatar":
        return {"min_sh_every": FlashAvatarConfig().sh_every, "samples": samples}
    if native == "gbs":
        errors = {"correctives_variant": "official", "lower_teeth_variant": "official"}
        return {"min_sh_every": 1_000, "samples": samples, "teeth_samples": samples // 10, **errors}
    from ...shared.schedule import DensifySchedule, Timeline

    timeline = Timeline(iterations, PAPER_ITERATIONS)
    schedule = DensifySchedule.of(SplatTraining(), timeline, white=True)
    assert schedule.reset_every is not None
    moment = math.ceil(schedule.reset_every * PAPER_ITERATIONS / iterations)
    settings: dict[str, Any] = {"splats": {"prune_extent_from": moment}}
    if native == "ga":
        return {**settings, "min_sh_every": 1_000}
    return {**settings, "sampling": {"balanced": False}, "lines": {"bounds": "head"}}


def differences_of(
    rows: Rows, native: str, official: str, orders: Sequence[int], condition: str = ""
) -> list[Difference]:
    """Differences by task and metric, over the subjects and orders for which both have values under a condition."""
    results = []
    for task in TASKS:
        for metric in METRICS:
            of_native, of_official = (
                _means(rows, name, task, metric, condition) for name in (native, official)
            )
            both = sorted(pair for pair in of_native.keys() & of_official.keys() if pair[1] in orders)
            if not both:
                continue
            differences = [of_official[pair] - of_native[pair] for pair in both]
            ours, theirs = (tuple(of[pair] for pair in both) for of in (of_native, of_official))
            mean, half_width = fmean(differences), _half_width(differences)
            results.append(Difference(task, metric, tuple(both), ours, theirs, mean, half_width))
    return results


def _means(rows: Rows, method: str, task: str, metric: str, condition: str) -> dict[tuple[str, int], float]:
    """Mean over frames, then sequences, by subject and order."""
    asked = {"method": method, "metric": metric, "task": task, "region": FULL, "condition": condition}
    table = rows.select(**asked, seeds=rows.seeds(method))
    by = ["subject", "seed"]
    whole = table.groupby(by)["status"].transform(lambda status: set(status) == {"ok"})
    means = table[whole.astype(bool)].groupby([*by, "sequence"])["value"].mean().groupby(by).mean()
    return {
        (str(pair[0]), int(pair[1])): float(value) for pair, value in zip(means.index, means, strict=True)
    }


def _half_width(values: Sequence[float]) -> float | None:
    if len(values) < 2:
        return None
    from scipy.stats import t as student_t

    quantile = float(student_t.ppf(0.5 + CONFIDENCE / 2, len(values) - 1))
    return quantile * stdev(values) / math.sqrt(len(values))


def _capture(out: Path) -> Path:
    return out / "capture"


def _make_capture(settings: ParitySettings, out: Path, progress: Progress) -> None:
    from ....datasets.synthetic.capture import synthesize

    size = parse_size(settings.size)
    with locked(_capture(out), beside=True):
        synthesize(
            _capture(out),
            subjects=settings.subjects,
            cameras=settings.cameras,
            timesteps=settings.timesteps,
            size=size,
            performance="full",  # that of the published figures of parity
            progress=progress,
        )


def _cells(run_folder: RunFolder, rows: Rows, method: str, orders: Sequence[int]) -> list[dict[str, Any]]:
    """Splats and changes of every avatar of a method."""
    cells = []
    for subject in sorted(rows.subjects):
        for order in orders:
            folder = run_folder.cell(subject, method, order).avatar
            path = folder / TRAINING_FILE
            record = read_json(path) if path.exists() else {}
            entry = {"subject": subject, "order": order, "splats": record.get("splats") or _splats(folder)}
            cells.append({**entry, "differences": record.get("differences", [])})
    return cells


def _splats(folder: Path) -> int | None:
    """Number of splats in an avatar's PLY file, or from FlashAvatar's log; None without both."""
    from ..flashavatar.method import SPLATS
    from ..method import TRAINING_LOG
    from ..rgbavatar.method import PLY_FILE

    plys, log = [folder / name for name in ("point_cloud.ply", PLY_FILE)], folder / TRAINING_LOG
    path = next((ply for ply in plys if ply.is_file()), None)
    if path is None:
        told = SPLATS.search(log.read_text(errors="replace")) if log.is_file() else None
        return None if told is None else int(told[1])
    with path.open("rb") as stream:
        match = _VERTICES.search(stream.read(4096))
    return None if match is None else int(match[1])


def _text(
    settings: ParitySettings,
    native: str,
    official: str,
    differences: Sequence[Difference],
    cells: Mapping[str, Sequence[Mapping[str, Any]]],
    causes: Sequence[str],
    rows: Rows,
    *,
    markdown: bool,
) -> str:
    lines = [
        f"{'# ' if markdown else ''}{native} and {official}, {settings.iterations:,} iterations each",
        "",
        (
            "Equal settings and the same image in each iteration; both methods are trained once for each subject and order of the images. "
            "Means over frames, then sequences; the difference is official minus native, with its 95 % interval over subjects and orders."
        ),
        "",
        _table(differences, native, official, markdown=markdown),
        *_equivalence(differences, settings.tolerance),
    ]
    counts = {name: ", ".join(str(cell["splats"] or "?") for cell in of) for name, of in cells.items()}
    splats = "; ".join(f"{name}: {count}" for name, count in counts.items())
    lines += ["", f"Splats by subject and order: {splats}.", "", "Known causes of differences:", ""]
    lines += [f"- {cause}" for cause in causes]
    if rows.failed:
        lines += ["", f"Failed: {', '.join(rows.failed)}; see run/tables/comparison.md for the reasons."]
    return "\n".join(lines) + "\n"


def _equivalence(differences: Sequence[Difference], margin: float) -> list[str]:
    """A line for each task: whether its PSNR is equivalent."""
    lines = []
    for each in differences:
        p = each.equivalence_p(margin) if each.metric == "psnr" else None
        if p is not None:
            small = f"p = {p:.4f}" if p >= 0.0001 else "p < 0.0001"
            verdict = "equivalent" if p <= 1 - CONFIDENCE else "equivalence not shown"
            task = each.task.replace("_", " ")
            lines += [
                "",
                f"PSNR of {task}: {verdict} within {margin:g} dB over the orders of these captures (two one-sided t-tests, {small}).",
            ]
    return lines


def _table(differences: Sequence[Difference], native: str, official: str, *, markdown: bool) -> str:
    """Both values and their difference, for every order and over all: a pipe table, or aligned columns for a terminal."""
    titles = {name: get("metrics", name).label for name in METRICS}
    rows: list[dict[str, str]] = []
    for each in differences:
        digits = 2 if each.metric == "psnr" else 4
        width = "" if each.half_width is None else f" ± {each.half_width:.{digits}f}"
        mean = (("all", "all"), fmean(each.native), fmean(each.official), each.difference, width)
        of_pairs = zip(each.pairs, each.native, each.official, strict=True)
        every = [*((pair, a, b, b - a, "") for pair, a, b in of_pairs), mean]
        for (subject, order), a, b, difference, interval in every:
            where = {"task": each.task.replace("_", " "), "metric": titles[each.metric]}
            where |= {"subject": str(subject), "order": str(order)}
            values = {native: f"{a:.{digits}f}", official: f"{b:.{digits}f}"}
            text = f"{difference:+.{digits}f}{interval}"
            text = f"**{text}**" if markdown and order == "all" else text
            rows.append({**where, **values, "difference": text})
    if not markdown:
        return aligned(rows)
    names = ["task", "metric", "subject", "order", native, official, "difference"]
    lines = [names, [":---"] * 2 + ["---:"] * 5, *([*row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
