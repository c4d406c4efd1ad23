"""``headbench bench metrics``: our image metrics beside what the usual libraries take for the same number."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from ...bench.contracts import ByteArray, Progress, no_progress
from ...bench.errors import UnavailableError, install_extra
from ...bench.specs import Findings
from ...metrics.lpips_network import ALEX, Lpips, find_backbone, load_backbone
from ...metrics.psnr import psnr
from ...metrics.ssim import Ssim, ssim, ssim_map, ssim_reflected
from .timing import take_turns, torch_threads

Ways = Mapping[str, Callable[[], float]]
Pairs = list[tuple[ByteArray, ByteArray]]


def structural_ways(pairs: Pairs, pool: ThreadPoolExecutor) -> dict[str, Ways]:
    """PSNR and SSIM of every pair, by form of the SSIM; each way returns the sum of both over all pairs."""

    def ours(form: Ssim) -> Callable[[], float]:
        def score(pair: tuple[ByteArray, ByteArray]) -> float:
            return psnr(*pair) + form(*pair)

        return lambda: sum(pool.map(score, pairs))

    def skimage() -> float:
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        return sum(
            peak_signal_noise_ratio(y, x, data_range=255)
            + structural_similarity(x, y, channel_axis=2, data_range=255, **options)
            for x, y in pairs
        )

    def torchmetrics() -> float:
        functional = importlib.import_module("torchmetrics.functional.image")
        total = 0.0
        for pair in pairs:
            x, y = (torch.from_numpy(a).permute(2, 0, 1)[None].float() / 255 for a in pair)
            total += float(functional.peak_signal_noise_ratio(x, y, data_range=1.0))
            total += float(functional.structural_similarity_index_measure(x, y, data_range=1.0))
        return total

    def reference() -> float:
        return sum(psnr(x, y) + float(ssim_map(x, y).mean()) for x, y in pairs)

    return {
        "PSNR + SSIM, valid windows": {
            "headbench": ours(ssim),
            "headbench, numpy and OpenCV": reference,
            "scikit-image": skimage,
        },
        "PSNR + SSIM, reflected border": {"headbench": ours(ssim_reflected), "torchmetrics": torchmetrics},
    }


def lpips_ways(pairs: Pairs) -> Ways:
    """LPIPS (AlexNet) of every pair, summed. Raises `UnavailableError` without weights."""
    spec = ALEX
    weights = find_backbone(spec)
    fresh, cached = Lpips(weights=weights, cache_mb=0), Lpips(weights=weights, cache_mb=1e4)
    sum(cached.batched(pairs))  # another method's turn: the ground truth is known from then on
    ways: dict[str, Callable[[], float]] = {
        "headbench, first method": lambda: sum(fresh.batched(pairs)),
        "headbench, further methods": lambda: sum(cached.batched(pairs)),
    }
    try:
        package = importlib.import_module("lpips").LPIPS(net="alex", pnet_rand=True, verbose=False)
    except ImportError:
        return ways
    state = load_backbone(spec, weights)
    own = package.net.state_dict()
    package.net.load_state_dict({key: state["features." + key.split(".", 1)[1]] for key in own})

    def theirs() -> float:
        with torch.no_grad():
            stacks = [
                [torch.from_numpy(a).permute(2, 0, 1)[None].float() / 127.5 - 1 for a in pair]
                for pair in pairs
            ]
            return sum(float(package(x, y)) for x, y in stacks)

    return {**ways, "lpips": theirs}


def lpips_ways_or_reason(pairs: Pairs) -> tuple[Ways, str]:
    """The same, or none and why."""
    try:
        ways = lpips_ways(pairs)
    except UnavailableError as error:
        return {}, str(error)
    missing = f"The package lpips is not installed. {install_extra('peers')}"
    return ways, "" if "lpips" in ways else missing


def noisy_pairs(count: int, height: int, width: int) -> Pairs:
    """Smooth images with noise, all different."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:height, :width][..., None]
    pairs = []
    for _ in range(count):
        waves = np.sin(y * rng.uniform(0.01, 0.2, 3) + x * rng.uniform(0.01, 0.2, 3) + rng.uniform(0, 6, 3))
        truth = 127 + 120 * waves
        noisy = truth + rng.normal(0, 12, truth.shape)
        image, clean = (np.clip(a, 0, 255).round().astype(np.uint8) for a in (noisy, truth))
        pairs.append((image, clean))
    return pairs


@dataclass(frozen=True)
class Timed:
    """One way: its value, and the least processor and wall time of a run, milliseconds per image."""

    name: str
    value: float
    processor_ms: float
    wall_ms: float


def in_turns(ways: Ways, runs: int, images: int) -> list[Timed]:
    """Run every way ``runs`` times, one after the other; each run scores ``images`` images."""
    values: dict[str, float] = {}
    processor: dict[str, list[float]] = {name: [] for name in ways}

    def timed(name: str) -> Callable[[], float]:
        def run() -> float:
            wall, own = time.perf_counter(), time.process_time()
            values[name] = ways[name]()
            processor[name].append(time.process_time() - own)
            return time.perf_counter() - wall

        return run

    walls = take_turns({name: timed(name) for name in ways}, budget=0.0, least_runs=runs)
    milliseconds = 1e3 / images
    return [
        Timed(name, values[name], milliseconds * min(processor[name][1:]), milliseconds * min(walls[name]))
        for name in ways
    ]


SIZE = (802, 550)
QUICK_SIZE = (200, 138)
OURS = "headbench"


def measure(quick: bool = False, progress: Progress = no_progress) -> Findings:
    """Milliseconds per image of PSNR + SSIM and of LPIPS, ours and by the usual libraries, and their values."""
    height, width = QUICK_SIZE if quick else SIZE
    pairs = noisy_pairs(4, height, width)
    runs = 2 if quick else 4
    threads = os.cpu_count() or 1
    tables: dict[str, list[Timed]] = {}
    with torch_threads(threads), ThreadPoolExecutor(threads) as pool:
        groups = structural_ways(pairs, pool)
        learned, reason = lpips_ways_or_reason(pairs)
        if learned:
            groups["LPIPS, AlexNet"] = learned
        for number, (title, ways) in enumerate(groups.items()):
            progress(number, len(groups), title)
            tables[title] = in_turns(ways, runs, len(pairs))
    text = "\n\n".join(_text(title, timed, len(pairs)) for title, timed in tables.items())
    note = (
        f"{len(pairs)} images of {width}x{height}, {threads} threads; the least of {runs} runs that take turns. Times: the\n"
        "first way's are 1. Values: mean over the images, PSNR and SSIM added up."
    )
    parts = [text, note, reason] if reason else [text, note]
    data: dict[str, Any] = {title: [asdict(way) for way in timed] for title, timed in tables.items()}
    return Findings("\n\n".join(parts), {"width": width, "height": height, "threads": threads, "ways": data})


def _text(title: str, timed: Sequence[Timed], images: int) -> str:
    first = timed[0]
    lines = [f"{title:<34}{'wall ms':>10}{'CPU ms':>10}{'wall':>8}{'CPU':>8}{'value':>14}"]
    for way in timed:
        ratios = way.wall_ms / first.wall_ms, way.processor_ms / first.processor_ms
        lines.append(
            f"  {way.name:<32}{way.wall_ms:>10.2f}{way.processor_ms:>10.2f}{ratios[0]:>7.1f}x{ratios[1]:>7.1f}x"
            f"{way.value / images:>14.7f}"
        )
    return "\n".join(lines)
