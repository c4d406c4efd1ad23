"""``headbench compare --baseline``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from ..errors import ExitCode, InputError
from ..io.files import check_writable, write_text
from ..specs import CommandResult
from .settings import BaselineOptions


def compare_with_baseline(run: Path, baseline: Path, settings: BaselineOptions) -> CommandResult:
    """Compare a run with a committed baseline: exit code 1 if a number got worse, 3 if one is missing.

    Results or a baseline that are missing or invalid are a finding too, with exit code 3, so that CI does not
    take them for a usage error. Nothing is written then but the reports asked for, which say so.
    """
    for option, path in (("--junit", settings.junit), ("--markdown", settings.markdown)):
        if path is not None:
            check_writable(Path(path), option)
            Path(path).unlink(missing_ok=True)  # a report of an earlier run could be mistaken for this one's
    if settings.update:
        check_writable(baseline, "--baseline")
    try:
        return _update(run, baseline, settings) if settings.update else _judge(run, baseline, settings)
    except InputError as error:
        from .verdicts import failed_junit, failed_markdown

        _write_reports(settings, failed_junit(str(error)), failed_markdown(str(error)))
        return CommandResult(
            f"Gate: missing or invalid: {error}", {"error": str(error)}, False, ExitCode.NO_VERDICT
        )


def _write_reports(settings: BaselineOptions, junit: str, markdown: str) -> None:
    """Write the requested reports."""
    for path, text in ((settings.junit, junit), (settings.markdown, markdown)):
        if path is not None:
            write_text(Path(path), text)


def _judge(run: Path, baseline_file: Path, settings: BaselineOptions) -> CommandResult:
    from .baseline import Baseline, read_results
    from .verdicts import (
        environment_changes,
        exit_code,
        judge,
        to_junit,
        to_markdown,
        to_text,
        unjudged_notes,
    )

    baseline, results = Baseline.read(baseline_file), read_results(run)
    verdicts = judge(results, baseline, speed=settings.judge_speed)
    code = exit_code(verdicts)
    changes = environment_changes(baseline.environment, results.environment)
    notes = [*unjudged_notes(verdicts), *(f"Environment changed: {change}." for change in changes)]
    if baseline.captures == "remade":
        notes.append("Captures were made again for these results, as the baseline declares.")
    unavailable = results.unavailable.keys() & baseline.unavailable.keys()
    if unavailable:
        notes.append(f"Unavailable here as in the baseline: {len(unavailable)} numbers.")
    if any(verdict.outcome in ("improved", "new") for verdict in verdicts) and code == 0:
        notes.append("The baseline can be brought up to date with --update.")
    _write_reports(settings, to_junit(verdicts, notes), to_markdown(verdicts, code, notes))
    data = {
        "code": code,
        "verdicts": [{**asdict(v), "place": str(v.place), "change": v.change} for v in verdicts],
        "environment_changes": changes,
    }
    return CommandResult(to_text(verdicts, code, notes), data, code == 0, code)


def _update(run: Path, path: Path, settings: BaselineOptions) -> CommandResult:
    from .baseline import Baseline, read_results
    from .verdicts import judge

    earlier = Baseline.read(path) if path.exists() else None
    results = read_results(run)
    baseline = Baseline.of(results, earlier, settings.captures)
    verdicts = judge(results, earlier) if earlier else []
    gone = sorted(earlier.values.keys() - baseline.values.keys()) if earlier else []
    before = earlier.frames if earlier else {}
    baseline.write(path)
    lines = [f"{path}: {len(baseline.values)} numbers written."]
    lines += [
        f"  was: {verdict}" for verdict in verdicts if verdict.outcome not in ("pass", "missing", "unjudged")
    ]
    for place, count in baseline.frames.items():
        if before.get(place, count) != count:
            lines.append(f"  frames: {place}: {before[place]} to {count}")
    lines += [f"  gone: {place}" for place in gone]
    by_reason: dict[str, list[str]] = {}
    for place, reason in baseline.unavailable.items():
        by_reason.setdefault(reason, []).append(str(place))
    lines += [f"  unavailable: {', '.join(places)}: {reason}" for reason, places in by_reason.items()]
    data = {"baseline": path, "values": len(baseline.values), "gone": [str(place) for place in gone]}
    return CommandResult("\n".join(lines), data, True, 0)
