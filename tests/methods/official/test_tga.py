"""What TGA's adapter has beyond GaussianAvatars': sizes fixed in their code, jaw bases, clusters, a shortest run."""

import numpy as np
import pytest

from headbench.bench.contracts import Budget
from headbench.bench.errors import InputError
from headbench.bench.io.arrays import read_npz
from headbench.datasets.steps.clusters import cluster_expressions, jaw_quaternions

from .helpers import BUDGET
from .repository import LINES_BEGIN

NAME = "tga"


def test_jaw_bases_and_clusters_are_those_of_training(exported, official_clip):
    work, _ = exported
    bases = read_npz(work.input / "sorted_jaw_poses.npz")["jaw_poses"]
    assert bases.shape == (16, 4)
    assert bases.dtype == np.float32
    timesteps = sorted({key.timestep for key in official_clip.splits["train"]})
    allowed = jaw_quaternions([official_clip.poses[t] for t in timesteps])
    allowed = np.concatenate([allowed, [[1.0, 0, 0, 0]]])
    assert np.abs(bases @ allowed.T).max(axis=1) == pytest.approx(1, abs=1e-6)
    held_out = [t for t in official_clip.poses if t not in timesteps]
    others = jaw_quaternions([official_clip.poses[t] for t in held_out])
    assert np.abs(bases @ others.T).max() < 1 - 1e-6
    labels = read_npz(work.input / "train_cluster_16.npz")["labels"]
    known = cluster_expressions(official_clip).by_timestep
    assert labels.dtype == np.int64
    assert labels.tolist() == [known[t] for t in timesteps]


def test_a_run_too_short_for_their_lines_is_refused(method, official_clip):
    with pytest.raises(InputError, match=f"more than {LINES_BEGIN}"):
        method.check(official_clip, Budget(iterations=LINES_BEGIN))
    method.check(official_clip, Budget(iterations=LINES_BEGIN + 1))


def test_a_mesh_of_another_size_than_theirs_is_refused(method, official_clip, repository):
    source = repository[0] / "scene" / "flame_gaussian_model.py"
    text = source.read_text()
    source.write_text(
        text.replace("face_center_lst = torch.zeros([T, ", "face_center_lst = torch.zeros([T, 9")
    )
    with pytest.raises(InputError, match="triangles with teeth"):
        method.check(official_clip, BUDGET)
    source.write_text("")
    with pytest.raises(InputError, match="mesh_lst"):
        method.check(official_clip, BUDGET)
