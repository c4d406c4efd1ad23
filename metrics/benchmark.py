"""``headbench doctor bench metrics``: compare the image metrics with common libraries, in speed and values."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from ..bench.benchmarks import Row, findings, take_turns
from ..bench.contracts import ByteArray, Progress
from ..bench.errors import UnavailableError, install_extra
from ..bench.specs import BenchmarkSpec, CommandResult

METRICS = BenchmarkSpec(
    name="metrics",
    summary="the image metrics: time per image next to scikit-image, torchmetrics and lpips, and equality of values",
    speed="headbench.metrics.benchmark:speed",
)
SIZE, QUICK_SIZE = (802, 550), (200, 138)
ROUNDS, QUICK_ROUNDS = 4, 2
IMAGES = 4

Pairs = list[tuple[ByteArray, ByteArray]]
Ways = Mapping[str, Callable[[], float]]


def speed(quick: bool, progress: Progress) -> CommandResult:
    """Milliseconds per image of PSNR + SSIM and of LPIPS, in this package and other libraries, and their
    values."""
    height, width = QUICK_SIZE if quick else SIZE
    pairs = noisy_pairs(IMAGES, height, width)
    rows: list[Row] = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        groups = structural_ways(pairs, pool)
        learned, missing = lpips_ways(pairs)
        groups |= {"LPIPS, AlexNet": learned} if learned else {}
        for number, (title, ways) in enumerate(groups.items()):
            progress(number, len(groups), title)
            seconds = take_turns(ways, QUICK_ROUNDS if quick else ROUNDS)
            least = {name: min(values) for name, values in seconds.items()}
            first = next(iter(least.values()))
            rows += [
                {
                    "metric": title,
                    "way": name,
                    "ms": 1e3 * value / len(pairs),
                    "times": value / first,
                    "value": f"{ways[name]() / len(pairs):.6f}",
                }
                for name, value in least.items()
            ]
    note = (
        f"{len(pairs)} images of {width}x{height}, {os.cpu_count()} threads; the least of runs that take turns, by the clock. "
        f"Values: mean over\nthe images, PSNR and SSIM added up. {missing}"
    )
    return findings({"Time an image": rows}, note.rstrip())


def structural_ways(pairs: Pairs, pool: ThreadPoolExecutor) -> dict[str, Ways]:
    """PSNR and SSIM of every pair, by form of the SSIM; each implementation returns the sum of both over all
    pairs."""
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    from .psnr import psnr
    from .ssim import Ssim, ssim, ssim_reflected

    def ours(form: Ssim) -> float:
        return sum(pool.map(lambda pair: psnr(*pair) + form(*pair), pairs))

    def skimage() -> float:
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        return sum(
            peak_signal_noise_ratio(y, x, data_range=255)
            + structural_similarity(x, y, channel_axis=2, data_range=255, **options)
            for x, y in pairs
        )

    def torchmetrics() -> float:
        functional = importlib.import_module("torchmetrics.functional.image")
        tensors = [[_tensor(image) / 255 for image in pair] for pair in pairs]
        forms = functional.peak_signal_noise_ratio, functional.structural_similarity_index_measure
        return sum(float(form(*pair, data_range=1.0)) for pair in tensors for form in forms)

    return {
        "PSNR + SSIM, valid windows": {
            "headbench": partial(ours, ssim),
            "scikit-image": skimage,
        },
        "PSNR + SSIM, reflected border": {
            "headbench": partial(ours, ssim_reflected),
            "torchmetrics": torchmetrics,
        },
    }


def lpips_ways(pairs: Pairs) -> tuple[Ways, str]:
    """LPIPS (AlexNet) of every pair, summed, and what is missing; no implementations without the network's
    weights."""
    from .lpips_network import ALEX, Lpips, find_backbone, load_backbone

    try:
        weights = find_backbone(ALEX)
    except UnavailableError as error:
        return {}, str(error)
    fresh, cached = Lpips(weights=weights, cache_mb=0), Lpips(weights=weights, cache_mb=1e4)
    ways: dict[str, Callable[[], float]] = {
        "headbench, first method": lambda: sum(fresh.batched(pairs)),
        "headbench, further methods": lambda: sum(cached.batched(pairs)),
    }
    try:
        package = importlib.import_module("lpips").LPIPS(net="alex", pnet_rand=True, verbose=False)
    except ImportError:
        return ways, f"The package lpips is not installed. {install_extra('peers')}"
    state = load_backbone(ALEX, weights)
    own = package.net.state_dict()
    package.net.load_state_dict({key: state["features." + key.split(".", 1)[1]] for key in own})
    package.requires_grad_(False)

    def theirs() -> float:
        return sum(float(package(*(_tensor(image) / 127.5 - 1 for image in pair))) for pair in pairs)

    return {**ways, "lpips": theirs}, ""


def _tensor(image: ByteArray):
    """(1, 3, H, W) float32 of an image."""
    import torch

    return torch.from_numpy(image).permute(2, 0, 1)[None].float()


def noisy_pairs(count: int, height: int, width: int) -> Pairs:
    """Different smooth images, with noise and without."""
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
