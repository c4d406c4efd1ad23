"""HB6xx: head model and tracked parameters. HB7xx: tracked mesh compared with the images."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...bench.contracts import FloatArray
from ...bench.errors import InputError
from ...bench.progress import counted, some
from ..ga import layout
from .checks_cameras import misplaced
from .checks_rig import faulty_cameras
from .evidence import Evidence
from .rules import Hit, rule, spans
from .views import MeshFacts, ViewFacts

STILL = 1e-4
"""Radians, or coefficients: smaller changes over a capture count as none."""

FEW = 5
"""Minimum number of timesteps to report parameters that never change."""

REACH_M = 0.05
"""Metres; implausible displacement of a face by expression alone, without jaw and head."""

JUMP_M, JUMP_TIMES = 0.03, 6.0
"""A step of the face is a jump if it is longer than this and than this multiple of the sequence's median."""

WORSE = 1.05
"""Ratio above which expressions that fit worse than none do not belong to the images."""

UNTRAINED = 0.25
"""Fraction of test expressions outside of training above which results are extrapolation."""

CHANGE = 1e-4


@rule("HB601", "error", of_layout=True, refused=True)
def _version(evidence: Evidence) -> Iterator[Hit]:
    """The head model differs from the one used for tracking.

    Give the declared version, or refit the tracking: coefficients of FLAME 2020 and 2023 are not interchangeable,
    although their numbers are equal.
    """
    for error in evidence.faults.errors("head"):
        if error.key == "head_model":
            text = (
                f"the head model given is {error.expected.split(',')[0]}, the capture was tracked with "
                f"{error.found}"
            )
            yield Hit(text, error.file, error.key)


@rule("HB613", "error", of_layout=True)
def _sequence_versions(evidence: Evidence) -> Iterator[Hit]:
    """Sequences were tracked with different head models.

    Refit one of them, or keep them in separate captures.
    """
    if evidence.declaration is not None:
        version = evidence.declaration.head_model
    elif evidence.subject is not None:
        version = evidence.subject.head.version
    else:
        return
    others: dict[str, Path] = {}
    for folder in sorted({entry.image.parent.parent for entry in evidence.entries} - {evidence.folder}):
        try:
            other = layout.Declaration.read(folder) if folder.is_dir() else None
        except InputError:
            continue  # the union's declaration is used; only the version of a sequence's declaration is read
        if other is not None and other.head_model != version:
            others[other.head_model] = folder
    if others:
        folder = next(iter(others.values()))
        text = f"sequence {folder.name} was tracked with {some(others)}, the union with {version}"
        yield Hit(text, folder / layout.DECLARATION_FILE, "head_model")


@rule("HB602", "error", of_layout=True, refused=True)
def _no_head(evidence: Evidence) -> Iterator[Hit]:
    """The head model is missing or broken.

    Give its path with --head, or save it at the path in headbench.json.
    """
    for error in evidence.faults.errors("head"):
        if error.key != "head_model":
            yield Hit(f"expected {error.expected}, found {error.found}", error.file, error.key)


@rule("HB603", "error", of_layout=True, refused=True)
def _unfit(evidence: Evidence) -> Iterator[Hit]:
    """Parameters do not fit the head model.

    Give the head model the capture was tracked with.
    """
    wrong = [p for p in evidence.parameters.values() if p.error is not None and p.arrays and not p.not_finite]
    if wrong and wrong[0].error is not None:
        error = wrong[0].error
        text = (
            f"{counted(len(wrong), 'parameter file')} do not fit the head model: expected {error.expected}, found "
            f"{error.found}"
        )
        yield Hit(text, error.file, error.key)


@rule("HB604", "error")
def _not_finite(evidence: Evidence) -> Iterator[Hit]:
    """Parameters are not finite.

    Track these timesteps again, or leave them out with a reason.
    """
    wrong = [p for p in evidence.parameters.values() if p.not_finite]
    if wrong:
        text = (
            f"{some(wrong[0].not_finite)} not finite in {counted(len(wrong), 'parameter file')}, timesteps "
            f"{spans(p.timestep for p in wrong)}"
        )
        yield Hit(text, wrong[0].path, wrong[0].not_finite[0])


@rule("HB605", "warning", of_layout=True)
def _short_vectors(evidence: Evidence) -> Iterator[Hit]:
    """There are fewer coefficients than in the head model.

    Make sure that the tracker used a truncated basis of this model, and not another model.
    """
    if evidence.subject is None:
        return
    head = evidence.subject.head
    for key, basis in (("expr", head.expression_basis), ("shape", head.shape_basis)):
        short = [p for p in evidence.posed if p.arrays[key].size < basis.shape[2]]
        if short:
            text = (
                f"{key} has {short[0].arrays[key].size} coefficients, head model {head.version} has "
                f"{basis.shape[2]}; the rest is taken as zero"
            )
            yield Hit(text, short[0].path, key)


@rule("HB606", "warning")
def _eyelids(evidence: Evidence) -> Iterator[Hit]:
    """The head model lacks the tracked eyelids.

    Give the model the tracker used (FLAME 2020 with eyelids, in MICA's tracker), or refit.
    """
    if evidence.subject is None or evidence.subject.head.eyelid_basis is not None:
        return
    used = [p for p in evidence.parameters.values() if np.any(p.arrays.get("eyelids", 0))]
    if used:
        text = (
            f"eyelids are tracked in {counted(len(used), 'timestep')}, head model "
            f"{evidence.subject.head.version} has no eyelid basis"
        )
        yield Hit(text, used[0].path, "eyelids")


@rule("HB607", "warning")
def _still_jaw(evidence: Evidence) -> Iterator[Hit]:
    """The jaw never moves.

    Check the version: in FLAME 2023 without jaw rotation the mouth opens by expression, and its coefficients fit no
    other model.
    """
    if evidence.subject is None or evidence.subject.head.skinning_weights[:, 2].max() < 0.5:
        return
    poses = evidence.posed
    jaws = np.array([p.pose.jaw for p in poses if p.pose])
    if len(poses) >= FEW and np.ptp(jaws, axis=0).max() < STILL:
        yield Hit(
            f"the jaw never rotates over {counted(len(poses), 'timestep')}", poses[0].path.parent, "jaw_pose"
        )


@rule("HB614", "warning")
def _still_expression(evidence: Evidence) -> Iterator[Hit]:
    """The expression never changes.

    Make sure that expressions were tracked and exported.
    """
    poses = evidence.posed
    expressions = np.array([p.pose.expression for p in poses if p.pose])
    if len(poses) >= FEW and np.ptp(expressions, axis=0).max(initial=0.0) < STILL:
        text = f"the expression never changes over {counted(len(poses), 'timestep')}"
        yield Hit(text, poses[0].path.parent, "expr")


@rule("HB616", "note")
def _untrained_expressions(evidence: Evidence) -> Iterator[Hit]:
    """Test expressions differ from those of training.

    Record or train on more expressions, or regard the results as extrapolation: no training frame has such
    expressions.
    """
    from ..inspect.statistics import displacement_metric, novelty  # of no use before a run

    if evidence.subject is None:
        return
    test: dict[str, set[int]] = defaultdict(set)
    for entry in evidence.splits.get("self_reenactment", ()):
        test[evidence.names[entry.sequence_folder]].add(entry.timestep)
    train = {entry.timestep for entry in evidence.splits.get("train", ())}
    excluded = evidence.declaration.excluded if evidence.declaration else {}
    poses = {p.timestep: p.pose.expression for p in evidence.posed if p.pose and p.timestep not in excluded}
    head = evidence.subject.head
    metric = displacement_metric(head.expression_basis[head.regions.get("face", slice(None))])
    trained = [poses[t] for t in sorted(train & poses.keys())]
    for name, timesteps in test.items():
        new = [poses[t] for t in sorted(timesteps & poses.keys())]
        if len(trained) < FEW or not new:
            continue
        share = novelty(np.stack(trained) @ metric, np.stack(new) @ metric)
        if max(share) > UNTRAINED:
            text = (
                f"test sequence {name}: {share.outside:.0%} of its expressions lie outside the span of training, "
                f"{share.beyond:.0%} of its timesteps beyond the range of training"
            )
            yield Hit(text, evidence.split_file("self_reenactment"))


@rule("HB608", "warning")
def _far_expression(evidence: Evidence) -> Iterator[Hit]:
    """Expressions are larger than faces allow.

    Check the version and the scale of the coefficients (standard deviations, metres).
    """
    far = {t: reach for t, reach in expression_reach(evidence).items() if reach > REACH_M}
    if far:
        worst = max(far, key=lambda t: far[t])
        text = (
            f"the expression moves vertices by up to {1000 * far[worst]:.0f} mm (timestep {worst}; more than "
            f"{1000 * REACH_M:.0f} mm in {counted(len(far), 'timestep')})"
        )
        yield Hit(text, evidence.parameters[worst].path, "expr")


@rule("HB609", "warning", of_layout=True)
def _changing_identity(evidence: Evidence) -> Iterator[Hit]:
    """Identity changes over time.

    Track with one identity for all sequences, or split the union.
    """
    posed = evidence.posed
    if not posed:
        return
    first = posed[0].arrays["shape"].ravel()
    shapes = [p.arrays["shape"].ravel() for p in posed]
    change = max(float(np.abs(s - first).max(initial=0.0)) for s in shapes if s.shape == first.shape)
    offset = max(p.offset_change_m for p in posed)
    if change > CHANGE or offset > 1e-6:
        text = (
            f"identity changes over time (shape by up to {change:.3g}, static offset by {1000 * offset:.3g} mm); "
            "the first timestep's is taken for all"
        )
        yield Hit(text, posed[0].path.parent, "shape")


@rule("HB610", "note", of_layout=True)
def _dynamic(evidence: Evidence) -> Iterator[Hit]:
    """Dynamic offsets are ignored.

    None, if methods are driven by coefficients; tracking is then slightly coarser.
    """
    largest = max((p.dynamic_m for p in evidence.parameters.values()), default=0.0)
    if largest > 0:
        path = next(p.path for p in evidence.parameters.values() if p.dynamic_m > 0)
        text = f"dynamic_offset moves vertices by up to {1000 * largest:.3g} mm and is not used"
        yield Hit(text, path, "dynamic_offset")


@rule("HB611", "warning")
def _repeated(evidence: Evidence) -> Iterator[Hit]:
    """Tracking is constant while images change.

    Track these timesteps again, or leave them out with a reason.
    """
    images, repeated = evidence.contents, []
    for timesteps in evidence.sequences.values():
        for before, after in itertools.pairwise(timesteps):
            one, other = evidence.parameters[before].arrays, evidence.parameters[after].arrays
            same = one.keys() == other.keys() and all(np.array_equal(one[k], other[k]) for k in one)
            if one and same and images[before] != images[after]:
                repeated.append(after)
    if repeated:
        yield Hit(
            f"{counted(len(repeated), 'timestep')} with the parameters of the one before and other images: "
            f"{spans(repeated)}",
            evidence.parameters[repeated[0]].path,
        )


@rule("HB612", "warning")
def _jumps(evidence: Evidence) -> Iterator[Hit]:
    """Tracking jumps.

    Inspect the overlay (headbench inspect); track these timesteps again, or exclude them with a reason.
    """
    for folder, (timesteps, steps) in face_steps(evidence).items():
        if len(steps) < FEW:
            continue
        limit = max(JUMP_M, JUMP_TIMES * float(np.median(steps)))
        jumps = np.flatnonzero(steps > limit)
        if len(jumps):
            yield Hit(
                f"the face of {evidence.names[folder]} jumps by up to {1000 * steps.max():.0f} mm into timesteps "
                f"{spans(timesteps[i + 1] for i in jumps)} (median step {1000 * np.median(steps):.1f} mm)",
                evidence.parameters[timesteps[int(jumps[0]) + 1]].path,
            )


@rule("HB615", "warning")
def _unexplained(evidence: Evidence) -> Iterator[Hit]:
    """Expressions fit the images worse than a face at rest.

    Check the head model's version (FLAME 2020 and 2023 are not interchangeable), and that parameters and images belong
    to the same timesteps; refit the tracking to the model to be used.
    """
    fit = evidence.expression_fit
    if fit is None or misplaced(evidence) or mesh_misses(evidence) or fit.camera in faulty_cameras(evidence):
        return
    if fit.ratio > WORSE:
        text = (
            f"the skin's colours at the mesh's vertices vary {fit.ratio:.2f} times as much over time as with a face at "
            f"rest ({fit.vertices} vertices, {counted(fit.frames, 'frame')} of camera {fit.camera})"
        )
        yield Hit(text, evidence.folder, "expr")


OUTSIDE = 0.15
"""Fraction of the face's vertices outside the foreground above which a frame's mesh misses it."""

SMALL = 0.2
"""Ratio of the areas of mesh and foreground below which the mesh is too small or the mask too large."""
MOST_FAR = 0.1
"""Fraction of the foreground far from the mesh above which the mask holds more than a head model explains."""


def _comparable(evidence: Evidence) -> list[tuple[ViewFacts, MeshFacts, float]]:
    """Frames whose mesh can be compared with a valid mask, with the fraction of the face outside."""
    if misplaced(evidence):
        return []
    faulty = faulty_cameras(evidence)
    return [
        (view, view.mesh, view.mesh.face_outside)
        for view in evidence.views
        if view.mesh is not None
        and view.mesh.face_outside is not None
        and view.has_sound_mask
        and view.entry.camera_id not in faulty
    ]


def mesh_misses(evidence: Evidence) -> bool:
    """Whether the face of the mesh is outside the foreground in most frames."""
    views = _comparable(evidence)
    return bool(views) and float(np.median([outside for _, _, outside in views])) > OUTSIDE


@rule("HB701", "error")
def _missed(evidence: Evidence) -> Iterator[Hit]:
    """The tracked mesh misses the subject.

    Inspect the overlay (headbench inspect) for wrong cameras, intrinsics not scaled with the images, units,
    another subject's tracking, or parameters shifted by some timesteps.
    """
    if mesh_misses(evidence):
        views = _comparable(evidence)
        outside = float(np.median([share for _, _, share in views]))
        overlap = float(np.median([mesh.overlap or 0.0 for _, mesh, _ in views]))
        yield Hit(
            f"{outside:.0%} of the face's vertices fall outside the foreground (median over "
            f"{counted(len(views), 'frame')}; mesh and foreground overlap by {overlap:.2f})",
            evidence.folder,
        )


@rule("HB702", "warning")
def _missed_once(evidence: Evidence) -> Iterator[Hit]:
    """The tracked mesh misses the subject in some frames.

    Track these timesteps again, or leave them out with a reason.
    """
    if mesh_misses(evidence):
        return
    views = _comparable(evidence)
    lost = [(view, outside) for view, _, outside in views if outside > OUTSIDE]
    if lost:
        timesteps = sorted({view.entry.timestep for view, _ in lost})
        cameras = sorted({view.entry.camera_id for view, _ in lost})
        where = f"camera {cameras[0]}, " if len(cameras) == 1 else ""
        yield Hit(
            f"the mesh misses the face in {len(lost)} of {counted(len(views), 'frame')} checked ({where}"
            f"timesteps {spans(timesteps)})",
            lost[0][0].entry.image,
        )


@rule("HB703", "warning")
def _small(evidence: Evidence) -> Iterator[Hit]:
    """The mesh is small compared with the foreground.

    Check the units; if the mask includes shoulders, cut it below the neck.
    """
    sizes = [mesh.size for _, mesh, _ in _comparable(evidence) if mesh.size is not None]
    if sizes and np.median(sizes) < SMALL:
        yield Hit(
            f"the mesh covers {np.median(sizes):.0%} of the foreground's area (median over "
            f"{counted(len(sizes), 'frame')})",
            evidence.folder,
        )


@rule("HB704", "warning")
def _far_away(evidence: Evidence) -> Iterator[Hit]:
    """A large part of the foreground is far from the mesh, such as shoulders and clothes, which no head model explains.

    Cut it: `headbench track` and `headbench import tracking` do so by default (--cut, --parsing); for other captures read
    with `reader_settings.below_neck=false`, or mask the clothes.
    """
    if mesh_misses(evidence):
        return
    shares = [mesh.far for _, mesh, _ in _comparable(evidence) if mesh.far is not None]
    if shares and np.median(shares) > MOST_FAR:
        yield Hit(
            f"{np.median(shares):.0%} of the foreground is far from the mesh (median over {counted(len(shares), 'frame')})",
            evidence.folder,
        )


_BATCH = 32


def face_steps(evidence: Evidence) -> dict[str, tuple[list[int], FloatArray]]:
    """By sequence folder: timesteps with a pose, (n,), and mean displacement of the face's vertices between successive
    ones, metres, (n - 1,)."""
    if evidence.subject is None:
        return {}
    face = evidence.subject.head.regions.get("face", np.arange(len(evidence.subject.head.template)))
    steps = {}
    for folder, timesteps in evidence.sequences.items():
        posed = [t for t in timesteps if evidence.parameters[t].pose]
        lengths: list[float] = []
        for start in range(0, len(posed) - 1, _BATCH):
            poses = [evidence.parameters[t].pose for t in posed[start : start + _BATCH + 1]]
            points = evidence.subject.meshes([pose for pose in poses if pose])[:, face]
            lengths += np.linalg.norm(np.diff(points, axis=0), axis=2).mean(axis=1).tolist()
        steps[folder] = (posed, np.array(lengths))
    return steps


def expression_reach(evidence: Evidence) -> dict[int, float]:
    """Largest displacement of a vertex by expression coefficients alone, metres, by timestep."""
    if evidence.subject is None:
        return {}
    basis = np.asarray(evidence.subject.head.expression_basis, dtype=np.float64)
    moved = {p.timestep: basis @ p.pose.expression.astype(np.float64) for p in evidence.posed if p.pose}
    return {timestep: float(np.linalg.norm(by, axis=1).max()) for timestep, by in moved.items()}
