"""``make gpu``: whether a GPU gives the CPU's numbers, and how fast; one table of what was found against its bounds.

Each step runs in a process of its own, of limited time, all together in eight minutes, and can be run alone (``--step 2``);
what it found is printed and kept in the output folder number by number. Exit codes: 0, 1 where a bound is not kept or a step did not end, 3 where there is no such device.

On a machine without a network: ``bare.py``.
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

from headbench.bench.doctor import table
from headbench.bench.errors import HeadbenchError
from headbench.bench.io.documents import checked, read_json
from headbench.bench.io.files import write_json
from headbench.bench.machine import check_device, machine_record

from .steps import LIMITS_S, STEPS, Bar

NO_DEVICE = 3


def run_step(step: int, device: str, out: Path) -> None:
    """Run a step in this process; what it found is written after every number."""
    bars: list[Bar] = []
    record = {"device": device, "machine": machine_record(device)}

    def report(bar: Bar) -> None:
        # JSON has no infinity.
        finite = bar.found is not None and math.isfinite(bar.found)
        bars.append(bar if finite else replace(bar, found=None))
        print("  ".join(filter(None, bar.cells().values())), file=sys.stderr, flush=True)
        write_json(out / f"step-{step}.json", record | {"bars": [asdict(bar) for bar in bars]})

    try:
        STEPS[step](device, out / f"step-{step}", report)
        report(Bar("ended", 0.0, 0.0))
    except Exception as error:  # noqa: BLE001 - other steps are still to be run, and the table tells
        traceback.print_exc()
        report(Bar(f"ended: {type(error).__name__}", None, 0.0))


def kept(step: int, device: str, out: Path) -> list[Bar]:
    """What a step found; one bar that is not kept where it has not ended on this device."""
    path = out / f"step-{step}.json"
    record = read_json(path) if path.exists() else {}
    bars = checked(record["bars"], list[Bar], path) if record.get("device") == device else []
    return bars if bars and bars[-1].what.startswith("ended") else [*bars, Bar("ended", None, 0.0)]


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
    options = parser.parse_args(arguments)
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
                timeout=LIMITS_S[step],
                check=False,
            )
        except subprocess.TimeoutExpired:
            print(f"step {step} was ended after {LIMITS_S[step]} s", file=sys.stderr)
    found = {step: kept(step, options.device, options.out) for step in steps}
    print(shown(found))
    return int(not all(bar.holds for bars in found.values() for bar in bars))


if __name__ == "__main__":
    sys.exit(main())
