"""Options of tracking a video file."""

from __future__ import annotations

from dataclasses import dataclass

from ..options import Cut

MASKLESS, BACKGROUND = "none", "background"
"""Values of --masks that are no folder."""


@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options of `headbench track` for a video file; without effect on captures."""

    segmentation: str = ""
    """Video: MediaPipe's selfie_segmentation.tflite, which finds the person in each frame; default without --masks: that of
    --fetch-networks."""

    masks: str = ""
    """Video: folder of masks instead, of the video's size, named by the number of the frame in the file (00000.png or 0000.jpg is
    the first frame, also where --rate takes fewer); "background" for the difference from the empty room, which a static camera must show
    for some seconds without a person; or "none" to keep the room behind the person, which then counts in every metric."""

    cut: Cut = "bust-line"
    """Video: part of the person that is replaced by background, since no head model explains it: all below a line through the
    front of the neck's lower end, as VHAP's export does, or nothing."""

    parsing: str = ""
    """Video: folder of label images (19 classes of CelebAMask-HQ) named as --masks: clothes are cut by them instead."""

    focal: float | None = None
    """Video: focal length in pixels of its upright frames; default: estimated from the landmarks, which is inexact."""

    rate: float = 25.0
    """Video: maximum frame rate; frames of a faster video are skipped."""

    longest: int | None = None
    """Video: maximum number of frames that are used, from its beginning; default: all."""

    size: int = 512
    """Video: longest side of the frames after a crop around the head, pixels; smaller frames are not enlarged."""

    subject: str = ""
    """Video: name of the subject; default: that of the file."""

    held_out_frames: int | None = None
    """Video: number of last frames held out for self-reenactment; default: 350, or a quarter of fewer than 700."""

    def check_video(self) -> None:
        """Raise `ValueError` for a value out of range."""
        if self.focal is not None and not self.focal > 0:
            raise ValueError(f"focal is {self.focal}; more than 0")
        if not 1 <= self.rate <= 240:
            raise ValueError(f"rate is {self.rate}; from 1 to 240")
        if not 64 <= self.size <= 4096:
            raise ValueError(f"size is {self.size}; from 64 to 4096")
        if self.longest is not None and self.longest < 1:
            raise ValueError(f"longest is {self.longest}; at least 1")
