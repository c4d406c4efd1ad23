"""The networks' compiled training passes against their definitions in float64, gradients included."""

import numpy as np
import pytest
import torch

from headbench.methods.ours import appearance
from headbench.methods.ours.config import Lines, OursConfig, Planes
from headbench.methods.ours.field import (
    Bounds,
    CanonicalFrames,
    blend_lines,
    canonical_directions,
    initial_parameters,
    line_offsets,
    line_position,
    plane_features,
    shade,
)
from headbench.methods.ours.method import Ours
from headbench.methods.ours.training_kernel import (
    canonical_positions,
    directions_to,
    plane_colors,
    table_offsets,
)
from headbench.methods.shared.avatar_kernel import usable
from headbench.methods.shared.schedule import Timeline
from headbench.methods.shared.splat_training import BoundTraining
from headbench.methods.splats.cpu import instruction_sets

from .toy import SMALL, changed, make

BACKENDS = list(instruction_sets()) if usable(torch.zeros(1)) else []
pytestmark = pytest.mark.skipif(not BACKENDS, reason="no compiled kernel here, or an old one")

PUBLISHED = {"hidden": 128, "channels": (32, 16, 16), "samples": 128}
CASES = {
    "published sizes": {**PUBLISHED, "count": 3003},
    "odd sizes": {"hidden": 7, "channels": (4, 19, 1), "samples": 9, "count": 77},
    "two samples": {"hidden": 16, "channels": (1, 2, 17), "samples": 2, "count": 16},
    "no splat": {"hidden": 8, "channels": (4, 2, 2), "samples": 5, "count": 0},
}
BOX = Bounds(torch.tensor([-1.0, -0.5, -1.1]), torch.tensor([1.0, 1.3, 0.9]))


def scene(hidden, channels, samples, count, dynamic=("opacity",)):
    """Parameters, positions (some outside of the box, some on its faces) and directions in float32, some of them chosen."""
    generator = torch.Generator().manual_seed(count)
    lines = Lines(resolution=samples, channels=3, dynamic=dynamic)
    config = OursConfig(hidden=hidden, planes=Planes(resolution=samples, channels=channels), lines=lines)
    parameters = {name: value for name, (value, _) in initial_parameters(config, 5, 2, generator).items()}
    parameters["lines"] = torch.randn(parameters["lines"].shape, generator=generator)
    positions = 0.8 * torch.randn(count, 3, generator=generator)
    positions[:3] = torch.stack([BOX.low, BOX.high, torch.tensor([1.0, 0.2, -1.1])])[:count]
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return parameters, positions, directions, generator


def leaves(values, dtype=torch.float32):
    return {name: value.detach().to(dtype, copy=True).requires_grad_() for name, value in values.items()}


def exact_box():
    return Bounds(*(corner.double() for corner in BOX))


def assert_near(found, expected, name):
    difference = float((found.detach().double() - expected.detach()).norm())
    assert difference <= 2e-5 * float(expected.detach().norm()), name


def assert_same_gradients(found, expected):
    """Compare those that the definition has; there is no other."""
    for name, value in expected.items():
        if value.grad is None:
            assert found[name].grad is None, name
        else:
            assert_near(found[name].grad, value.grad, name)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", CASES)
def test_colours_and_their_gradients(case, backend):
    parameters, positions, directions, generator = scene(**CASES[case])
    weights = torch.randn(len(positions), 3, generator=generator)
    values = {**parameters, "positions": positions, "directions": directions}
    exact, found = leaves(values, torch.float64), leaves(values)
    features = plane_features(exact, exact_box(), exact["positions"])
    expected = shade(exact, features, exact["directions"])
    (expected * weights).sum().backward()
    colors = plane_colors(found, BOX, found["positions"], found["directions"], backend)
    (colors * weights).sum().backward()
    assert_near(colors, expected, "colours")
    assert_same_gradients(found, exact)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", CASES)
def test_gradients_by_planes_where_splats_stay(case, backend):
    parameters, positions, directions, generator = scene(**CASES[case])
    weights = torch.randn(len(positions), 3, generator=generator)
    moved, stay = leaves(parameters), leaves(parameters)
    places = positions.clone().requires_grad_(), directions
    (plane_colors(moved, BOX, *places, backend) * weights).sum().backward()
    (plane_colors(stay, BOX, positions, directions, backend) * weights).sum().backward()
    for name, value in moved.items():
        assert (value.grad is None and stay[name].grad is None) or torch.equal(stay[name].grad, value.grad)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [0, 1, 16, 1030])
def test_positions_and_their_gradients(count, backend):
    generator = torch.Generator().manual_seed(count)
    parts = torch.randn(5, 9, generator=generator), torch.randn(5, 3, generator=generator), torch.eye(3)
    means, weights = torch.randn(2, count, 3, generator=generator)
    binding = torch.arange(count) % 5
    exact, found = leaves({"means": means}, torch.float64), leaves({"means": means})
    expected = CanonicalFrames(*(part.double() for part in parts)).positions(binding, exact["means"])
    positions = canonical_positions(CanonicalFrames(*parts), binding, found["means"], backend)
    assert_near(positions, expected, "positions")
    (expected * weights).sum().backward()
    (positions * weights).sum().backward()
    assert_same_gradients(found, exact)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("count", [0, 1, 16, 1030])
def test_directions_and_their_gradients(count, backend):
    generator = torch.Generator().manual_seed(count)
    turns, last = torch.randn(5, 3, 3, generator=generator), torch.randn(3, 3, generator=generator)
    means, weights = torch.randn(2, count, 3, generator=generator)
    center, binding = torch.tensor([0.1, 0.2, 3.0]), torch.arange(count) % 5
    exact, found = leaves({"means": means}, torch.float64), leaves({"means": means})
    expected = canonical_directions(turns.double(), binding, exact["means"], center.double())
    directions = directions_to(turns, binding, found["means"], center, backend=backend)
    assert_near(directions, expected, "directions")
    directions = directions_to(turns, binding, found["means"], center, last, backend)
    assert_near(directions, expected @ last.double().t(), "rotated directions")
    ((expected @ last.double().t()) * weights).sum().backward()
    (directions * weights).sum().backward()
    assert_same_gradients(found, exact)


@pytest.mark.parametrize("dynamic", [("opacity",), ("opacity", "rotation")], ids=len)
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", CASES)
def test_offsets_and_their_gradients(case, backend, dynamic):
    parameters, positions, _, generator = scene(**CASES[case], dynamic=dynamic)
    expression, jaw = torch.randn(5, generator=generator), torch.rand(2, generator=generator)
    exact, found = leaves(parameters, torch.float64), leaves(parameters)
    inside = BOX.contains(positions)
    place = line_position(exact_box().unit(positions.double()), CASES[case]["samples"])
    blended = blend_lines(exact["lines"], expression.double(), jaw.double())
    expected = line_offsets(exact, blended, place) * inside[:, None]
    # Splats without a gradient are left out of the pass. (Where a sum rounds to the other side of 0, gradients differ.)
    weights = (
        torch.randn(expected.shape, generator=generator) * (torch.arange(len(positions)) % 3 > 0)[:, None]
    )
    (expected * weights).sum().backward()
    blended = blend_lines(found["lines"], expression, jaw)
    offsets = table_offsets(found, BOX, blended, positions, backend)
    (offsets * weights).sum().backward()
    assert_near(offsets, expected, "offsets")
    assert not offsets[~inside].any()
    assert_same_gradients(found, exact)


def test_bits_do_not_depend_on_the_number_of_threads():
    parameters, positions, directions, generator = scene(**PUBLISHED, count=9000)
    weights = torch.randn(len(positions), 4, generator=generator)
    results = []
    usual = torch.get_num_threads()
    for threads in (1, 2, 3):
        found = leaves({**parameters, "positions": positions, "directions": directions})
        blended = blend_lines(parameters["lines"], torch.ones(5), torch.ones(2))
        torch.set_num_threads(threads)
        try:
            colors = plane_colors(found, BOX, found["positions"], found["directions"])
            offsets = table_offsets(found, BOX, blended, positions)
            (torch.cat([colors, offsets], dim=1) * weights).sum().backward()
        finally:
            torch.set_num_threads(usual)
        gradients = {name: value.grad for name, value in found.items() if value.grad is not None}
        results.append({"colors": colors.detach(), "offsets": offsets.detach(), **gradients})
    for name, first in results[0].items():
        # The normalised weights' own gradients are torch's.
        if not name.startswith(("line_direction", "line_gain")):
            assert torch.equal(results[1][name], first), name
            assert torch.equal(results[2][name], first), name


def test_arrays_that_do_not_fit_are_refused():
    parameters, positions, directions, _ = scene(**CASES["odd sizes"])
    with pytest.raises(ValueError, match="fit"):
        plane_colors(parameters, BOX, positions, directions[1:])


def test_training_follows_that_without_the_kernel(clip, monkeypatch):
    config = changed(SMALL, splats={"schedule_length": 100}, lines={"start": 10})
    losses = {}
    for kernel in (True, False):
        monkeypatch.setattr(appearance, "usable", lambda like, kernel=kernel: kernel)
        shading, _, binding = make(clip, config)
        sampler = Ours(config)._sampler(clip, 0)
        training = BoundTraining(clip, config.splats, shading, sampler, len(binding), "cpu", 0)
        training.begin(Timeline(100, 100))
        losses[kernel] = []
        for iteration in range(1, 31):
            loss = training.loss(iteration, sampler(iteration))
            loss.backward()
            losses[kernel].append(loss.item())
            training.optimiser.step()
            training.optimiser.zero_grad()
        training.close()
    np.testing.assert_allclose(losses[True], losses[False], rtol=1e-3)
    assert losses[True] != losses[False]  # so that the kernel was used
