"""HB2xx: what is held out and seen in training all the same."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import combinations

from ..ga.transforms import FrameEntry
from .checks_images import unit_range
from .evidence import Evidence
from .rules import Hit, Rule, several, some, spans
from .thumbnails import Thumbnail, near_duplicates


def _same_images(evidence: Evidence) -> Iterator[Hit]:
    """By content, hence also where one file is listed twice."""
    contents: dict[str, dict[str, FrameEntry]] = {}
    for split, part in evidence.splits.items():
        held = contents.setdefault(split, {})
        for entry in part:
            if entry.image in evidence.digests:
                held.setdefault(evidence.digests[entry.image], entry)
    for one, other in combinations(contents, 2):
        shared = sorted(contents[one].keys() & contents[other].keys())
        if shared:
            first, second = contents[one][shared[0]], contents[other][shared[0]]
            yield Hit(
                f"{several(len(shared), 'image')} in both {one} and {other}, such as {first.image.name} of "
                f"{evidence.names[first.sequence_folder]} ({first.where} of {first.file.name})",
                second.file,
                second.where,
            )


def _near_images(evidence: Evidence) -> Iterator[Hit]:
    if unit_range(evidence):
        return  # levels 0 and 1 are all nearly the same
    parts: dict[str, list[Thumbnail]] = defaultdict(list)
    for thumbnail in evidence.thumbnails:
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
                f"{several(len({second.entry.image for _, second in pairs}), 'image')} of {other} look the same "
                f"as one of {one}, such as {b.image.name} of {evidence.names[b.sequence_folder]} and "
                f"{a.image.name} of {evidence.names[a.sequence_folder]}",
                b.image,
            )


def _test_timesteps(evidence: Evidence) -> Iterator[Hit]:
    train = {entry.timestep for entry in evidence.splits.get("train", ())}
    test = {entry.timestep: entry for entry in evidence.splits.get("self_reenactment", ())}
    shared = train & test.keys()
    if shared:
        entry = test[min(shared)]
        yield Hit(
            f"self-reenactment timesteps {spans(shared)} are training timesteps too", entry.file, entry.where
        )


def _test_cameras(evidence: Evidence) -> Iterator[Hit]:
    train = {entry.camera_id for entry in evidence.splits.get("train", ())}
    held_out = {entry.camera_id: entry for entry in evidence.splits.get("novel_view", ())}
    shared = sorted(train & held_out.keys())
    if shared:
        entry = held_out[shared[0]]
        yield Hit(f"novel-view cameras {some(shared)} are training cameras too", entry.file, entry.where)


def _twice(evidence: Evidence) -> Iterator[Hit]:
    for split, part in evidence.splits.items():
        seen: set[tuple[int, str]] = set()
        twice = []
        for entry in part:
            slot = (entry.timestep, entry.camera_id)
            if slot in seen:
                twice.append(entry)
            seen.add(slot)
        if twice:
            yield Hit(
                f"{several(len(twice), 'frame')} of {split} stand there twice, such as timestep "
                f"{twice[0].timestep} of camera {twice[0].camera_id}",
                twice[0].file,
                twice[0].where,
            )


RULES = (
    Rule(
        "HB201",
        "error",
        "the same image is in two splits",
        "Take it out of one: a method is measured on what it was trained on.",
        _same_images,
    ),
    Rule(
        "HB202",
        "warning",
        "images of two splits are nearly the same",
        "Look at the pair; where one is the other saved anew or shifted by a frame, mend the split.",
        _near_images,
    ),
    Rule(
        "HB203",
        "error",
        "self-reenactment timesteps are trained on",
        "Hold out whole sequences, in all cameras.",
        _test_timesteps,
    ),
    Rule(
        "HB204",
        "error",
        "novel-view cameras are trained on",
        "Hold out the camera in every training sequence.",
        _test_cameras,
    ),
    Rule(
        "HB205",
        "error",
        "a frame stands twice in one split",
        "Delete the second entry: it would be trained on or counted twice.",
        _twice,
    ),
)
