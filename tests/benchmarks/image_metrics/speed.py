"""``headbench bench metrics``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

import torch

from ....bench.contracts import Progress, no_progress
from ....bench.specs import Findings
from .timing import Timed, in_turns
from .ways import lpips_ways_or_reason, noisy_pairs, structural_ways

SIZE = (802, 550)
QUICK_SIZE = (200, 138)
OURS = "headbench"


def measure(quick: bool = False, progress: Progress = no_progress) -> Findings:
    """Milliseconds per image of PSNR + SSIM and of LPIPS, ours and by the usual libraries, and their values."""
    height, width = QUICK_SIZE if quick else SIZE
    pairs = noisy_pairs(4, height, width)
    runs = 2 if quick else 4
    threads = os.cpu_count() or 1
    torch.set_num_threads(threads)
    tables: dict[str, list[Timed]] = {}
    with ThreadPoolExecutor(threads) as pool:
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
