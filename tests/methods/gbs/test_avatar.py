"""The avatar's file: what goes in comes out, what it costs, what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from headbench.bench.errors import InputError
from headbench.methods.gbs.blendshapes import (
    EXPRESSIONS,
    MEMBERS,
    Entries,
    difference_widths,
    stored_of,
    write_avatar,
)
from headbench.methods.shared.avatar_files import AVATAR_FILE
from headbench.methods.shared.surface_points import SurfacePoints, full_barycentric
from headbench.methods.shared.tensor_files import read_safetensors

FACES, EXPRESSION_SIZE = 40, 60
PUBLISHED_BYTES = 4 * 3128  # what the authors' viewer reads for each splat


def write(path, count=30, expressions=50, degree=3, difference_degree=3, share=0.4):
    """A random avatar; returns what was written."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    rest = (degree + 1) ** 2 - 1
    widths = {
        "means": (3,),
        "log_scales": (3,),
        "quats": (4,),
        "opacities": (),
        "sh_dc": (3,),
        "sh_rest": (3, rest),
    }
    neutral = {name: normal(count, *shape) for name, shape in widths.items()}
    moved_by = torch.rand(count, expressions, generator=generator) < share
    owners, moving = moved_by.nonzero().unbind(1)
    entries = Entries.of(moved_by.sum(1), moving, torch.ones(len(owners)))
    differences = normal(len(owners), sum(difference_widths(difference_degree).values()))
    rng = np.random.default_rng(0)
    inside = rng.dirichlet(np.ones(3), count)[:, 1:].astype(np.float32)
    points = SurfacePoints(rng.integers(0, FACES, count), full_barycentric(inside))
    write_avatar(path, neutral, points, expressions, entries, differences)
    return neutral, points, entries, differences


def read(path):
    head = SimpleNamespace(faces=range(FACES), expression_basis=np.zeros((1, 3, EXPRESSION_SIZE)))
    return stored_of(path, *read_safetensors(path), head, "cpu")


@pytest.mark.parametrize(("degree", "difference_degree"), [(3, 3), (3, 0), (2, 1), (0, 0)])
def test_everything_comes_back_to_the_bit(tmp_path, degree, difference_degree):
    path = tmp_path / AVATAR_FILE
    degrees = {"degree": degree, "difference_degree": difference_degree}
    neutral, points, entries, differences = write(path, expressions=37, **degrees)
    found = read(path)
    assert found.expressions == 37
    assert set(found.neutral) == set(neutral)
    for name, value in neutral.items():
        assert torch.equal(found.neutral[name], value), name
    assert torch.equal(found.differences, differences)
    for one, other in zip(found.entries, entries):
        assert torch.equal(one, other)
    np.testing.assert_array_equal(found.points.triangles, points.triangles)
    np.testing.assert_array_equal(found.points.barycentric, points.barycentric)


@pytest.mark.parametrize(("share", "moving"), [(1.1, 50), (-1.0, 0)], ids=["all expressions", "none"])
def test_bytes_of_a_splat_are_fewer_than_published(tmp_path, share, moving):
    sizes = []
    for count in (100, 300):
        write(tmp_path / "x", count, share=share)
        sizes.append((tmp_path / "x").stat().st_size)
    per_splat = (sizes[1] - sizes[0]) / 200
    assert per_splat == pytest.approx(4 * 59 + 12 + 7 + moving * 4 * 59, abs=0.2)
    assert per_splat < PUBLISHED_BYTES


def cut(name):
    return lambda tensors: tensors.update({name: tensors[name][:-1].contiguous()})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        *((cut(name), "x") for name in MEMBERS),
        *((lambda t, name=name: t.pop(name), name) for name in MEMBERS),
        (lambda t: t["splats"].__setitem__((0, 0), float("nan")), "splats"),
        (lambda t: t["differences"].__setitem__((0, 0), float("inf")), "differences"),
        (lambda t: t["triangles"].__setitem__(0, FACES), "triangles"),
        (lambda t: t["triangles"].__setitem__(0, -1), "triangles"),
        (lambda t: t.update(triangles=t["triangles"].float()), "triangles"),
        (lambda t: t.update(splats=t["splats"].double()), "splats"),
        (lambda t: t.update(splats=t["splats"][:, :-1].contiguous()), "splats"),
        (lambda t: t.update(differences=t["differences"][:, :-1].contiguous()), "differences"),
        (lambda t: t["moved_by"].__setitem__((0, 0), 255 - t["moved_by"][0, 0]), "differences"),
        *((said, "expressions|moved_by") for said in ("", "-3", "fifty", "61", "20")),
    ],
)
def test_tensors_and_texts_that_cannot_be_are_refused(tmp_path, change, says):
    path = tmp_path / "x"
    write(path)
    tensors = load_file(path)
    if callable(change):
        change(tensors)
    save_file(tensors, path, {EXPRESSIONS: "50" if callable(change) else change})
    with pytest.raises(InputError, match=says):
        read(path)
