"""Bundles of a leaderboard, each with the verification of its values."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from ...bench.audit.bundle import Bundle, check_results, read_bundle
from ...bench.audit.definitions import known_methods, known_metrics, method_of
from ...bench.audit.recompute import Agreement, agreements, results_again, train_again
from ...bench.audit.verify import SHOWN, TRAINING, Findings, Renders, lacking_frames, verify
from ...bench.contracts import Progress
from ...bench.engine.config import RunOptions
from ...bench.engine.scoring import FULL
from ...bench.engine.store import RunFolder
from ...bench.errors import HeadbenchError, reason_of, text_of
from ...bench.executors.settings import Execution
from ...bench.io.files import digest_file
from ...bench.manifest import Manifest
from ...bench.rows import Rows
from ...bench.specs import MetricSpec
from ..runs import RunData

State = Literal["recomputed", "verified", "claimed", "incomplete", "contradicted"]
STATES: dict[State, str] = {
    "recomputed": "Recomputed from the seed",
    "verified": "Verified from renders",
    "claimed": "Claimed, not verified (not ranked)",
    "incomplete": "Incomplete: frames of the protocol, or the metric that marks suspects, are missing (not ranked)",
    "contradicted": "Contradicted by renders, registry or another training (not ranked)",
}
"""Titles of the groups of a table, in order; the first two are ranked."""
RANKED: tuple[State, ...] = ("recomputed", "verified")


@dataclass(frozen=True)
class Submission:
    """An unpacked bundle, the SHA-256 of its file, and the results of its verification.

    ``run`` has only registered metrics, with their registered definitions; ``lacking`` names missing values, and ``trouble``
    is the reason if something could not be verified.
    """

    file: Path
    bundle: Bundle
    run: RunData
    digest: str
    findings: Findings = field(default_factory=Findings)
    renders: Renders = field(default_factory=dict)
    lacking: tuple[str, ...] = ()
    agreed: tuple[Agreement, ...] = ()
    trouble: tuple[str, ...] = ()

    @property
    def manifest(self) -> Manifest:
        """The record of its run."""
        return self.run.manifest

    @property
    def measured(self) -> tuple[tuple[str, str], ...]:
        """The protocol's hash of each task; results in one table have equal hashes."""
        return tuple(sorted((task, record.hash) for task, record in self.manifest.protocols.items()))

    @property
    def state(self) -> State:
        """Support for its values."""
        if self.lacking:
            return "incomplete"
        of_frames = {metric.name for metric in self.run.metrics if metric.per_frame}
        if self.findings.mismatches or any(not a.agrees for a in self.agreed if a.metric in of_frames):
            return "contradicted"
        if of_frames and of_frames <= {each.metric for each in self.agreed}:
            return "recomputed"
        return "verified" if self.findings.recomputed else "claimed"

    @property
    def supported(self) -> set[str]:
        """Metrics whose values are ranked."""
        again = {each.metric for each in self.agreed if each.agrees}
        return {*self.findings.recomputed, *again} if self.state in RANKED else set()

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences on differences and unverified values."""
        mismatches = map(str, self.findings.mismatches)
        found = [*self.lacking, *(text for text in mismatches if not text.endswith(self.lacking or ("\0",)))]
        more = [f"and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
        again = [f"Trained again: {'; '.join(map(str, self.agreed))}."] if self.agreed else []
        unverified = {n: why for n, why in self.findings.unverified.items() if n not in self.supported}
        if self.state == "recomputed":
            del unverified[TRAINING]
            unverified["processor time and memory of the training"] = "depend on the machine"
        rest = replace(self.findings, unverified=unverified).not_verified
        return tuple(filter(None, (*found[:SHOWN], *more, *again, *self.trouble, rest)))


def read_submission(file: Path, into: Path) -> Submission:
    """Unpack a bundle into ``into`` and check it. Raises `InputError` if its values cannot be in a table."""
    bundle, folder = read_bundle(file, into), RunFolder(into)
    manifest = folder.read_manifest()
    rows = check_results(folder, manifest)
    lacking = tuple(
        f"{where}: expected {wanted}, found {found}"
        for where, wanted, found in lacking_frames(rows, manifest)
    )
    known, methods = known_metrics(), known_methods()
    metrics = tuple(known[metric.name] for metric in manifest.metrics if metric.name in known)
    if all(metric.suspect_above is None for metric in metrics):
        lacking += ("psnr: expected values, found none: they show which results are suspect",)
    records = []
    for record in manifest.methods:
        spec = method_of(record.name, methods)
        records.append(record if spec is None else replace(record, trivial=spec.trivial))
    rows = _with_suspects(rows.labelled().of_metrics([metric.name for metric in metrics]), metrics)
    shown = replace(manifest, metrics=metrics, methods=tuple(records))
    return Submission(file, bundle, RunData(folder, shown, rows), digest_file(file), lacking=lacking)


def _with_suspects(rows: Rows, metrics: Sequence[MetricSpec]) -> Rows:
    """The rows, with suspect values marked by the limits of registered metrics only."""
    limits = {metric.name: metric.suspect_above for metric in metrics if metric.suspect_above is not None}
    return rows.with_suspects(limits, FULL)


def verified(
    submission: Submission,
    options: RunOptions,
    scratch: Path,
    kept: Path,
    recompute: bool,
    execution: Execution,
    progress: Progress,
) -> Submission:
    """Verify as much of the submission as possible.

    Parameters
    ----------
    kept : Path
        Folder of repeated trainings, from this or an earlier call.
    recompute : bool
        Train again; otherwise only an existing training is compared.
    """
    trouble: list[str] = []
    folder, again = submission.run.folder, kept / submission.digest[:12]
    try:
        found = verify(folder.root, submission.bundle, options, scratch, execution, progress)
        submission = replace(submission, findings=found.findings, renders=found.renders)
    except Exception as error:  # noqa: BLE001 - whatever a bundle causes, the others are shown
        trouble.append(f"Not verified: {placeless(error, folder.root)}")
        submission = replace(
            submission, findings=Findings(unverified={TRAINING: "nothing was trained again"})
        )
    try:
        if recompute:
            train_again(folder, again, options, execution, progress)
        rows = results_again(again, submission.manifest)
        if rows is not None:
            metrics = {metric.name: metric for metric in submission.run.metrics}
            own = folder.rows_by_condition(folder.read_manifest())
            submission = replace(submission, agreed=tuple(agreements(own, rows, metrics)))
            if submission.state == "recomputed":  # values trained here are ranked, not the submitted ones
                values = submission.run.rows.with_values(
                    rows.labelled().of_metrics(sorted(submission.supported))
                )
                run = replace(submission.run, rows=_with_suspects(values, submission.run.metrics))
                submission = replace(submission, run=run)
    except Exception as error:  # noqa: BLE001
        trouble.append(f"Not trained again: {placeless(error, folder.root)}")
    return replace(submission, trouble=tuple(trouble))


def qualified(submissions: Sequence[Submission]) -> list[dict[str, str]]:
    """Label of each submission's methods, by name: method, author and bundle; with a digest if they are not unique."""
    names = [
        {method: f"{method} [{each.bundle.by}/{each.file.stem}]" for method in each.run.methods}
        for each in submissions
    ]
    seen = Counter(_folded(label) for own in names for label in own.values())
    return [
        {
            method: label if seen[_folded(label)] == 1 else f"{label} {each.digest[:8]}"
            for method, label in own.items()
        }
        for each, own in zip(submissions, names)
    ]


def _folded(text: str) -> str:
    return unicodedata.normalize("NFKC", text).casefold()


def placeless(error: Exception, folder: Path) -> str:
    """An error without the temporary folder that a bundle was unpacked into; with its type if it is unexpected."""
    text = text_of(error) if isinstance(error, HeadbenchError) else reason_of(error)
    return text.replace(f"{folder}/", "")
