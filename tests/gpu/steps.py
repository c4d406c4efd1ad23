"""The steps of ``make gpu``: what is compared, and the bounds. On the device "cpu" sizes are small."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from headbench.bench import cli
from headbench.bench.benchmarks import take_turns
from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.job import Job
from headbench.bench.engine.jobs import load, trained
from headbench.bench.machine import use_device
from headbench.bench.registry import discover
from headbench.bench.rows import ALL, Rows
from headbench.methods.benchmarks.scenes import SplatScene, head_shell, relative_error
from headbench.methods.shared.loop import CHECKPOINT, synchroniser
from headbench.methods.splats import cuda, rasterize
from headbench.metrics.speed import SpeedProtocol, measure_speed
from headbench.tests.world import small_run

ROOT = Path(__file__).parents[2]
ITERATIONS = 6


@dataclass(frozen=True)
class Bar:
    """A number that was found, None where there is none, and its bound: the largest that holds, or the ``least``."""

    what: str
    found: float | None
    bound: float | None = None
    least: bool = False

    @property
    def holds(self) -> bool:
        """Whether the bound is kept; true of a number without one."""
        if self.bound is None:
            return True
        if self.found is None or np.isnan(self.found):
            return False
        return self.found >= self.bound if self.least else self.found <= self.bound

    def cells(self) -> dict[str, str]:
        """What the table shows."""
        bound = "" if self.bound is None else f"{'>=' if self.least else '<='} {self.bound:g}"
        verdict = "" if self.bound is None else "pass" if self.holds else "FAIL"
        found = "none" if self.found is None else f"{self.found:.4g}"
        return {"what": self.what, "bound": bound, "found": found, "verdict": verdict}


def rasteriser(device: str, folder: Path) -> list[Bar]:
    """Images and gradients of the rasteriser against the float64 reference on the CPU."""
    size = (3_000, 120, 100) if device != "cpu" else (200, 40, 32)
    scenes = {"head": (head_shell(*size), False), "antialiased": (head_shell(*size, seed=1), True)}
    scenes["7 channels"] = head_shell(*size, channels=7), False
    bars = []
    for name, (scene, antialiased) in scenes.items():
        image, gradients = _passes(scene, device, torch.float32, "auto", antialiased)
        truth, wanted = _passes(scene, "cpu", torch.float64, "reference", antialiased)
        worst = max(relative_error(value, true) for value, true in zip(gradients, wanted, strict=True))
        bars += [
            Bar(f"rasteriser, {name}: image, mean difference", float((image - truth).abs().mean()), 1e-5),
            Bar(f"rasteriser, {name}: worst gradient, relative", worst, 5e-3),
        ]
    return bars


def _passes(
    scene: SplatScene, device: str, dtype: torch.dtype, backend: str, antialiased: bool
) -> tuple[Tensor, list[Tensor]]:
    """Image, and gradients of a fixed linear function of it, on the CPU."""
    scene = scene._replace(opacities=scene.opacities.clamp(max=0.98))  # whatever this gsplat clamps alpha at
    leaves = [value.detach().to(device, dtype, copy=True).requires_grad_() for value in scene[:6]]
    leaves.append(torch.zeros(len(scene.means), 2, device=device, dtype=dtype, requires_grad=True))
    image = rasterize(
        *leaves[:6],
        *(scene.K, scene.width, scene.height),
        background=scene.background,
        backend=backend,
        antialiased=antialiased,
        means2d_offset=leaves[6],
    ).image
    upstream = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    image.backward(upstream.to(device, dtype))
    return image.detach().cpu().double(), [leaf.grad.cpu() for leaf in leaves if leaf.grad is not None]


def methods(device: str, folder: Path) -> list[Bar]:
    """Every native method after a few iterations on both sides, and killed and continued on the device."""
    bars = []
    for job in _jobs(device, folder):
        name = job.method.spec.name
        on_cpu = _picture(job, _fitted(job, folder / name / "cpu", "cpu"))
        on_device = _picture(job, _fitted(job, folder / name / "device", device))
        continued, first = _continued(job, folder / name / "killed", device)
        bars += [
            Bar(
                f"{name}: image after {ITERATIONS} iterations, mean difference",
                _mean(on_device, on_cpu),
                1e-3,
            ),
            Bar(f"{name}: first iteration after a kill", first, 2, least=True),
            Bar(f"{name}: image of the continued run, mean difference", _mean(continued, on_device), 1e-3),
        ]
    return bars


def _jobs(device: str, folder: Path) -> list[Job]:
    """The native methods that compute on the device, each trained a little on a tiny capture, on the CPU."""
    shutil.rmtree(folder, ignore_errors=True)
    specs = [plugin.spec for plugin in discover("methods").values() if plugin.spec]
    names = [spec.name for spec in specs if spec.native and not spec.trivial and spec.computes_on(device)]
    run = small_run(folder, *names)
    return trained(run.root, (), RunOptions(), folder / "kept")[1]


def _fitted(job: Job, out: Path, device: str, progress: Any = no_progress) -> Any:
    method = job.method.create()
    config = method.config
    if hasattr(config, "splats"):
        method.config = replace(config, splats=replace(config.splats, checkpoint_every_s=0.0))
    else:
        method.config = replace(config, checkpoint_every_s=0.0)
    return method.fit(job.form.clip, out, Budget(ITERATIONS), device=device, seed=0, progress=progress)


class _Killed(Exception):
    pass


def _continued(job: Job, out: Path, device: str) -> tuple[np.ndarray, int]:
    """A picture of an avatar whose training was killed half way, and the iteration that it continued with."""

    def kill(done: int, total: int, note: str = "") -> None:
        if done == ITERATIONS // 2 and any(out.rglob(CHECKPOINT)):
            raise _Killed

    try:
        _fitted(job, out, device, kill)
    except _Killed:
        pass
    seen: list[int] = []
    avatar = _fitted(job, out, device, lambda done, total, note="": seen.append(done))
    return _picture(job, avatar), next(
        (done for done in seen if done), 0
    )  # 0 is reported while sizes are planned


def _picture(job: Job, avatar: Any) -> np.ndarray:
    form, key = job.form, min(job.clip.splits["novel_view"])
    seen = form.key(key)
    return np.asarray(avatar.render(form.clip.cameras[seen.camera], form.clip.poses[seen.timestep]).rgb)


def _mean(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(np.float64) - other).mean())


def speed(device: str, folder: Path) -> list[Bar]:
    """The rasteriser against gsplat's own function, and the stages of a frame of every avatar."""
    large = device != "cpu"
    scene = head_shell(*((60_000, 550, 802) if large else (200, 40, 32)))
    ours, bare = _timed(scene, device)
    runs = {"ours": ours, "bare": bare}
    seconds = take_turns(runs, 500 if large else 2)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    what = "both passes of the rasteriser" + (", 60,000 splats at 550x802" if large else "")
    bars = [
        Bar(f"{what}: ms", 1e3 * medians["ours"]),
        Bar(f"{what}: time over that of bare gsplat", medians["ours"] / medians["bare"], 1.05),
    ]
    short = SpeedProtocol(warm_up=2, warm_up_limit=2, latency=2, throughput=2, stages=2, static=2)
    for job in _jobs(device, folder):
        avatar = load(replace(job, device=device))
        clip = job.form.clip
        cameras = [c.resized(550, 802) if large else c for _, c in sorted(clip.cameras.items())]
        frames = zip(cycle(cameras), cycle(clip.poses.values()))
        details = measure_speed(
            avatar, list(islice(frames, len(cameras))), SpeedProtocol() if large else short
        ).details
        name = f"{job.method.spec.name}, tiny avatar" + (" at 550x802" if large else "")
        shown = {key: value for key, value in details.items() if key in SHOWN}
        bars += [Bar(f"{name}: {key}", value) for key, value in shown.items()]
    return bars


SHOWN = (
    *("p50_ms", "p99_ms", "throughput_fps"),
    *("drive_ms", "deform_ms", "rasterize_ms", "post_ms", "read_back_ms"),
)


def _timed(scene: SplatScene, device: str) -> tuple[Callable[[], None], Callable[[], None]]:
    """Both passes of our function and of gsplat's; on the CPU, which has no gsplat, ours twice."""
    use_device(device)
    wait = synchroniser(device)
    leaves = [value.to(device).clone().requires_grad_() for value in scene[:5]]
    viewmat, K, background = (value.to(device) for value in (scene.viewmat, scene.K, scene.background))
    upstream = torch.randn(scene.height, scene.width, 3, device=device)

    def ours() -> None:
        view = viewmat, K, scene.width, scene.height
        rasterize(*leaves, *view, background=background, check_values=False).image.backward(upstream)
        wait()

    def bare() -> None:
        view = viewmat[None], K[None], scene.width, scene.height
        image, _, _ = cuda.load().rasterization(*leaves, *view, packed=False, backgrounds=background[None])
        image[0].backward(upstream)
        wait()

    return ours, ours if device == "cpu" else bare


def demo(device: str, folder: Path) -> list[Bar]:
    """PSNR of the demonstration on the device against the CPU's table; continues where it was ended."""
    small = ["--preset", "smoke", "--set", "methods=ga"] if device == "cpu" else []
    metrics = ["psnr", *(TIMES if device != "cpu" else TIMES[:1])]
    given = ["--set", f"device={device}", "--set", f"metrics={','.join(metrics)}", *small]
    code = cli.main(["demo", "--out", str(folder), *given])
    if code:
        raise RuntimeError(f"headbench demo ended with exit code {code}")
    rows = Rows.read(folder / "rows.parquet")
    found = dict(_means(rows))
    # The stored demo, whose table the README has; at small sizes there is none, and this one is compared with itself.
    stored = found if device == "cpu" else dict(_means(Rows.read(ROOT / "reports/gallery/rows.parquet")))
    bars = [
        Bar(f"demo, {method}, {task}: dB from the CPU's table", abs(value - stored[method, task]), 0.3)
        for (method, task), value in found.items()
    ]
    timed = rows.select(method=ALL, metric=ALL, task="", region="full", seeds=ALL)
    for row in timed[timed["metric"].isin(TIMES) & (timed["status"] == "ok")].itertuples():
        bars.append(Bar(f"demo, {row.method}: {row.metric}", float(row.value)))
    return bars


TIMES = (
    *("fps", "throughput", "latency_p50", "latency_p99"),
    *("stage_drive", "stage_deform", "stage_rasterize", "stage_post", "stage_read_back"),
)
"""Metrics of speed: what the stages of a frame take, of avatars of the demonstration's size."""


def _means(rows: Rows) -> Iterator[tuple[tuple[str, str], float]]:
    """PSNR of each trained method and task, dB: means over frames, then sequences."""
    chosen = rows.select(method=ALL, metric="psnr", task=ALL, region="full", seeds=ALL)
    trivial = [name for name, plugin in discover("methods").items() if plugin.spec and plugin.spec.trivial]
    for (method, task), part in chosen[~chosen["method"].isin(trivial)].groupby(["method", "task"]):
        yield (str(method), str(task)), float(part.groupby("sequence")["value"].mean().mean())


STEPS: dict[int, Callable[[str, Path], Sequence[Bar]]] = {1: rasteriser, 2: methods, 3: speed, 4: demo}
