"""``make fuzz``: damaged inputs for every reader, and what becomes of each; see `cases` for what a finding is.

Any finding makes the exit code 1; each kind is printed with the command that shows its first case again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import select
import shutil
import sys
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from .cases import HANGS_AFTER, TOTAL, Batch, Tally, load_everything, run
from .samples import prepare_samples


def describe(tallies: dict[str, Tally], findings: list[tuple[str, dict[str, Any]]], seed: int) -> str:
    """The table of outcomes, then each kind of finding with the command that shows the first of it."""
    columns = ("accepted", "exit 1", "refused", "finding")
    titles = "".join(f"{name:>10}" for name in columns)
    lines = [f"{'reader':<20}{'cases':>7}{titles}{'longest s':>11}{'most MB':>9}"]
    every = Tally(sum((tally.outcomes for tally in tallies.values()), Counter()))
    every.took, every.memory = (max(getattr(t, key) for t in tallies.values()) for key in ("took", "memory"))
    for name, tally in [*tallies.items(), ("all", every)]:
        counts = "".join(f"{tally.outcomes[column]:>10}" for column in columns)
        cost = f"{tally.took:>11.2f}{tally.memory / 1e6:>9.0f}"
        lines.append(f"{name:<20}{tally.outcomes.total():>7}{counts}{cost}")
    kinds = defaultdict(list)
    for name, result in findings:
        detail = re.sub(r"\d{3,}|'[^']*'|0x\w+", "#", result["detail"].splitlines()[0])[:90]
        kinds[name.split()[0], detail].append((name, result))
    for (_, _), found in sorted(kinds.items(), key=lambda item: -len(item[1])):
        name, result = found[0]
        lines += [
            f"\n{len(found)} x {name}: {result['detail']}",
            f"  {'; '.join(result['how'])}",
            f"  python -m headbench.tests.fuzz --seed {seed} --target '{name}' --case {result['case']}",
        ]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--cases", type=int, default=TOTAL, help="over all targets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--target", action="append", default=[], help="the start of names; default: all")
    parser.add_argument("--case", type=int, help="show this case of the target")
    parser.add_argument("--keep", type=Path, help="with --case: leave the damaged files in this folder")
    parser.add_argument("--samples", type=Path, default=Path("build/fuzz"))
    options = parser.parse_args()
    samples = prepare_samples(options.samples)
    load_everything()
    from .targets import TARGETS

    chosen = [t for t in TARGETS if not options.target or any(t.name.startswith(n) for n in options.target)]
    if options.case is not None:
        return show(chosen[0], samples, options.seed, options.case, options.keep)
    tallies, findings = run(chosen, samples, options.seed, options.cases, options.seconds, options.workers)
    print(describe(tallies, findings, options.seed))
    return 1 if findings else 0


def show(target: Any, samples: Path, seed: int, case: int, keep: Path | None) -> int:
    """Run one case here and print what it prints."""
    batch = Batch(target, [case], samples, seed)
    found: list[dict[str, Any]] = []
    while not found and select.select([batch.pipe], [], [], HANGS_AFTER)[0]:
        size = len(batch.buffer)
        found = batch.results()
        if not found and len(batch.buffer) == size:
            break
    if keep is not None:
        shutil.copytree(batch.place.work, keep, symlinks=True)
    result = found[0] if found else batch.stop("") or {}
    print(result.pop("text")[-20_000:])
    print(json.dumps(result, indent=1))
    return 1 if result["outcome"] == "finding" else 0


if __name__ == "__main__":
    sys.exit(main())
