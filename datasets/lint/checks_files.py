"""HB1xx: existing and missing files. HB2xx: held-out data in training."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from itertools import combinations, pairwise

from ...bench.errors import InputError
from ...bench.io.files import entries
from ...bench.progress import counted, some
from ..ga import layout
from ..ga.transforms import FrameEntry
from .capture import Slot
from .checks_images import unit_range
from .checks_rig import dead_cameras
from .evidence import Evidence
from .rules import Hit, at, rule, spans
from .views import Thumbnail, near_duplicates

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

GA_WIDTH = 1600
"""Wider images are rescaled by the code of GaussianAvatars by default."""


def _faults(errors: Iterable[InputError], noun: str) -> Iterator[Hit]:
    """One hit for faults of one kind: same key and same expectation, in any file."""
    groups: dict[tuple[str, str], list[InputError]] = defaultdict(list)
    for error in errors:
        groups[(error.key.rpartition(".")[2], error.expected)].append(error)
    for (_, expected), group in groups.items():
        first = group[0]
        more = f" ({counted(len(group), noun)} like it)" if len(group) > 1 else ""
        yield Hit(f"expected {expected}, found {first.found}{more}", first.file, first.key)


@rule("HB100", "error", of_layout=True, refused=True)
def _refused(evidence: Evidence) -> Iterator[Hit]:
    """The reader refuses the capture.

    Fix the other findings first; `headbench run` stops at this one.
    """
    # Faults reported by another rule are skipped (see `apply` for those at the same place).
    error = evidence.faults[0].error if evidence.faults else None
    reported = not {"HB103", "HB116"} & {*evidence.settings.ignore}
    missing = error is not None and any(str(fault.file) in error.found for fault in evidence.file_faults)
    missing = missing and reported
    if error is not None and not missing:
        text = f"expected {error.expected}, found {error.found}"
        yield Hit(f"{text}. {error.remedy}" if error.remedy else text, error.file, error.key)


@rule("HB101", "error", of_layout=True, refused=True)
def _broken_json(evidence: Evidence) -> Iterator[Hit]:
    """A JSON of the capture is missing or broken.

    Export the capture again, or restore the file.
    """
    yield from _faults([*evidence.faults.errors("json"), *evidence.faults.errors("declaration")], "file")


@rule("HB102", "error", of_layout=True, refused=True)
def _broken_frame(evidence: Evidence) -> Iterator[Hit]:
    """A frame's entry is incomplete or of the wrong kind.

    Export the capture again, or fix the entry.
    """
    errors = evidence.faults.errors("frame")
    yield from _faults((e for e in errors if not e.key.endswith(".transform_matrix")), "frame")


@rule("HB103", "error")
def _missing_file(evidence: Evidence) -> Iterator[Hit]:
    """A file is missing, truncated or damaged.

    Copy or export the file again; interrupted copies leave such files.
    """
    groups: dict[tuple[str, str], list[InputError]] = defaultdict(list)
    elsewhere = _absolute_elsewhere(evidence)
    for error in evidence.file_faults:
        if str(error.file) not in elsewhere:
            groups[(error.expected, error.found)].append(error)
    for (expected, found), group in groups.items():
        count = f" ({counted(len(group), 'file')})" if len(group) > 1 else ""
        yield Hit(f"expected {expected}, found {found}{count}", group[0].file)
    damaged = [view.error for view in evidence.views if view.error is not None]
    if damaged:
        yield Hit(f"{counted(len(damaged), 'image')} do not decode: {damaged[0].found}", damaged[0].file)
    paths = {
        p.path: p.error
        for p in evidence.parameters.values()
        if p.error is not None and not p.arrays and str(p.path) not in elsewhere
    }
    for error in list(paths.values())[:1]:
        yield Hit(
            f"expected {error.expected}, found {error.found} ({counted(len(paths), 'file')})", error.file
        )


def _absolute_elsewhere(evidence: Evidence) -> dict[str, tuple[FrameEntry, str]]:
    """Missing files with absolute paths, with the frame and the key that name them."""
    places: dict[str, tuple[FrameEntry, str]] = {}
    for entry in evidence.entries:
        named = {"file_path": entry.image, "fg_mask_path": entry.mask, "flame_param_path": entry.parameters}
        for key, path in named.items():
            if path is not None and not path.is_relative_to(entry.file.parent) and not os.path.exists(path):
                places.setdefault(str(path), (entry, key))
    return places


@rule("HB116", "error", of_layout=True, refused=True)
def _absolute_paths(evidence: Evidence) -> Iterator[Hit]:
    """Paths are absolute and of another machine.

    Write paths relative to the folder of the JSON, such as ../SEQUENCE/images/00000_00.png, which stay valid when the
    export is copied.
    """
    places = _absolute_elsewhere(evidence)
    if places:
        path, (entry, key) = next(iter(places.items()))
        yield Hit(
            f"{counted(len(places), 'file')} named by absolute paths that this machine does not have, such as {path}",
            *at(entry, key),
        )


@rule("HB104", "error", of_layout=True, refused=True)
def _wrong_size(evidence: Evidence) -> Iterator[Hit]:
    """An image or mask has another size than stated.

    Scale the intrinsics and w, h with the images, or export both at one size.
    """
    wrong = []
    for entry in evidence.entries:
        image = evidence.headers.get(entry.image)
        for path in (entry.image, entry.mask):
            info = evidence.headers.get(path) if path is not None else None
            if info is None or image is None:
                continue
            stated = (entry.width or image.width, entry.height or image.height)
            if (info.width, info.height) != stated:
                wrong.append((path, (info.width, info.height), stated, entry))
    if wrong:
        path, size, stated, entry = wrong[0]
        yield Hit(
            f"{counted(len(wrong), 'file')} of another size than stated: {size[0]}x{size[1]} pixels where "
            f"{entry.where} of {entry.file.name} says {stated[0]}x{stated[1]}",
            path or "",
        )


@rule("HB105", "warning")
def _holes(evidence: Evidence) -> Iterator[Hit]:
    """Frames are missing from the grid of timesteps and cameras.

    Export the missing frames, or exclude the timestep with a reason.
    """
    slots = {Slot(e.timestep, e.camera_index) for e in evidence.entries} | evidence.unread
    for folder, timesteps in evidence.sequences.items():
        cameras = {e.camera_index for e in evidence.entries if e.sequence_folder == folder}
        missing = [(t, c) for t in timesteps for c in sorted(cameras) if Slot(t, c) not in slots]
        if missing:
            worst = Counter(camera for _, camera in missing).most_common(1)[0][0]
            where = spans(t for t, camera in missing if camera == worst)
            text = (
                f"{counted(len(missing), 'frame')} of sequence {evidence.names[folder]} missing from the grid of "
                f"{len(timesteps)} timesteps and {len(cameras)} cameras, such as camera {worst} at {where}"
            )
            yield Hit(text, evidence.folder, "frames")


@rule("HB106", "error", of_layout=True, refused=True)
def _gap(evidence: Evidence) -> Iterator[Hit]:
    """Timesteps are not numbered from 0 without a gap.

    Renumber timesteps: readers of the layout index parameters by them, and a gap shifts all following ones.
    """
    present = {e.timestep for e in evidence.entries} | {slot.timestep for slot in evidence.unread}
    gaps = [
        f"{before + 1}-{after - 1}" if after - before > 2 else f"{before + 1}"
        for before, after in pairwise([-1, *sorted(present)])
        if after - before > 1
    ]
    if gaps:
        yield Hit(f"no frame of timesteps {some(gaps)}", evidence.folder, "timestep_index")


@rule("HB107", "warning")
def _frozen(evidence: Evidence) -> Iterator[Hit]:
    """Timesteps repeat the images of the one before.

    Remove the repeated timesteps: frozen video counts one moment many times.
    """
    # Consecutive timesteps with identical images in every camera that has both.
    images, frozen = evidence.contents, []
    for timesteps in evidence.sequences.values():
        for before, after in pairwise(timesteps):
            shared = images[before].keys() & images[after].keys()
            if shared and all(images[before][camera] == images[after][camera] for camera in shared):
                frozen.append(after)
    if frozen:
        text = f"{counted(len(frozen), 'timestep')} with the images of the timestep before: {spans(frozen)}"
        yield Hit(text, evidence.folder, "timestep_index")


@rule("HB108", "error", of_layout=True, refused=True)
def _stray_exclusion(evidence: Evidence) -> Iterator[Hit]:
    """An exclusion names a timestep that does not exist.

    Correct the timestep: it was probably numbered within a sequence, or before timesteps were renumbered.
    """
    if evidence.declaration is None:
        return
    timesteps = {e.timestep for e in evidence.entries} | {slot.timestep for slot in evidence.unread}
    stray = sorted(set(evidence.declaration.excluded) - timesteps)
    if stray:
        file = evidence.folder / layout.DECLARATION_FILE
        yield Hit(f"timesteps {spans(stray)} are excluded and not in the capture", file, "excluded")


@rule("HB109", "warning", of_layout=True)
def _unreasoned(evidence: Evidence) -> Iterator[Hit]:
    """Frames are excluded without a reason.

    State the reason in headbench.json, so that a reader of the results can judge it.
    """
    if evidence.declaration is None:
        return
    unreasoned = [t for t, reason in evidence.declaration.excluded.items() if not reason.strip()]
    if unreasoned:
        file = evidence.folder / layout.DECLARATION_FILE
        yield Hit(f"timesteps {spans(unreasoned)} are excluded without a reason", file, "excluded")


@rule("HB110", "warning")
def _short_test(evidence: Evidence) -> Iterator[Hit]:
    """A test sequence is short.

    Hold out a longer sequence: a mean over a few timesteps is unreliable, and official code of GaussianAvatars
    fails with fewer than 10 test frames.
    """
    excluded = set(evidence.declaration.excluded) if evidence.declaration else set()
    least = evidence.settings.min_test_timesteps
    timesteps: dict[str, set[int]] = defaultdict(set)
    for entry in evidence.splits.get("self_reenactment", ()):
        timesteps[entry.sequence_folder].add(entry.timestep)
    for folder, present in timesteps.items():
        count = len(present - excluded)
        if count < least:
            left_out = f" ({len(present & excluded)} excluded)" if present & excluded else ""
            yield Hit(
                f"test sequence {evidence.names[folder]} has {counted(count, 'timestep')}{left_out}, "
                f"fewer than {least}",
                evidence.split_file("self_reenactment"),
            )


@rule("HB111", "warning")
def _empty_split(evidence: Evidence) -> Iterator[Hit]:
    # An unreadable file, or one with unreadable frames, is another fault.
    """A split is empty. A video of one camera has no novel views to hold out.

    Hold out a camera for novel views and a sequence for self-reenactment.
    """
    cameras = {entry.camera_id for entry in evidence.entries}
    needed = [name for name in layout.SPLIT_FILES if name != "novel_view" or len(cameras) > 1]
    faulty = {error.file for error in evidence.faults.errors("json", "frame")}
    files = {name: evidence.split_file(name) for name in needed}
    empty = [
        name for name, path in files.items() if not evidence.splits.get(name) and str(path) not in faulty
    ]
    if empty:
        yield Hit(f"no frames in {some(empty)}", files[empty[0]], "frames")


@rule("HB112", "note", of_layout=True)
def _undeclared(evidence: Evidence) -> Iterator[Hit]:
    """The capture does not declare its conventions.

    Write headbench.json beside the JSONs (its keys are listed in the documentation under "Captures and head models"), so that
    nothing has to be inferred.
    """
    if evidence.declaration is None and not evidence.faults.errors("declaration"):
        yield Hit(
            "no declaration of background, head model, principal point and sequence names: white, the given "
            "head, the images' own evidence and the folders' names are taken",
            evidence.folder / layout.DECLARATION_FILE,
        )


@rule("HB113", "note", of_layout=True)
def _orphans(evidence: Evidence) -> Iterator[Hit]:
    """Images are in no split.

    Delete them, or add them to a split if they should be used.
    """
    named = {entry.image for entry in evidence.entries if os.path.exists(entry.image)}
    folders = {entry.image.parent for entry in evidence.entries}
    # Frames that do not parse refer to unknown images.
    if evidence.faults.errors("json", "frame"):
        return
    resolved = {path.resolve() for path in named}
    orphans = sorted(
        path
        for folder in folders
        if folder.is_dir()
        for path in entries(folder)
        if path.suffix.lower() in IMAGE_SUFFIXES and path.resolve() not in resolved
    )
    if orphans:
        yield Hit(f"{counted(len(orphans), 'image')} that no split names", orphans[0])


@rule("HB114", "warning")
def _uneven_masks(evidence: Evidence) -> Iterator[Hit]:
    """Some frames have a mask and some have none.

    Export all masks: regions and masked metrics would cover only a part of the frames.
    """
    unmasked = [entry for entry in evidence.entries if entry.mask is None]
    share = len(unmasked) / max(1, len(evidence.entries))
    if 0 < share < 1:
        text = f"{counted(len(unmasked), 'frame')} of {len(evidence.entries)} name no mask, the others do"
        yield Hit(text, *at(unmasked[0], "fg_mask_path"))


@rule("HB115", "note")
def _size_limit(evidence: Evidence) -> Iterator[Hit]:
    """Images are wider than GaussianAvatars' limit.

    Its code rescales images wider than 1,600 pixels without -r 1; align the size beforehand.
    """
    wide = [path for path, info in evidence.headers.items() if info.width > GA_WIDTH]
    if wide:
        info = evidence.headers[wide[0]]
        yield Hit(
            f"{counted(len(wide), 'file')} wider than {GA_WIDTH} pixels, such as {info.width}x{info.height}",
            wide[0],
        )


@rule("HB201", "error")
def _same_images(evidence: Evidence) -> Iterator[Hit]:
    """The same image is in two splits.

    Remove it from one: a method would be evaluated on its training data.
    """
    # By content, which includes files that are listed twice.
    dead = dead_cameras(evidence)  # all of their images are the same
    contents: dict[str, dict[str, FrameEntry]] = {}
    for split, frames in evidence.splits.items():
        images = contents.setdefault(split, {})
        for entry in frames:
            if entry.image in evidence.digests and entry.camera_id not in dead:
                images.setdefault(evidence.digests[entry.image], entry)
    for one, other in combinations(contents, 2):
        shared = sorted(contents[one].keys() & contents[other].keys())
        if shared:
            first, second = contents[one][shared[0]], contents[other][shared[0]]
            text = (
                f"{counted(len(shared), 'image')} in both {one} and {other}, such as {first.image.name} of "
                f"{evidence.names[first.sequence_folder]} ({first.where} of {first.file.name})"
            )
            yield Hit(text, second.file, second.where)


@rule("HB202", "warning")
def _near_images(evidence: Evidence) -> Iterator[Hit]:
    """Images of two splits are nearly the same.

    Inspect the pair; if one is a re-saved copy of the other or shifted by a frame, fix the split.
    """
    if unit_range(evidence):
        return  # levels 0 and 1 are all nearly the same
    parts: dict[str, list[Thumbnail]] = defaultdict(list)
    dead = dead_cameras(evidence)
    for thumbnail in evidence.thumbnails:
        if thumbnail.entry.camera_id not in dead:
            parts[thumbnail.split].append(thumbnail)
    for one, other in combinations(parts, 2):
        pairs = [
            (a, b)
            for a, b in near_duplicates(parts[one], parts[other])
            if evidence.digests.get(a.entry.image) != evidence.digests.get(b.entry.image)
        ]
        if pairs:
            a, b = (thumbnail.entry for thumbnail in pairs[0])
            yield Hit(
                f"{counted(len({second.entry.image for _, second in pairs}), 'image')} of {other} look the same "
                f"as one of {one}, such as {b.image.name} of {evidence.names[b.sequence_folder]} and "
                f"{a.image.name} of {evidence.names[a.sequence_folder]}",
                b.image,
            )


@rule("HB203", "error")
def _test_timesteps(evidence: Evidence) -> Iterator[Hit]:
    """Self-reenactment timesteps are trained on.

    Hold out whole sequences, in all cameras.
    """
    train = {entry.timestep for entry in evidence.splits.get("train", ())}
    test = {entry.timestep: entry for entry in evidence.splits.get("self_reenactment", ())}
    shared = train & test.keys()
    if shared:
        entry = test[min(shared)]
        yield Hit(
            f"self-reenactment timesteps {spans(shared)} are training timesteps too", entry.file, entry.where
        )


@rule("HB204", "error")
def _test_cameras(evidence: Evidence) -> Iterator[Hit]:
    """Novel-view cameras are trained on.

    Hold out the camera in every training sequence.
    """
    train = {entry.camera_id for entry in evidence.splits.get("train", ())}
    held_out = {entry.camera_id: entry for entry in evidence.splits.get("novel_view", ())}
    shared = sorted(train & held_out.keys())
    if shared:
        entry = held_out[shared[0]]
        yield Hit(f"novel-view cameras {some(shared)} are training cameras too", entry.file, entry.where)


@rule("HB205", "error")
def _twice(evidence: Evidence) -> Iterator[Hit]:
    """A frame occurs twice in one split.

    Delete the second entry: it would be trained on or counted twice.
    """
    for split, frames in evidence.splits.items():
        seen: set[tuple[int, str]] = set()
        twice = []
        for entry in frames:
            slot = (entry.timestep, entry.camera_id)
            if slot in seen:
                twice.append(entry)
            seen.add(slot)
        if twice:
            text = (
                f"{counted(len(twice), 'frame')} of {split} occur twice, such as timestep "
                f"{twice[0].timestep} of camera {twice[0].camera_id}"
            )
            yield Hit(text, twice[0].file, twice[0].where)
