"""The ways to score frames that are compared: ours, and what the usual libraries take for the same number."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from ....bench.contracts import ByteArray
from ....bench.errors import UnavailableError
from ....metrics.lpips_network import Lpips, find_backbone, load_backbone, network_spec
from ....metrics.psnr import psnr
from ....metrics.ssim import Ssim, ssim, ssim_map, ssim_reflected

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

    def numpy_twin() -> float:
        return sum(psnr(x, y) + float(ssim_map(x, y).mean()) for x, y in pairs)

    return {
        "PSNR + SSIM, valid windows": {
            "headbench": ours(ssim),
            "headbench, numpy and OpenCV": numpy_twin,
            "scikit-image": skimage,
        },
        "PSNR + SSIM, reflected border": {"headbench": ours(ssim_reflected), "torchmetrics": torchmetrics},
    }


def lpips_ways(pairs: Pairs) -> Ways:
    """LPIPS (AlexNet) of every pair, summed. Raises `UnavailableError` without weights."""
    spec = network_spec("alex")
    weights = find_backbone(spec)
    fresh, cached = Lpips(weights=weights, cache_mb=0), Lpips(weights=weights, cache_mb=1e4)
    sum(cached.batched(pairs))  # another method's turn: the truths are known from then on
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
    return (
        ways,
        "" if "lpips" in ways else "The package lpips is not installed: pip install headbench[peers].",
    )


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
