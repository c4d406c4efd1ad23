"""Numbers of the figures against brute force, and that the pictures show what they say."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json
from headbench.bench.io.figures import pixels
from headbench.datasets.figures import new_figure
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.inspect.command import StepsSettings, steps
from headbench.datasets.steps.figures import (
    cluster_colour,
    draw_meshes,
    draw_strips,
    find_jaw_bases,
    frontal_key,
    unposed_meshes,
)

from .clips import make_clip, with_poses


def turn_between(one, other):
    """Angle between two axis-angle rotations, degrees."""
    return np.degrees((Rotation.from_rotvec(one).inv() * Rotation.from_rotvec(other)).magnitude())


def test_jaw_numbers_are_those_of_brute_force():
    clip = make_clip(30, test=5)
    found = find_jaw_bases(clip, 6)
    jaws = np.array([clip.poses[t].jaw for t in range(30)])
    gaps = np.array([[turn_between(jaw, np.radians(base)) for base in found.angles] for jaw in jaws])
    assert np.isclose(found.largest_gap, gaps.min(axis=1).max(), atol=1e-6)
    nearest = Counter(gaps.argmin(axis=1).tolist())
    np.testing.assert_allclose(found.shares, [nearest[i] / 30 for i in range(6)])
    np.testing.assert_allclose(np.radians(found.train), jaws, atol=1e-12)
    assert len(found.held_out) == 5
    assert found.record()["leaks"] == []
    published = find_jaw_bases(make_clip(10, test=20), 5, variant="official")
    assert "held-out" in published.record()["leaks"][0]
    assert np.abs(published.angles[0]).max() == pytest.approx(180)


def test_unposed_meshes_know_no_rigid_motion_but_the_jaw():
    clip = make_clip(3)
    poses = [
        clip.poses[0],
        replace(clip.poses[0], rotation=np.ones(3), neck=np.ones(3), translation=np.ones(3)),
    ]
    meshes = unposed_meshes(clip, [*poses, replace(poses[0], jaw=poses[0].jaw + [0.3, 0, 0])])
    # Rows of a batch round alike on some processors only.
    np.testing.assert_allclose(meshes[0], meshes[1], rtol=0, atol=1e-8)
    first, second, third = draw_meshes(clip, meshes, 40, 50)
    np.testing.assert_array_equal(first, second)
    assert (first != third).any()
    assert first.shape == (50, 40, 3)


def test_the_medoids_camera_is_the_one_the_face_looks_at(clip):
    timestep = clip.timesteps("train")[0]
    cameras = {key.camera for key in clip.splits["train"] if key.timestep == timestep}
    assert len(cameras) > 1
    for name in cameras:
        towards = clip.cameras[name].center / np.linalg.norm(clip.cameras[name].center)
        turn, _ = Rotation.align_vectors([towards], [[0.0, 0.0, 1.0]])
        looking = with_poses(
            clip, rotation=lambda t, turn=turn: turn.as_rotvec(), translation=lambda t: np.zeros(3)
        )
        assert frontal_key(looking, timestep).camera == name


def test_strips_show_the_cluster_of_each_timestep_in_order():
    with new_figure(6, 2) as figure:
        axes = figure.subplots()
        draw_strips(axes, {"EMO-1": [0, 0, 1, 2], "SEN": [1, 0]})
        axes.axis("off")
        axes.set_title("")
        axes.set_position((0, 0, 1, 1))
        picture = pixels(figure) / 255
    for row, ranks in ((50, [0, 0, 1, 2]), (150, [1, 0])):
        for number, rank in enumerate(ranks):
            np.testing.assert_allclose(picture[row, 75 + 150 * number], cluster_colour(rank), atol=0.01)
    assert (picture[150, 350:] == 1).all()


def test_colours_of_sixteen_clusters_differ():
    colours = 255 * np.array([cluster_colour(rank) for rank in range(16)])
    distances = np.linalg.norm(colours[:, None] - colours, axis=2) + 1e3 * np.eye(16)
    assert distances.min() > 20


@pytest.mark.commands
@pytest.mark.parametrize("variant", ["paper", "official"])
def test_command_writes_pictures_and_numbers(pristine_capture, tmp_path, variant):
    settings = StepsSettings(str(pristine_capture.union), str(tmp_path), clusters=2, variant=variant)
    with pytest.raises(InputError, match="--clusters"):
        steps(replace(settings, clusters=0))
    assert not list(tmp_path.iterdir())
    findings = steps(settings)
    clip = read_capture(pristine_capture.union)
    stored = read_json(tmp_path / "steps.json")
    assert stored["clip"] == clip.fingerprint
    assert stored["jaw_bases"]["leaks"] == list(findings.data["jaw_bases"]["leaks"])
    assert bool(stored["jaw_bases"]["leaks"]) == (variant == "official") == ("Leak" in findings.text)
    assert sum(stored["expression_clusters"]["class_sizes"]) == len(clip.timesteps("train"))
    for name in ("jaw_bases.png", "expression_clusters.png"):
        picture = cv2.imread(str(tmp_path / name))
        assert picture is not None
        assert picture.std() > 10
