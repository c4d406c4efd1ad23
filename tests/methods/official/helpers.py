"""What the tests of official methods do with them: train, render lists, export, read back what was exported."""

from __future__ import annotations

import numpy as np
import torch

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.scoring import TrainingView
from headbench.bench.io.arrays import check_arrays
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.tracker_files.formats import METRICAL_MEMBERS, metrical_frame
from headbench.methods.official.workplace import Workplace

BUDGET = Budget(iterations=20)
WHITE = (1.0, 1.0, 1.0)


def fit(method, clip, out, progress=no_progress, *, budget=BUDGET, seed=0):
    """Train on the clip's training frames."""
    return method.fit(TrainingView(clip), out, budget, device="cpu", seed=seed, progress=progress)


def views(clip, *splits):
    """Camera and pose by key, of the frames of some splits."""
    return {k: (clip.cameras[k.camera], clip.poses[k.timestep]) for s in splits for k in clip.splits[s]}


def renders(avatar, clip, ground=WHITE):
    """Frames of the held-out view by key."""
    return dict(avatar.render_listed(views(clip, "novel_view"), ground, no_progress))


def rendered(avatar, wanted, ground=WHITE):
    """Frames of a list by key; each is there in the size of its camera, and the progress goes up to their number."""
    done = []
    found = dict(avatar.render_listed(wanted, ground, lambda count, total, note="": done.append(count)))
    assert found.keys() == wanted.keys()
    assert done == sorted(done)
    assert done[-1] == len(wanted)
    for key, (camera, _) in wanted.items():
        assert found[key].rgb.shape == (camera.height, camera.width, 3)
    return found


def export(method, clip, folder):
    """Export the clip's training frames: the place, and the images in it by key."""
    work = Workplace.at(folder, method.inspect())
    work.make()
    return work, method.export(TrainingView(clip), work, no_progress)


def pixels_of(points, camera):
    """(n, 2) projections of (n, 3) points of the world."""
    local = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    return (local @ camera.K.T)[:, :2] / local[:, 2:]


def world_points(clip, pose):
    """Points of the neutral head, and where the pose's rigid motion puts them in the world."""
    subject = PosedSubject.of(clip)
    points, motion = subject.neutral[::7], subject.motions([pose])[0]
    return points, points @ motion[:3, :3].T + motion[:3, 3]


def read_tracked(path):
    """A frame's file by torch and the formulae of the reader of the tracker's files.

    That reader has height before width, the programs that the file is for have width first.
    """
    with torch.serialization.safe_globals([np.ndarray]):
        content = torch.load(path, weights_only=True)
    arrays = {f"{part}.{k}": array for part in ("flame", "opencv") for k, array in content[part].items()}
    arrays["img_size"] = content["img_size"][::-1]
    check_arrays(path, arrays, METRICAL_MEMBERS)
    return metrical_frame(path, int(path.stem), arrays)


def check_tracked(found, clip, key, window=None):
    """A frame's file has the pose of a clip's frame; the error in pixels of its camera, for its image or a window of it."""
    camera, pose = clip.cameras[key.camera], clip.poses[key.timestep]
    shown = camera if window is None else window.camera
    assert (found.width, found.height) == (shown.width, shown.height)
    size = len(pose.expression)
    assert np.array_equal(found.expression[:size], pose.expression)
    assert found.expression.shape == (100,)
    assert not found.expression[size:].any()
    assert found.shape.shape == (300,)
    assert np.abs(found.shape[: len(clip.shape)] - clip.shape).max() < 1e-6
    for name in ("eyelids", "jaw", "eyes"):
        assert np.abs(getattr(found, name) - getattr(pose, name)).max() < 1e-6
    points, world = world_points(clip, pose)
    there = pixels_of(points, found)
    there = there if window is None else there + [window.left, window.top]
    return float(np.abs(pixels_of(world, camera) - there).max())
