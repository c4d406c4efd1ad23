"""The steps of ``make gpu``: what is compared, and the bounds. On the device "cpu" sizes are small."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from headbench.bench.configuration import build
from headbench.bench.contracts import Budget, no_progress
from headbench.bench.doctor import take_turns
from headbench.bench.machine import use_device
from headbench.bench.registry import discover, resolve
from headbench.bench.specs import MethodSpec
from headbench.methods.benchmarks.splats import SplatScene, head_shell, relative_error
from headbench.methods.benchmarks.training import MemoryClip, untrained, with_images
from headbench.methods.shared.loop import CHECKPOINT, synchroniser
from headbench.methods.splats import cuda, rasterize
from headbench.metrics.speed import SpeedProtocol, measure_speed

from ..methods.flashavatar.small import SMALL as SMALL_FLASHAVATAR
from ..methods.gha.small import SMALL as SMALL_GHA
from ..methods.insta.small import SMALL as SMALL_INSTA
from ..methods.rgbavatar.small import SMALL as SMALL_RGBAVATAR

ITERATIONS = 6
SMALL = {
    "flashavatar": SMALL_FLASHAVATAR,
    "gbs": {"samples": 200, "teeth_samples": 20},
    "gha": {**SMALL_GHA, "start_steps": 2, "motion_steps": 2},
    "insta": SMALL_INSTA,
    "rgbavatar": SMALL_RGBAVATAR,
}
"""Small forms of the methods that are slow at the preset smoke."""


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


Report = Callable[[Bar], None]
"""Takes a number as soon as it is found, so that nothing is lost where a step is ended."""


def rasteriser(device: str, folder: Path, report: Report) -> None:
    """Images and gradients of the rasteriser against the float64 reference on the CPU."""
    size = (3_000, 120, 100) if device != "cpu" else (200, 40, 32)
    scenes = {"head": (head_shell(*size), False), "antialiased": (head_shell(*size, seed=1), True)}
    scenes["7 channels"] = head_shell(*size, channels=7), False
    for name, (scene, antialiased) in scenes.items():
        image, gradients = _passes(scene, device, torch.float32, "auto", antialiased)
        truth, wanted = _passes(scene, "cpu", torch.float64, "reference", antialiased)
        worst = max(relative_error(value, true) for value, true in zip(gradients, wanted, strict=True))
        report(Bar(f"rasteriser, {name}: image, mean difference", float((image - truth).abs().mean()), 1e-5))
        report(Bar(f"rasteriser, {name}: worst gradient, relative", worst, 5e-3))


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


def methods(device: str, folder: Path, report: Report) -> None:
    """Every native method after a few iterations on both sides, and killed and continued on the device."""
    shutil.rmtree(folder, ignore_errors=True)
    clip = with_images(*untrained(2_000, 48, 64, cameras=3, timesteps=3))
    for plugin in discover("methods").values():
        spec = plugin.spec
        if not spec or not spec.native or spec.trivial or not spec.computes_on(device):
            continue
        home = folder / spec.name
        try:
            on_cpu = _picture(clip, _fitted(spec, clip, home / "cpu", "cpu"))
            on_device = _picture(clip, _fitted(spec, clip, home / "device", device))
            report(
                Bar(
                    f"{spec.name}: image after {ITERATIONS} iterations, mean difference",
                    _mean(on_device, on_cpu),
                    1e-3,
                )
            )
            continued, first = _continued(spec, clip, home / "killed", device)
            report(Bar(f"{spec.name}: first iteration after a kill", first, 2, least=True))
            report(
                Bar(
                    f"{spec.name}: image of the continued run, mean difference",
                    _mean(continued, on_device),
                    1e-3,
                )
            )
        except ModuleNotFoundError as error:  # flashavatar wants OpenCV, too large to take along
            report(Bar(f"{spec.name}: not run: {error}", None))
        except Exception as error:  # noqa: BLE001 - other methods are still to be tried
            report(Bar(f"{spec.name}: ended by {type(error).__name__}: {str(error)[:200]}", None, 0.0))


def _created(spec: MethodSpec, preset: str, changes: Mapping[str, Any]) -> Any:
    """The method with the settings of a preset, and some others."""
    chosen = {**spec.presets.get(preset, {}), **changes}
    chosen.pop("budget", None)
    config = build(resolve(spec.config), chosen, preset)
    if hasattr(config, "splats"):
        config = replace(config, splats=replace(config.splats, checkpoint_every_s=0.0))
    else:
        config = replace(config, checkpoint_every_s=0.0)
    return resolve(spec.implementation)(config)


def _fitted(spec: MethodSpec, clip: MemoryClip, out: Path, device: str, progress: Any = no_progress) -> Any:
    budget = Budget(ITERATIONS)
    return _created(spec, "smoke", SMALL.get(spec.name, {})).fit(
        clip, out, budget, device=device, seed=0, progress=progress
    )


class _Killed(Exception):
    pass


def _continued(spec: MethodSpec, clip: MemoryClip, out: Path, device: str) -> tuple[np.ndarray, int]:
    """A picture of an avatar whose training was killed half way, and the iteration that it continued with."""

    def kill(done: int, total: int, note: str = "") -> None:
        if done == ITERATIONS // 2 and any(out.rglob(CHECKPOINT)):
            raise _Killed

    try:
        _fitted(spec, clip, out, device, kill)
    except _Killed:
        pass
    seen: list[int] = []
    avatar = _fitted(spec, clip, out, device, lambda done, total, note="": seen.append(done))
    return _picture(clip, avatar), next(
        (done for done in seen if done), 0
    )  # 0 is reported while sizes are planned


def _picture(clip: MemoryClip, avatar: Any) -> np.ndarray:
    key = clip.splits["train"][-1]
    return np.asarray(avatar.render(clip.cameras[key.camera], clip.poses[key.timestep]).rgb)


def _mean(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one.astype(np.float64) - other).mean())


def speed(device: str, folder: Path, report: Report) -> None:
    """The rasteriser against gsplat's own function; iterations and frames a second of ga and ours."""
    shutil.rmtree(folder, ignore_errors=True)  # a finished training would not be repeated
    large = device != "cpu"
    count, width, height = (60_000, 550, 802) if large else (2_000, 40, 32)
    what = f"{count:,} splats at {width}x{height}"
    scene = head_shell(count, width, height)
    ours, bare = _timed(scene, device)
    seconds = take_turns({"ours": ours, "bare": bare}, 200 if large else 2)
    medians = {name: float(np.median(values)) for name, values in seconds.items()}
    report(Bar(f"both passes of the rasteriser, {what}: ms", 1e3 * medians["ours"]))
    if large:
        report(Bar("rasteriser: time over that of bare gsplat", medians["ours"] / medians["bare"], 1.05))
    # Training at the preset demo, of at most 20,000 splats: ga starts with one a triangle.
    clip = with_images(*untrained(count, width, height, cameras=2, timesteps=4))
    for name in ("ga", "ours"):
        spec = discover("methods")[name].spec
        avatar, rate = _rate(spec, clip, folder / name, device, 400 if large else 20)
        report(Bar(f"{name} at {width}x{height}: iterations a second", rate))
        frames = [(camera, pose) for pose in clip.poses.values() for camera in clip.cameras.values()]
        short = SpeedProtocol(warm_up=2, warm_up_limit=2, latency=2, throughput=2, stages=2, static=2)
        details = measure_speed(avatar, frames, SpeedProtocol() if large else short).details
        for key, value in details.items():
            if key in SHOWN:
                report(Bar(f"{name} at {width}x{height}: {key}", value))


def _rate(spec: MethodSpec, clip: MemoryClip, out: Path, device: str, iterations: int) -> tuple[Any, float]:
    """An avatar and the iterations a second of the second half of its training."""
    wait, times = synchroniser(device), {}

    def note(done: int, total: int, text: str = "") -> None:
        wait()
        times[done] = time.perf_counter()

    method = _created(spec, "demo", {})
    avatar = method.fit(clip, out, Budget(iterations), device=device, seed=0, progress=note)
    later = {done: at for done, at in times.items() if done >= iterations // 2}
    first, last = min(later), max(later)
    return avatar, (last - first) / (later[last] - later[first]) if last > first else math.nan


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


STEPS: dict[int, Callable[[str, Path, Report], None]] = {1: rasteriser, 2: methods, 3: speed}
LIMITS_S = {1: 180, 2: 110, 3: 100}
"""What each may take; the first compiles gsplat's kernels."""
