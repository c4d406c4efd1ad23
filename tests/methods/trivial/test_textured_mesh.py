"""The textured mesh: its texels, and a subject whose colours are known."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.mesh_pictures import draw_mesh
from headbench.methods.trivial.textured_mesh import TexturedMesh, _centres, _medians, texels

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_every_texel_holds_its_centre_and_points_near_it(rows):
    corners = np.array([[[1, 0, 0], [0, 1, 0], [0, 0, 1]]], float)  # where positions are barycentric weights
    centres = _centres(corners, rows)
    assert len(centres) == rows**2
    face = np.full(rows**2, 3)
    for _ in range(5):
        moved = centres + 0.2 / rows * (RNG.dirichlet([1, 1, 1], rows**2) - 1 / 3)
        np.testing.assert_array_equal(texels(face, moved, rows), 3 * rows**2 + np.arange(rows**2))
    places = texels(np.zeros(1000, int), RNG.dirichlet([0.1, 0.1, 0.1], 1000), rows)
    assert 0 <= places.min() <= places.max() < rows**2


def test_the_colour_is_the_median():
    places, values = RNG.integers(0, 7, 200), RNG.integers(0, 256, (200, 3)).astype(np.uint8)
    colors, seen = _medians(places, values, 9)
    assert seen.tolist() == [True] * 7 + [False] * 2
    for place in range(7):
        expected = np.quantile(values[places == place], 0.5, axis=0, method="lower")
        np.testing.assert_array_equal(colors[place], expected)


class Painted:
    """A clip whose images show its mesh, painted with one colour for each vertex."""

    def __init__(self, clip):
        self._clip, self._mesh = clip, PosedSubject.of(clip)
        smooth = clip.head.template @ RNG.normal(size=(3, 3))
        self._colors = (smooth - smooth.min(0)) / np.ptp(smooth, axis=0)

    def __getattr__(self, name):
        return getattr(self._clip, name)

    def image(self, key):
        (vertices,) = self._mesh.meshes([self.poses[key.timestep]])
        camera = self.cameras[key.camera]
        return draw_mesh(
            vertices, self.head.faces, camera, self._colors, shading=0.0, background=self.background
        )

    def mask(self, key):
        return None


def train(clip, folder):
    return TexturedMesh().fit(clip, folder, Budget(iterations=1), device="cpu", seed=0, progress=no_progress)


def test_a_painted_mesh_is_drawn_again(clip, tmp_path):
    painted = Painted(clip)
    avatar = train(painted, tmp_path)
    for split in ("train", "novel_view", "self_reenactment"):
        key = clip.splits[split][0]
        frame = avatar.render(clip.cameras[key.camera], clip.poses[key.timestep], clip.background)
        inside = frame.alpha == 1
        assert inside.mean() > 0.05
        gap = np.abs(frame.rgb - painted.image(key) / 255)[inside]
        assert np.median(gap) < 0.04  # a colour changes by about as much from pixel to pixel
        assert frame.alpha.min() == 0


def test_a_head_outside_of_all_pictures_is_an_error(clip, tmp_path):
    away = {t: replace(pose, translation=pose.translation + 50) for t, pose in clip.poses.items()}
    with pytest.raises(InputError, match="headbench lint"):
        train(replace(clip, poses=away), tmp_path)
