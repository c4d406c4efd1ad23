"""Read a tracked video as a clip: one camera, the last frames held out for self-reenactment, no novel views.

The layouts are those of `insta` and `imavatar`. VHAP's monocular export has GaussianAvatars' layout and is
read by the reader ``ga``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from ...bench.contracts import Progress, no_progress
from ...bench.errors import InputError
from ...bench.io.files import check_name, entries
from ..clip import CaptureClip
from ..ga.layout import DECLARATION_FILE, HEAD_FILE, Declaration
from ..ga.tracking import TeethPolicy, find_head
from ..head.arrays import HeadArrays
from ..steps.exclude import exclude_given, exclude_timesteps
from .clip import WHITE, clip_of_track
from .imavatar import PARAMETERS, read_imavatar, videos
from .insta import is_insta, read_insta
from .track import Track


def find_videos(root: Path) -> list[Path]:
    """Subjects under ``root``: the folder itself, or its subfolders; an IMavatar subject contains its videos."""
    if is_insta(root) or videos(root):
        return [root]
    if not root.is_dir():
        return []
    below = [path for path in entries(root) if path.is_dir()]
    return [path for path in below if is_insta(path) or (not (path / PARAMETERS).exists() and videos(path))]


def read_video(
    path: str | Path,
    *,
    head: HeadArrays | str | Path | None = None,
    masks: str | Path | None = None,
    regions: str | Path | None = None,
    eyelids: str | Path | None = None,
    subject: str = "",
    teeth: TeethPolicy = "auto",
    background: Sequence[float] | None = None,
    held_out_frames: int | None = None,
    held_out_sequences: Sequence[str] = (),
    exclude: Mapping[int, str] | str | Path | None = None,
    cache_mb: float = 512.0,
    use_cache: bool = True,
    progress: Progress = no_progress,
) -> CaptureClip:
    """Read a tracked video, or all videos of one subject in IMavatar's layout.

    Timesteps number the frames in the order of their names, one video after the other. Held-out frames of a training
    video become a separate sequence, ``video-held-out``.

    Parameters
    ----------
    head, masks, regions, eyelids : HeadArrays | str | Path | None
        Head model that the video was tracked with, usually FLAME 2020, and the files that belong to it, which are
        found beside it.
    subject : str
        Subject id; "" takes it from ``headbench.json`` or the folder's name.
    teeth : TeethPolicy
        As for the reader ``ga``.
    background : Sequence[float] | None
        (r, g, b) in [0, 1] that straight alpha and masked images are composited on; None takes the
        declared one, else white.
    held_out_frames : int | None
        Number of last frames for self-reenactment. None takes the split of the folder, else 350, or a
        quarter of a video with fewer than 700 frames.
    held_out_sequences : Sequence[str]
        Names of the videos for self-reenactment, instead of the last frames.
    exclude, cache_mb, use_cache : Mapping[int, str] | str | Path | None, float, bool
        As for the reader ``ga``.
    """
    root = Path(os.path.abspath(path))
    declaration = Declaration.read(root)
    asset = _find_head(root, declaration, head, masks=masks, regions=regions, eyelids=eyelids)
    track = _read_track(root, asset, progress)
    subject = check_name(subject or (declaration.subject if declaration else root.name), root, "subject")
    clip = clip_of_track(
        root,
        track,
        asset,
        subject=subject,
        teeth=teeth,
        background=(declaration.background if declaration else WHITE) if background is None else background,
        held_out_frames=held_out_frames,
        held_out_sequences=held_out_sequences,
        files={root / DECLARATION_FILE} if declaration else set(),
        cache_mb=cache_mb,
        use_cache=use_cache,
        progress=progress,
    )
    if declaration and declaration.excluded:
        clip = exclude_timesteps(clip, declaration.excluded, source=root / DECLARATION_FILE)
    return exclude_given(clip, exclude)


def _find_head(
    root: Path,
    declaration: Declaration | None,
    head: HeadArrays | str | Path | None,
    **files: str | Path | None,
) -> HeadArrays:
    if head is None and declaration is None and not (root / HEAD_FILE).exists():
        raise InputError(
            root,
            "head",
            f"the head model that the video was tracked with, or {HEAD_FILE} in the folder",
            "none",
            "Give it as head= (`headbench run`: --head): Metrical Tracker and IMavatar track with FLAME 2020, "
            "generic_model.pkl from https://flame.is.tue.mpg.de.",
        )
    return find_head(root, declaration, head, **files)


def _read_track(root: Path, head: HeadArrays, progress: Progress) -> Track:
    if is_insta(root):
        return read_insta(root, head, progress)
    if videos(root):
        return read_imavatar(root, head, progress)
    expected = f"INSTA's folder (transforms_train.json, flame/exp) or IMavatar's ({PARAMETERS})"
    raise InputError(root, "", expected, "neither")
