"""Training of a cell's avatar, or its derivation from the avatar of another cell."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from ..contracts import Avatar, PreparedMethod, Progress
from ..errors import InputError, is_damage
from ..io.files import write_text
from ..machine import PeakMemory, ProcessorLoad, processor_seconds, use_device
from ..progress import duration
from .config import resolve_change
from .guard import TrainingView
from .job import TRAINING, Job, source_digest, trained_ago, warn_of_damage
from .store import avatar_files
from .stored import shown_by, training_losses, write_avatar_record

log = logging.getLogger(__name__)


def fit(job: Job) -> Avatar:
    """Train, resume training or read the trained avatar; return the avatar as read back from disk.

    A method can only read images of the training split. The recorded seconds start at the last of
    ``interruptions``. An avatar with damaged files is trained again, with a warning.
    """
    method = job.create()
    earlier = job.cell.step("fit")
    if earlier is not None and earlier["status"] == "done":
        damaged = job.cell.damage(earlier.get("files", {}))
        if damaged:
            warn_of_damage(job, damaged, "it is trained again")
            earlier = None
    if earlier is None and job.cell.avatar.exists():
        job.cell.set_aside(job.cell.avatar)  # damaged, or of unknown inputs
    if earlier is None or earlier["status"] != "done":
        interruptions = 0 if earlier is None else earlier.get("interruptions", 0) + 1
        record = job.method.record()
        use_device(job.device)  # before the training is recorded as begun
        job.cell.begin("fit", job.fit_fingerprint, interruptions=interruptions, method=record)
        if isinstance(method, PreparedMethod):
            method.prepare(job.device)
        start, processor = time.perf_counter(), processor_seconds()
        load = ProcessorLoad(job.device)
        with load, PeakMemory(job.device) as memory, job.progress(TRAINING) as report:
            try:
                _train(job, method, report)
            except InputError as error:
                kept = Path(error.file)
                if (
                    earlier is None
                    or not is_damage(error)
                    or not (job.cell.avatar in kept.parents and kept.is_file())
                ):
                    raise
                log.warning("%s: %s It is trained from the start.", job.name, error)
                job.cell.set_aside(job.cell.avatar)
                _train(job, method, report)
        seconds = time.perf_counter() - start
        clip, budget = job.form.clip, asdict(job.method.budget)
        origin = {"seed": job.seed, "budget": budget, "capture": clip.fingerprint}
        write_avatar_record(job.cell.avatar, job.method, *shown_by(clip), "training", origin)
        job.cell.finish(
            "fit",
            job.fit_fingerprint,
            seconds=round(seconds, 3),
            processor_seconds=round(processor_seconds() - processor, 3),
            interruptions=interruptions,
            peak_memory_bytes=memory.peak,
            memory_before_bytes=memory.before,
            **memory.device_record,
            load={"machine": load.machine, **load.details},
            method=record,
            finished_at=datetime.now(UTC).timestamp(),
            files=job.cell.digests(avatar_files(job.cell.avatar)),
        )
        log.info("%s: trained in %s", job.name, duration(seconds))
        write_losses(job)
    else:
        log_kept(job)
    avatar: Avatar = method.load(job.cell.avatar, device=job.device)
    return avatar


def write_losses(job: Job) -> None:
    """Write training losses to ``losses.csv`` and, if TensorBoard is installed, as its events, into the cell's folder."""
    losses = training_losses(job.cell.avatar)
    if not losses:
        return
    lines = ["iteration,loss", *(f"{iteration},{loss!r}" for iteration, loss in losses)]
    write_text(job.cell.folder / "losses.csv", "\n".join(lines) + "\n")
    try:
        tensorboard = import_module("torch.utils.tensorboard")
    except ImportError:
        return
    with tensorboard.SummaryWriter(str(job.cell.folder / "tensorboard")) as writer:
        for iteration, loss in losses:
            writer.add_scalar("loss", loss, iteration)


def derive(job: Job) -> Avatar:
    """Use the avatar of the job's ``source``, or derive one from it by the condition, without training.

    Raises `InputError` if the source has no trained avatar.
    """
    assert job.source is not None
    derived_from = source_digest(job)
    change, clip = job.condition.derive, job.form.clip
    if change:
        make = resolve_change(change, "derive")
        avatar: Avatar = make(
            job.method.spec, job.source.avatar, job.cell.avatar, TrainingView(clip), job.device
        )
        origin = {"variant": job.condition.name, "of": derived_from}
        write_avatar_record(job.cell.avatar, job.method, *shown_by(clip), "variant", origin)
    else:
        avatar = job.create().load(job.source.avatar, device=job.device)
    files = job.cell.digests(path for path in job.cell.avatar.rglob("*") if path.is_file())
    job.cell.finish("fit", job.fit_fingerprint, derived_from=derived_from, files=files)
    return avatar


def log_kept(job: Job) -> None:
    """Log when the avatar of a finished training was trained; warn if the code of its method has changed since."""
    state = job.cell.step("fit")
    assert state is not None
    spec = job.method.spec
    log.info("%s: kept: trained %s, version %s", job.name, trained_ago(state), spec.version)
    earlier = state.get("method", {}).get("code")
    if earlier and earlier != job.method.record().get("code"):
        package = spec.implementation.partition(":")[0].rpartition(".")[0]
        log.warning(
            "%s: the code of %s has changed since this avatar was trained. It is kept because the version is still %s. If "
            "the change affects results, raise the version in the spec, or delete %s to train it again.",
            *(job.name, package, spec.version, job.cell.folder),
        )


def _train(job: Job, method: Any, report: Progress) -> None:
    method.fit(
        TrainingView(job.form.clip),
        job.cell.avatar,
        job.method.budget,
        device=job.device,
        seed=job.seed,
        progress=report,
    )
