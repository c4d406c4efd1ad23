"""``make gpu``: whether a GPU gives the CPU's numbers, and how fast; one table of what was found against its bounds.

Each step takes ten minutes at most, runs in a process of its own, and can be run alone (``--step 2``); what it found is kept
in the output folder. Exit codes: 0, 1 where a bound is not kept or a step did not end, 3 where there is no such device.

Without a network: ``--wheels DIR`` collects the wheels on a machine that has one and prints how to install from them.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import traceback
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from headbench.bench.benchmarks import table
from headbench.bench.errors import HeadbenchError
from headbench.bench.io.documents import checked, read_json
from headbench.bench.io.files import write_json
from headbench.bench.machine import check_device, machine_record

from .steps import ROOT, STEPS, Bar

LIMIT_S = 600.0
NO_DEVICE = 3


LOCK = [
    word for name in ("torch-cuda.txt", "dev.txt") for word in ("--requirement", f"requirements-{name}")
] + ["--requirement", "requirements.txt"]
"""The locked packages of a machine with a GPU, as pip takes them."""


def wheels(folder: Path) -> int:
    """Collect the locked packages for a machine with a GPU as wheels; print how to install from them."""
    command = [sys.executable, "-m", "pip", "download", "--only-binary", ":all:", "--no-deps"]
    done = subprocess.run([*command, "--dest", str(folder.resolve()), *LOCK], cwd=ROOT, check=False)
    if done.returncode == 0:
        print(
            f"Install: pip install --no-deps --no-index --find-links {folder} {' '.join(LOCK)} && "
            "pip install --no-deps --no-build-isolation --editable ."
        )
    return done.returncode


def run_step(step: int, device: str, out: Path) -> None:
    """Run a step in this process and keep what it found."""
    try:
        bars = STEPS[step](device, out / f"step-{step}")
    except Exception as error:  # noqa: BLE001 - other steps are still to be run, and the table tells
        traceback.print_exc()
        bars = [Bar(f"ended: {type(error).__name__}", math.inf, 0.0)]
    # JSON has no infinity.
    bars = [
        replace(bar, found=None) if bar.found is None or not math.isfinite(bar.found) else bar for bar in bars
    ]
    record = {"device": device, "machine": machine_record(device), "bars": [asdict(bar) for bar in bars]}
    write_json(out / f"step-{step}.json", record)


def kept(step: int, device: str, out: Path) -> list[Bar]:
    """What a step found; one bar that is not kept where it has not ended on this device."""
    path = out / f"step-{step}.json"
    record = read_json(path) if path.exists() else {}
    if record.get("device") != device:
        return [Bar("ended", None, 0.0)]
    return checked(record["bars"], list[Bar], path)


def shown(found: dict[int, list[Bar]]) -> str:
    """The table of bars."""
    return table([{"step": step, **bar.cells()} for step, bars in found.items() for bar in bars])


def main(arguments: Sequence[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(
        prog="python -m headbench.tests.gpu", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--device", default="cuda", help="cuda, cuda:1, ...; cpu tries the script itself, at small sizes"
    )
    parser.add_argument("--out", type=Path, default=Path("build/gpu"))
    parser.add_argument("--step", type=int, choices=list(STEPS), help="run this step alone")
    parser.add_argument("--wheels", type=Path, help="collect wheels in this folder, and nothing else")
    options = parser.parse_args(arguments)
    if options.wheels:
        return wheels(options.wheels)
    try:
        check_device(options.device)
    except HeadbenchError as error:
        print(f"There is no GPU to run this on: {error}", file=sys.stderr)
        return NO_DEVICE
    options.out.mkdir(parents=True, exist_ok=True)
    steps = [options.step] if options.step else list(STEPS)
    for step in steps:
        (options.out / f"step-{step}.json").unlink(missing_ok=True)
        if options.step:
            run_step(step, options.device, options.out)
            continue
        print(f"step {step}: {(STEPS[step].__doc__ or '').splitlines()[0]}", flush=True)
        own = ["--step", str(step), "--device", options.device, "--out", str(options.out)]
        try:
            subprocess.run(
                [sys.executable, "-m", "headbench.tests.gpu", *own],
                stdout=subprocess.DEVNULL,
                timeout=LIMIT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            print(f"step {step} was ended after {LIMIT_S:.0f} s", file=sys.stderr)
    found = {step: kept(step, options.device, options.out) for step in steps}
    print(shown(found))
    return int(not all(bar.holds for bars in found.values() for bar in bars))


if __name__ == "__main__":
    sys.exit(main())
