"""Numbering of renders in the official repositories (`MethodSpec.renders`, ``headbench evaluate --names``).

Formats read:

- Renders of GaussianAvatars. Written by ShenhanQian/GaussianAvatars 30cc4bde (`render.py`). Not checked on a file of the
  program.
- Renders of GaussianBlendshapes. Written by zjumsj/GaussianBlendshapes a0ab7c01 (`test.py`). Not checked on a file of the
  program.
- Renders of INSTA. Written by Zielon/INSTA 0c06b701 (`src/rta/recorder.cu`). Not checked on a file of the program.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from ...bench.audit.naming import MAP_REMEDY, Listing, Render, Renders, every_frame
from ...bench.contracts import Clip, FrameKey
from ...bench.errors import InputError


def _numbered(folder: Path, prefix: str, count: Sequence[int], of: str) -> list[Path]:
    """Images ``<prefix>00000.png`` and following in a folder; their number must be one of ``count``."""
    pattern = re.compile(re.escape(prefix) + r"(\d{5,})\.png")
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := pattern.fullmatch(path.name)))
    if len(numbers) not in count or numbers != [*range(len(numbers))]:
        wanted = " or ".join(map(str, sorted(set(count))))
        last = f", {prefix}{numbers[0]:05d}.png to {prefix}{numbers[-1]:05d}.png" if numbers else ""
        expected = f"{wanted} images, {prefix}00000.png and on, one for each frame of {of}"
        remedy = f"Render the whole split again with all cameras. {MAP_REMEDY}"
        raise InputError(folder, "", expected, f"{len(numbers)}{last}", remedy)
    return [folder / f"{prefix}{number:05d}.png" for number in numbers]


def _latest(folder: Path, stem: str) -> Path | None:
    """The folder ``<stem>_<iterations>`` with the most iterations, the default of the repositories."""
    made = {
        int(match[1]): path
        for path in (folder.iterdir() if folder.is_dir() else ())
        if (match := re.fullmatch(rf"{stem}_(\d{{1,9}})", path.name)) and path.is_dir()
    }
    return made[max(made)] if made else None


def gaussian_avatars(folder: Path, clip: Clip, listing: Listing) -> Renders:
    """``{train,val,test}/ours_<iterations>/renders/<index>.png``, in the order of ``transforms_<split>.json``."""
    if not listing:
        expected = "a capture in the GaussianAvatars/VHAP layout, whose files give the order"
        raise InputError("command line", "--names", expected, f"another for {clip.subject}", MAP_REMEDY)
    known = {(key.timestep, key.camera): key for key in every_frame(clip)}
    found: Renders = {}
    for split, frames in listing.items():
        made = _latest(folder / split, "ours")
        if made is None or not (made / "renders").is_dir():
            continue
        images = _numbered(made / "renders", "", [len(frames)], f"transforms_{split}.json")
        for frame, image in zip(frames, images):
            if frame in known:
                found[known[frame]] = Render(image, truth=made / "gt" / image.name)
    if not found:
        expected = "test/ours_N/renders or val/ours_N/renders, as render.py leaves them in the model's folder"
        raise InputError(folder, "", expected, "neither")
    return found


GBS_TEST_FRAMES = 350


def gaussian_blendshapes(folder: Path, clip: Clip, listing: Listing) -> Renders:
    """``test/split_<iterations>/pred_<index>.png``: the last 350 frames; ``seq/...``: all of them. On black."""
    frames = _of_one_camera(clip, every_frame(clip))
    found: Renders = {}
    for name, numbered in (("seq", frames), ("test", frames[-GBS_TEST_FRAMES:])):
        made = _latest(folder / name, "split")
        if made is None:
            continue
        of = "the capture" if name == "seq" else f"its last {GBS_TEST_FRAMES}"
        images = _numbered(made, "pred_", [len(numbered)], of)
        for key, image in zip(numbered, images):
            mask, truth = (made / image.name.replace("pred_", other) for other in ("pred_mask_", "gt_"))
            found[key] = Render(image, mask, truth)
    if not found:
        raise InputError(folder, "", "test/split_N, as test.py leaves it in the model's folder", "none")
    return found


def insta(folder: Path, clip: Clip, listing: Listing) -> Renders:
    """``overlay/<index>.png`` in its output folder: the test split, in the order of mesh names, on black."""
    held_out = {key.sequence for key in clip.splits["self_reenactment"]}
    frames = _of_one_camera(clip, [key for key in every_frame(clip) if key.sequence in held_out])
    made = folder / "overlay"
    if not made.is_dir():
        expected = "overlay, as the program leaves it in experiments/CONFIG/debug of the video's folder"
        raise InputError(folder, "", expected, "none")
    images = _numbered(made, "", [len(frames)], "transforms_test.json")
    return {key: Render(image, image) for key, image in zip(frames, images)}


def _of_one_camera(clip: Clip, keys: Iterable[FrameKey]) -> list[FrameKey]:
    """Frames in order. Raises `InputError` if their timesteps do not determine the order."""
    frames = sorted(keys, key=lambda key: (key.timestep, key.camera))
    repeated = [t for t, n in Counter(key.timestep for key in frames).items() if n > 1]
    if repeated:
        expected = "a capture of one camera, whose timesteps give the order"
        found = f"several frames at timestep {repeated[0]}"
        raise InputError(f"clip {clip.subject}", "cameras", expected, found, MAP_REMEDY)
    return frames
