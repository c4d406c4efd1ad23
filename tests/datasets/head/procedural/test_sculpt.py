"""The stored head against a new sculpture."""

import pymeshlab
import pytest

from headbench.datasets.head.procedural.sculpt import (
    SculptSettings,
    main,
)
from headbench.datasets.head.procedural.surface import load_sculpture


@pytest.mark.slow
def test_sculpting_again_gives_the_stored_head(tmp_path):
    main(SculptSettings(out=tmp_path / "again.npz"))
    again, stored = load_sculpture(tmp_path / "again.npz"), load_sculpture()
    assert len(again.faces) == pytest.approx(len(stored.faces), rel=0.02)
    meshes = pymeshlab.MeshSet()
    for surface in (again, stored):
        meshes.add_mesh(pymeshlab.Mesh(surface.vertices, surface.faces))
    for one, other in ((0, 1), (1, 0)):
        found = meshes.get_hausdorff_distance(sampledmesh=one, targetmesh=other)
        assert found["max"] < 0.001
