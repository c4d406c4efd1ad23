"""``headbench lint``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.progress import counted
from ...bench.specs import CommandResult, command
from .rules import SEVERITIES, Finding, apply
from .settings import LintSettings

if TYPE_CHECKING:
    from .evidence import Evidence


@command("lint", group="data")
def lint(settings: LintSettings, progress: Progress = no_progress) -> CommandResult:
    """Check a capture for faults that make a comparison unfair or wrong.

    Passes if there are no errors; with ``strict``, also no warnings.
    """
    from .catalogue import RULES

    unknown = sorted(set(settings.ignore) - {rule.code for rule in RULES})
    if unknown:
        raise InputError("--ignore", "", "codes that `headbench lint --list` shows", ", ".join(unknown))
    if settings.list:
        return _explained()
    if not settings.clip:
        raise InputError("command line", "CLIP", "the folder of a capture, or --list", "nothing")
    evidence, findings = lint_capture(settings, progress)
    counts = Counter(finding.severity for finding in findings)
    passed = not counts["error"] and not (settings.strict and counts["warning"])
    data = {
        "capture": evidence.folder.as_posix(),
        "passed": passed,
        "counts": {severity: counts[severity] for severity in SEVERITIES},
        "looked_at": _looked_at(evidence),
        "skipped": _skipped(evidence),
        "cameras": {camera: _finite(asdict(facts)) for camera, facts in evidence.cameras.items()},
        "findings": [asdict(finding) for finding in findings],
    }
    return CommandResult(_report(evidence, findings, passed), data, passed)


def lint_capture(settings: LintSettings, progress: Progress = no_progress) -> tuple[Evidence, list[Finding]]:
    """Findings for a capture, most severe first, and the amount of inspected data."""
    from ..ga.reader import find_capture
    from ..open import find_reader
    from .catalogue import RULES
    from .evidence import Evidence

    if find_reader(settings.clip, settings.reader).name == "ga":
        if settings.set:
            expected = "no settings: of the reader ga, lint looks at the files"
            raise InputError("command line", "--set", expected, ", ".join(settings.set), "Leave it out.")
        evidence = Evidence.of_files(find_capture(settings.clip), settings, progress)
    else:
        clip = settings.open(settings.clip, progress)
        evidence = Evidence.of_clip(Path(settings.clip), clip, settings, progress)
    return evidence, apply(RULES, evidence, settings.ignore, base=evidence.folder.parent)


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """Measurements with None for unavailable ones."""
    return {
        key: value if isinstance(value, str) or _is_finite(value) else None for key, value in values.items()
    }


def _is_finite(value: float | tuple[float, ...]) -> bool:
    return all(map(math.isfinite, value if isinstance(value, tuple) else (value,)))


def _looked_at(evidence: Evidence) -> dict[str, Any]:
    from .catalogue import RULES

    return {
        "frames": len(evidence.entries),
        "timesteps": len({entry.timestep for entry in evidence.entries}),
        "cameras": len({entry.camera_id for entry in evidence.entries}),
        "frames_decoded": len(evidence.views),
        "frames_compared_for_near_duplicates": len(evidence.thumbnails),
        "parameter_files": len(evidence.parameters),
        "rules": len({rule.code for rule in RULES} - set(evidence.settings.ignore) - set(_skipped(evidence))),
    }


def _skipped(evidence: Evidence) -> list[str]:
    """Codes of checks that need files which the capture's reader does not read."""
    from .catalogue import RULES

    return [] if evidence.of_layout else [rule.code for rule in RULES if rule.of_layout]


def _report(evidence: Evidence, findings: Sequence[Finding], passed: bool) -> str:
    lines = []
    for finding in findings:
        place = finding.file + (f", {finding.key}" if finding.key else "")
        lines.append(f"{finding.code} {finding.severity:<8}  {finding.message}")
        lines += [f"{'':16}{text}" for text in (place, finding.remedy) if text] + [""]
    counts = Counter(finding.severity for finding in findings)
    counts_text = ", ".join(counted(counts[severity], severity) for severity in SEVERITIES)
    amounts = _looked_at(evidence)
    lines += [
        f"{Path(evidence.folder).name}: {counts_text}.",
        (
            f"Checked {amounts['frames']} frames ({amounts['timesteps']} timesteps, {amounts['cameras']} cameras), decoded "
            f"{amounts['frames_decoded']}, compared {amounts['frames_compared_for_near_duplicates']} for near-duplicates."
        ),
    ]
    if skipped := _skipped(evidence):
        text = "They look at files of the GaussianAvatars/VHAP layout, and another reader read this capture."
        lines.append(f"Skipped {counted(len(skipped), 'check')}: {', '.join(skipped)}. {text}")
    if not passed:
        lines.append("Not suitable for a comparison without changes.")
    return "\n".join(lines)


def _explained() -> CommandResult:
    from .catalogue import GROUPS, RULES

    lines = []
    for digit, group in GROUPS.items():
        lines += [f"HB{digit}xx {group}", ""]
        for rule in RULES:
            if rule.code[2] == digit:
                lines += [f"{rule.code} {rule.severity:<8}  {rule.title}", f"{'':16}{rule.remedy}"]
        lines.append("")
    data = {
        "rules": [
            {
                "code": rule.code,
                "severity": rule.severity,
                "subject": GROUPS[rule.code[2]],
                "title": rule.title,
                "remedy": rule.remedy,
            }
            for rule in RULES
        ]
    }
    return CommandResult("\n".join(lines).rstrip(), data)
