"""The compiled kernel against its twins in torch, in float64, for every instruction set of this machine."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.methods.ours.field import canonical_directions, offset_network, shade_directions
from headbench.methods.ours.inference import SAMPLES, direction_table
from headbench.methods.shared import avatar_kernel
from headbench.methods.shared.binding import Frames, to_world, triangle_frames
from headbench.methods.shared.networks import sh_to_rgb
from headbench.methods.splats.cpu import instruction_sets

BACKENDS = list(instruction_sets()) if avatar_kernel.available() else []
needs_kernel = pytest.mark.skipif(not BACKENDS, reason="no compiled kernel here, or an old one")
backends = pytest.mark.parametrize("backend", BACKENDS or ["cpu"])

COUNTS = st.sampled_from([0, 1, 3, 8, 15, 16, 17, 33, 1025])


def numbers(seed):
    generator = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(*shape, generator=generator)


def mesh(normal, triangles):
    """Frames of separate triangles, in float32."""
    corners = normal(3 * triangles, 3)
    return triangle_frames(corners, torch.arange(3 * triangles).view(-1, 3))


def double(frames):
    return Frames(*(value.double() for value in frames))


def unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=1)


@needs_kernel
@backends
@settings(max_examples=20, deadline=None)
@given(count=COUNTS, seed=st.integers(0, 1000))
def test_frames_of_triangles_are_those_of_their_definition(backend, count, seed):
    """Turned any way, so that each of the quaternion's four numbers is the largest somewhere."""
    vertices = 0.1 * numbers(seed)(30, 3)
    faces = torch.stack(
        [torch.randperm(30, generator=torch.Generator().manual_seed(n))[:3] for n in range(count)]
        or [torch.empty(0, dtype=torch.int64)]
    ).view(-1, 3)
    found = avatar_kernel.triangles(vertices, faces, backend)
    expected = triangle_frames(vertices.double(), faces)
    # A thin triangle's normal and the quaternion of a half turn are known less well.
    corners = vertices.double()[faces]
    edges = corners - corners.roll(1, 1)
    area = torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1)
    tolerance = 1e-6 + 1e-6 * (edges.square().sum((1, 2)) / area).numpy()
    off = (found.rotation - expected.rotation).abs().flatten(1).amax(1).numpy() if count else np.zeros(0)
    assert (off < tolerance).all()
    np.testing.assert_allclose(found.center, expected.center, atol=1e-7)
    np.testing.assert_allclose(found.size, expected.size, rtol=1e-5)
    alike = (found.quaternion.double() * expected.quaternion).sum(1).abs().numpy()
    assert (1 - alike < tolerance).all()
    np.testing.assert_allclose(found.quaternion.norm(dim=1), 1, atol=1e-6)


@needs_kernel
@backends
def test_a_triangle_without_area_has_a_finite_frame(backend):
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 0, 0]])
    for one, other in zip(
        avatar_kernel.triangles(vertices, faces, backend), triangle_frames(vertices, faces)
    ):
        assert torch.isfinite(one).all()
        np.testing.assert_allclose(one, other, atol=1e-6)
    for number in (-1, 3):
        with pytest.raises(ValueError, match="fit"):
            avatar_kernel.triangles(vertices, torch.tensor([[0, 1, number]]), backend)


@needs_kernel
@backends
@settings(max_examples=20, deadline=None)
@given(count=COUNTS, seed=st.integers(0, 1000))
def test_splats_are_transformed_as_defined(backend, count, seed):
    normal = numbers(seed)
    frames = mesh(normal, 40)
    binding = torch.randint(40, (count,), generator=torch.Generator().manual_seed(seed))
    means, log_scales, quats = normal(count, 3), normal(count, 3), normal(count, 4)
    found = avatar_kernel.splats_to_world(frames, binding, means, unit(quats), log_scales.exp(), backend)
    expected = to_world(double(frames), binding, means.double(), log_scales.double(), quats.double())
    for one, other in zip(found, expected):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=2e-5)


@needs_kernel
@backends
@pytest.mark.parametrize("count", [0, 1, 33, 1025])
def test_turns_are_products_of_rotations(backend, count):
    to, origin = (mesh(numbers(seed), count).rotation for seed in (1, 2))
    found = avatar_kernel.turns_between(to, origin, backend)
    np.testing.assert_allclose(found, to.double() @ origin.double().transpose(1, 2), atol=1e-6)


@needs_kernel
@backends
@settings(max_examples=30, deadline=None)
@given(count=COUNTS, degree=st.integers(0, 3), turned=st.booleans(), seed=st.integers(0, 1000))
def test_harmonics_are_those_of_their_definition(backend, count, degree, turned, seed):
    normal = numbers(seed)
    means, center = normal(count, 3), 3 * normal(3)
    dc, rest = normal(count, 3), 0.3 * normal(count, 3, (degree + 1) ** 2 - 1)
    turns, binding = mesh(normal, 7).rotation, torch.arange(count) % 7
    packed = avatar_kernel.pack_harmonics(dc, rest)
    chosen = (turns, binding) if turned else ()
    found = avatar_kernel.shade(packed, means, center, *chosen, backend=backend)
    directions = unit(means.double() - center.double())
    if turned:
        directions = torch.einsum("nij,nj->ni", turns[binding].double(), directions)
    expected = sh_to_rgb(dc.double(), rest.double(), directions, degree)
    np.testing.assert_allclose(found, expected, atol=2e-5)


@needs_kernel
@backends
@settings(max_examples=20, deadline=None)
@given(count=COUNTS, hidden=st.sampled_from([1, 8, 16, 40, 128]), seed=st.integers(0, 1000))
def test_the_colour_network_is_that_of_its_definition(backend, count, hidden, seed):
    normal = numbers(seed)
    means, center = normal(count, 3), 3 * normal(3)
    turns, binding = mesh(normal, 7).rotation, torch.arange(count) % 7
    first, last, known = 0.3 * normal(hidden, 27), normal(3, hidden) / hidden**0.5, normal(count, hidden)
    known, of_direction, last = (avatar_kernel.pad_units(values, 1) for values in (known, first.t(), last))
    network = (
        *avatar_kernel.in_steps(known),
        direction_table(of_direction, 4 * SAMPLES),
        last,
    )  # near the definition
    found = avatar_kernel.shade_network(*network, means, center, turns, binding, backend)
    directions = canonical_directions(turns.double(), binding, means.double(), center.double())
    weights = {"color_weight_0": of_direction.t().double(), "color_weight_1": last.double()}
    expected = shade_directions(weights, known.double(), directions)
    np.testing.assert_allclose(found, expected, atol=1e-4)


@needs_kernel
@backends
@settings(max_examples=30, deadline=None)
@given(
    count=COUNTS,
    units=st.sampled_from([1, 16, 30, 128]),
    hidden=st.sampled_from([1, 16, 48, 128]),
    outputs=st.sampled_from([1, 13]),
    off=st.sampled_from([0.0, 3.0, 100.0]),
    seed=st.integers(0, 1000),
)
def test_the_offset_network_is_that_of_its_definition(backend, count, units, hidden, outputs, off, seed):
    """Whether all units are on somewhere, few are, or none is; splats not named keep what they have."""
    normal, samples = numbers(seed), 5
    table, first_bias = normal(3 * samples, units), normal(units) - off
    rows = torch.randint(samples - 1, (count, 3), generator=torch.Generator().manual_seed(seed))
    rows = rows + samples * torch.arange(3)
    fractions = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    second, second_bias = normal(units, hidden) / units**0.5, normal(hidden)
    last, last_bias = normal(outputs, hidden) / hidden**0.5, normal(outputs)
    out = torch.full((count + 5, outputs), 7.0)
    splats = torch.randperm(count + 5, generator=torch.Generator().manual_seed(seed))[:count]
    avatar_kernel.offsets_into(
        *(out, splats, avatar_kernel.pad_units(table, 1), avatar_kernel.pad_units(first_bias, 0)),
        *(rows.to(torch.int32), fractions),
        *(avatar_kernel.pad_units(second, 0, 1), avatar_kernel.pad_units(second_bias, 0)),
        *(avatar_kernel.pad_units(last, 1), last_bias),
        backend=backend,
    )
    exact = table.double()
    summed = (
        exact[rows] * (1 - fractions.double())[:, :, None] + exact[rows + 1] * fractions.double()[:, :, None]
    ).sum(1)
    rest = (first_bias, second.t(), second_bias, last, last_bias)
    expected = offset_network(summed, *(value.double() for value in rest))
    np.testing.assert_allclose(out[splats], expected, atol=5e-5)
    others = torch.ones(count + 5, dtype=torch.bool).index_fill(0, splats, False)
    assert (out[others] == 7).all()


@needs_kernel
@backends
def test_results_do_not_depend_on_the_number_of_threads(backend):
    normal = numbers(0)
    frames, binding = mesh(normal, 40), torch.arange(5000) % 40
    means, quats, scales = normal(5000, 3), unit(normal(5000, 4)), normal(5000, 3).exp()
    parts = *avatar_kernel.in_steps(normal(5000, 32)), normal(3 * 20, 32), normal(3, 32)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            world = avatar_kernel.splats_to_world(frames, binding, means, quats, scales, backend)
            network = *parts, world.means, normal(3) * 0 + 2, frames.rotation, binding
            results.append((*world, avatar_kernel.shade_network(*network, backend)))
    finally:
        torch.set_num_threads(before)
    for one, other in zip(*results):
        assert torch.equal(one, other)


@needs_kernel
@backends
def test_what_would_read_beyond_an_array_is_refused(backend):
    normal = numbers(0)
    frames = mesh(normal, 4)
    for triangle in (-1, 4):
        with pytest.raises(ValueError, match="fit"):
            avatar_kernel.splats_to_world(
                *(frames, torch.tensor([triangle]), normal(1, 3), normal(1, 4), normal(1, 3)), backend
            )
    arguments = normal(1, 1).new_zeros(2, 1), torch.tensor([0]), normal(6, 16), normal(16)
    layers = normal(16, 16), normal(16), normal(1, 16), normal(1)
    for row in (-1, 5):
        rows = torch.tensor([[0, 2, row]], dtype=torch.int32)
        with pytest.raises(ValueError, match="fit"):
            avatar_kernel.offsets_into(*arguments, rows, torch.zeros(1, 3), *layers, backend=backend)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_known_shapes_and_others_are_transformed_as_defined(dtype):
    """The kernel takes float32; float64 goes the way of torch."""
    normal, binding = numbers(0), torch.arange(50) % 10
    means, log_scales, quats = (normal(50, n).to(dtype) for n in (3, 3, 4))
    frames = Frames(*(value.to(dtype) for value in mesh(normal, 10)))
    carrier = avatar_kernel.WorldTransform(binding, means, log_scales, quats)
    for shape in ((log_scales, quats), (log_scales + 1, quats), (log_scales, 2 * quats.flip(1))):
        expected = to_world(frames, binding, means, *shape)
        for found, other in zip(carrier(frames, means, *shape), expected):
            np.testing.assert_allclose(found, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("turned", [False, True])
def test_harmonics_by_torch_are_those_by_the_kernel(turned):
    """Float64 goes the way of torch."""
    normal, binding = numbers(0), torch.arange(50) % 10
    dc, rest, means, center = normal(50, 3), 0.3 * normal(50, 3, 15), normal(50, 3), normal(3)
    turns = (mesh(normal, 10).rotation, binding) if turned else ()
    found = avatar_kernel.HarmonicColors(dc, rest)(means, center, *turns)
    exact = [value.double() if value.is_floating_point() else value for value in (means, center, *turns)]
    expected = avatar_kernel.HarmonicColors(dc.double(), rest.double())(*exact)
    np.testing.assert_allclose(found, expected, atol=2e-5)
