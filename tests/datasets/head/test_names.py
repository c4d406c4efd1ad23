"""Names of expressions of head models."""

from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.contracts import HeadPose
from headbench.bench.errors import InputError
from headbench.bench.expressions import expressions_of
from headbench.datasets.head.arrays import read_head, save_head
from headbench.datasets.head.procedural.expressions import LIDS
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.head.procedural.surface import load_sculpture
from headbench.datasets.head.procedural.versions import version_shapes

from .toy import toy_head


@pytest.mark.parametrize("version", ["procedural2020", "procedural2023"])
def test_names_of_the_default_head_move_what_they_say(version):
    head = procedural_head(version)
    found = {shape.name: shape for shape in head.named_expressions()}
    shapes = version_shapes(load_sculpture(), version)
    for name, wanted in (
        ("smile", shapes["smile_left"] + shapes["smile_right"]),
        ("mouth sideways", shapes["mouth_left"] - shapes["mouth_right"]),
        ("pucker", shapes["pucker"]),
    ):
        moved = head.expression_basis @ found[name].direction
        assert np.abs(moved - wanted).max() < 0.05 * np.abs(wanted).max() + 1e-5
    assert ("blink" in found) == (version == "procedural2023")
    assert {*LIDS}.isdisjoint(found)


def test_the_strongest_expressions_come_first():
    head = procedural_head()
    found = expressions_of(head, 6, ())
    moved = [np.linalg.norm(head.expression_basis @ shape.direction, axis=1).max() for shape in found]
    assert moved == sorted(moved, reverse=True)
    assert len(found) == 6


def test_models_without_names_have_single_coefficients():
    head = toy_head(16)
    size = head.expression_basis.shape[2]
    none = np.zeros(3)
    largest = np.linspace(0.1, 0.2, size)
    pose = HeadPose(head.version, -largest, none, none, none, np.zeros(6), none)
    for shape in expressions_of(head, size, [pose]):
        number = int(shape.direction.argmax())
        assert shape.name == f"expression {number + 1}"
        assert shape.high == -shape.low == pytest.approx(1.5 * largest[number], abs=1e-4)


def test_names_are_kept_in_files_and_sides_are_paired(tmp_path):
    head = toy_head(16)
    size = head.expression_basis.shape[2]
    names = ("frown_L", "frown_R", *(f"shape{number}" for number in range(size - 2)))
    save_head(tmp_path / "head.npz", replace(head, expression_names=names))
    read = read_head(tmp_path / "head.npz")
    assert read.expression_names == names
    first, *others = read.named_expressions()
    assert first.name == "frown"
    assert first.direction.tolist() == [1.0, 1.0] + [0.0] * (size - 2)
    assert len(others) == size - 2
    with pytest.raises(InputError, match="expression_names"):
        replace(head, expression_names=names[1:]).validate("head")
