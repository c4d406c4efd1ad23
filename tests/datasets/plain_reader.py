"""A reader as somebody outside writes it: a layout of its own, and clips that have what `Clip` asks for and no more."""

from pathlib import Path
from types import SimpleNamespace

from headbench import DatasetSpec, exclude_given
from headbench.datasets.ga.reader import read_capture

HEAD = [
    *("version", "template", "faces", "shape_basis", "expression_basis", "pose_basis", "joint_regressor"),
    *("skinning_weights", "parents", "eyelid_basis", "regions"),
]


class PlainClip:
    """A clip that shares nothing with headbench's own but the arrays."""

    def __init__(self, clip):
        self.subject, self.cameras, self.poses = clip.subject, clip.cameras, clip.poses
        self.shape, self.static_offset, self.background = clip.shape, clip.static_offset, clip.background
        self.splits, self.excluded, self.steps = dict(clip.splits), dict(clip.excluded), ()
        self.head = SimpleNamespace(**{name: getattr(clip.head, name) for name in HEAD})
        self.fingerprint = f"plain-{clip.fingerprint}"
        self.image, self.mask = clip.image, clip.mask


def find(root):
    return sorted(Path(root).glob("*.plain"))


def read(path, *, exclude: Path | None = None):
    """A file names the capture that holds the frames."""
    clip = PlainClip(read_capture(Path(path).read_text()))
    return clip if exclude is None else exclude_given(clip, exclude)


SPEC = DatasetSpec("plain", "Captures named in text files.", "plain_reader:read", find="plain_reader:find")
