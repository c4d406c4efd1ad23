"""``make fuzz``: damaged files for every reader, drawn by hypothesis from a seed.

Every outcome is a value, a refusal (an `InputError` that names a file, or a documented exit code), or a finding: another
exception, a traceback, more than 1 GB or 20 s, pages of output, a write outside the folder, an end by a signal. A
finding makes the exit code 1 and is shown with the smallest damage that hypothesis finds and the command that repeats it.
"""

from __future__ import annotations

import ctypes
import os
import re
import resource
import signal
import sys
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import hypothesis
from hypothesis import HealthCheck, Phase, given
from hypothesis import strategies as st
from hypothesis.errors import HypothesisException, StopTest

from headbench.bench.errors import HeadbenchError, InputError

from .damage import damage
from .readers import COMMANDS, READERS, Exit, Reader
from .samples import prepare_samples
from .watch import Place, forked, in_shares, on_change, options_of

SECONDS = 20.0
"""Processor time that a case may take; twelve times as long by the clock ends the process."""
MEMORY = 10**9
"""Bytes that a case may take on top of what the process has before."""
OUTPUT = 100_000
"""Characters that a case may print."""
CODES = {1: "exit 1", 2: "refused", 3: "refused"}


class Finding(Exception):
    """An outcome that is neither a value nor a refusal."""


class TooSlow(BaseException):
    """A case took too much processor time."""


class Over(BaseException):
    """The time of all cases is over."""


def damage_sample(reader: Reader, place: Place, draw: Callable) -> list[str]:
    """Damage one file of the sample, or a few; return which and how."""
    groups = defaultdict(list)
    for path in sorted(
        {path for pattern in reader.files for path in place.work.glob(pattern) if path.is_file()}
    ):
        # Of many files of a kind, such as images, no more are drawn than of one that is alone.
        groups[re.sub(r"\d+", "#", f"{path.parent.name}/{path.name}")].append(path)
    done = []
    for _ in range(draw(st.sampled_from([1, 1, 1, 2]))):
        path = draw(st.sampled_from(groups[draw(st.sampled_from(sorted(groups)))]))
        if path.is_file() and not path.is_symlink():
            done.append(f"{path.relative_to(place.work)}: {damage(path, place.outside, draw)}")
    return done


def check(reader: Reader, place: Place, draw: Callable) -> str:
    """Damage the sample and call the reader. Returns the outcome's name; what is none raises `Finding`, or as it did."""
    place.restore()
    how = "; ".join(damage_sample(reader, place, draw))
    hypothesis.note(how)
    (place.own / "case").write_text(how)
    os.chdir(place.work)
    with watched(place):
        outcome = call(reader, place)
    text = place.text()
    if place.wrote:
        raise Finding(f"a write outside the folder: {place.wrote}")
    if "Traceback (most recent call last)" in text:
        raise Finding(f"a traceback was printed: {text[-2000:]}")
    if len(text) > OUTPUT:
        raise Finding(f"{len(text)} characters were printed")
    return outcome


def call(reader: Reader, place: Place) -> str:
    """The outcome of the reader."""
    try:
        reader.read()
    except Exit as end:
        if end.args[0] not in CODES:
            raise Finding(f"exit code {end.args[0]}: {place.text()[-2000:]}") from None
        return CODES[end.args[0]]
    except InputError as error:
        if reader not in COMMANDS and not (place.work / error.file).is_relative_to(place.work):
            raise Finding(f"the refusal names no file of the sample: {error}") from error
        return "refused"
    except HeadbenchError:
        return "refused"
    except OSError as error:
        if not error.errno:  # which the command line would not report in one line
            raise
        return "refused"
    return "accepted"


@contextmanager
def watched(place: Place) -> Iterator[None]:
    """Bound time and memory of what is done, and note where it writes."""
    getattr(ctypes.CDLL(None), "malloc_trim", int)(
        0
    )  # what is free would be used again without being counted
    Path("/proc/self/clear_refs").write_text("5")  # start the peak of memory afresh
    before = _status("VmRSS")
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, 12 * SECONDS)
    place.watching, place.wrote = True, ""
    try:
        yield
    finally:
        place.watching = False
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    if (memory := _status("VmHWM") - before) > MEMORY:
        raise Finding(f"{memory / 1e6:.0f} MB of memory")


def _status(name: str) -> int:
    """A size from the kernel's record of this process, bytes."""
    with open("/proc/self/status") as stream:
        return next(int(line.split()[1]) * 1024 for line in stream if line.startswith(f"{name}:"))


def _too_slow(*_: Any) -> None:
    raise TooSlow(f"more than {SECONDS:g} s of processor time")


def finding_of(error: BaseException) -> str:
    """What is shown of an exception."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "hypothesis" not in f.filename]
    return f"{type(error).__name__}: {error}\n{''.join(traceback.format_list(frames[-3:]))}"[:3000]


def fuzz(reader: Reader, sample: Path, seed: int, end: float = float("inf")) -> tuple[Counter, str]:
    """A round of one reader in a process of its own: its outcomes, and what was found, if anything was."""
    place = Place(sample)
    begun = time.monotonic()

    def work(tell: Callable[[Any], None]) -> None:
        signal.signal(signal.SIGPROF, _too_slow)
        limit = _status("VmSize") + 8 * MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        place.restore()
        place.isolate()
        on_change(place.note)

        @hypothesis.seed(seed)
        @hypothesis.settings(
            max_examples=reader.cases,
            derandomize=False,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            phases=[Phase.generate] if reader in COMMANDS else [Phase.generate, Phase.shrink],
            report_multiple_bugs=False,
        )
        @given(st.data())
        def case(data: Any) -> None:
            if time.monotonic() > end:
                raise Over
            try:
                tell({"outcome": check(reader, place, data.draw)})
            except (HypothesisException, StopTest):  # by which hypothesis ends a case
                raise
            except BaseException as error:
                tell({"finding": finding_of(error)})
                raise

        with suppress(BaseException):  # which was told of
            case()

    ended, values = forked(work)
    outcomes = Counter(value["outcome"] for value in values if "outcome" in value)
    # The last one is the smallest that hypothesis came to.
    finding = next((value["finding"] for value in reversed(values) if "finding" in value), "")
    if ended and not finding:
        finding = (
            f"the process ended with {ended} after {time.monotonic() - begun:.0f} s: {place.text()[-2000:]}"
        )
    if finding:
        finding = f"{reader.name}: {(place.own / 'case').read_text()}\n  {finding}"
    place.remove()
    return outcomes, finding


def fuzz_in_rounds(
    names: Sequence[str], samples: Path, seed: int, end: float
) -> tuple[dict[str, Counter], dict[str, str]]:
    """Round after round over the readers until ``end``; one with a finding is left out from then on."""
    tallies: dict[str, Counter] = {name: Counter() for name in names}
    findings: dict[str, str] = {}
    by_name = {reader.name: reader for reader in READERS}
    number = seed
    while time.monotonic() < end and len(findings) < len(names):
        for name in names:
            if time.monotonic() < end and name not in findings:
                reader = by_name[name]
                outcomes, finding = fuzz(reader, samples / reader.sample, number, end)
                tallies[name] += outcomes
                if finding:
                    again = f"python -m headbench.tests.fuzz --seed {number} --reader '{name}'"
                    findings[name] = f"{finding}\n  {again}"
        number += 1
    return tallies, findings


def main() -> int:
    parser = options_of(__doc__)
    parser.add_argument("--reader", action="append", default=[], help="the start of names; default: all")
    options = parser.parse_args()
    samples = prepare_samples()
    end = time.monotonic() + options.seconds
    chosen = [r.name for r in READERS if not options.reader or r.name.startswith(tuple(options.reader))]
    results = in_shares(chosen, options.workers, fuzz_in_rounds, samples, options.seed, end)
    columns = ("accepted", "exit 1", "refused")
    print(f"{'reader':<20}" + "".join(f"{column:>10}" for column in columns))
    tallies = {name: tally for each, _ in results for name, tally in each.items()}
    tallies = {name: tallies[name] for name in chosen} | {"all": sum(tallies.values(), Counter())}
    for name, tally in tallies.items():
        print(f"{name:<20}" + "".join(f"{tally[column]:>10}" for column in columns))
    findings = {name: text for _, each in results for name, text in each.items()}
    print("\n".join(["", *findings.values()]))
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
