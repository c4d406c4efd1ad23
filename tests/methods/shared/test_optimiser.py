"""Adam with growing tensors against the textbook update."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from headbench.methods.shared.config import SplatTraining
from headbench.methods.shared.optimisation import SHRINK, Densifier, Optimiser, logit, rows_of_tables
from headbench.methods.shared.schedule import DensifySchedule

NAMES = ("means", "log_scales", "quats", "opacities", "extra")
ALWAYS = DensifySchedule(0, 1, 10**9, 10**9, 10**9, None, prune_extent_from=100)
EXTENT = 1.0
PUBLISHED = SplatTraining()


def splats_of(binding, scales, opacities, face_count, config=PUBLISHED, seed=0):
    """Splats of the given scales; faces have size 1, so that local and world scale agree."""
    rng = np.random.default_rng(seed)
    count = len(binding)
    values = {
        "means": rng.normal(size=(count, 3)),
        "log_scales": np.log(np.repeat(np.asarray(scales, float)[:, None], 3, axis=1)),
        "quats": rng.normal(size=(count, 4)),
        "opacities": np.array([logit(o) for o in opacities]),
        "extra": rng.normal(size=(count, 2)),
    }
    parameters = {name: nn.Parameter(torch.tensor(value)) for name, value in values.items()}
    optimiser = Optimiser(parameters, dict.fromkeys(NAMES, 0.1))
    for name in NAMES:
        optimiser[name].grad = torch.ones_like(optimiser[name])
    optimiser.step()
    # The step moved everything; the moments are what it was for.
    for name in NAMES:
        optimiser[name].data.copy_(torch.from_numpy(values[name]))
    densifier = Densifier(config, optimiser, NAMES, torch.tensor(binding), face_count, EXTENT, seed)
    return densifier, optimiser, values


def densify(densifier, asking, iteration=1, sizes=None):
    """A round after one view in which the splats ``asking`` had a gradient above the threshold, or those by number."""
    views = densifier.state()["views"]
    gradient = views.new_zeros(len(views), 2)
    for splat in asking:
        gradient[splat, 0] = asking[splat] if isinstance(asking, dict) else 1.0
    densifier.observe(gradient, torch.ones(len(views), dtype=torch.bool), 10, 10)
    faces = int(densifier.binding.max()) + 1 if sizes is None else len(sizes)
    densifier.run(iteration, ALWAYS, views.new_ones(faces) if sizes is None else views.new_tensor(sizes))


def test_small_splats_are_cloned_with_zero_moments():
    densifier, optimiser, values = splats_of([0, 1, 2], [0.005] * 3, [0.5] * 3, 3)
    densify(densifier, [1])
    assert densifier.binding.tolist() == [0, 1, 2, 1]
    for name in NAMES:
        np.testing.assert_array_equal(optimiser[name][3].detach(), values[name][1])
        assert (optimiser.moments(name)["exp_avg"][3] == 0).all()
        assert (optimiser.moments(name)["exp_avg"][:3] != 0).all()


def test_large_splats_are_split_and_their_parent_goes():
    densifier, optimiser, values = splats_of([0, 1, 2], [0.005, 0.05, 0.005], [0.5] * 3, 3)
    densify(densifier, [1])
    assert densifier.binding.tolist() == [0, 2, 1, 1]
    np.testing.assert_allclose(optimiser["log_scales"][2:].detach().exp(), 0.05 / SHRINK)
    np.testing.assert_array_equal(optimiser["extra"][2:].detach(), values["extra"][[1, 1]])
    offsets = optimiser["means"][2:].detach() - torch.from_numpy(values["means"][1])
    assert 0 < offsets.abs().max() < 5 * 0.05
    assert not torch.equal(offsets[0], offsets[1])


@pytest.mark.parametrize(("variant", "factor"), [("paper", 1.0), ("official", 0.001)])
def test_children_scatter_by_the_parents_scale_in_its_own_axes(variant, factor):
    # A thousand needles along one local axis, on faces of size 1 mm.
    count = 1000
    config = replace(SplatTraining(), split_variant=variant, densify_extent=0.0)
    densifier, optimiser, values = splats_of([0] * count, [1.0] * count, [0.5] * count, 1, config)
    log_scales = torch.log(torch.tensor([2.0, 1e-6, 1e-6], dtype=torch.float64)).expand(count, 3)
    optimiser["log_scales"].data.copy_(log_scales)
    half_turn = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5], dtype=torch.float64)  # x to y
    optimiser["quats"].data.copy_(half_turn.expand(count, 4))
    densify(densifier, range(count), sizes=[0.001])
    moved = optimiser["means"].detach().numpy() - np.tile(values["means"], (2, 1))
    assert moved.std(0)[1] == pytest.approx(2.0 * factor, rel=0.1)
    assert np.abs(moved[:, [0, 2]]).max() < 1e-4 * factor


def test_gradients_are_means_over_visible_views_in_device_units():
    densifier, _, _ = splats_of([0, 1], [0.005] * 2, [0.5] * 2, 2)
    threshold = SplatTraining().densify_gradient
    # 0.5 * width = 50 pixels per unit: just above the threshold in one of two views, seen only there.
    gradient = torch.tensor([[1.01 * threshold / 50, 0], [1.01 * threshold / 50, 0]], dtype=torch.float64)
    densifier.observe(gradient, torch.tensor([True, True]), 100, 10)
    densifier.observe(torch.zeros(2, 2, dtype=torch.float64), torch.tensor([False, True]), 100, 10)
    densifier.run(1, ALWAYS, torch.ones(2, dtype=torch.float64))
    assert densifier.binding.tolist() == [0, 1, 0]


def test_faint_splats_go_but_never_the_last_of_a_face():
    densifier, _, _ = splats_of([0, 0, 1, 2, 2], [0.005] * 5, [0.5, 0.001, 0.001, 0.001, 0.001], 3)
    densify(densifier, [])
    # Face 0 loses its faint splat; faces 1 and 2 would be emptied, so all of theirs stay.
    assert densifier.binding.tolist() == [0, 1, 2, 2]


def test_a_split_parent_goes_even_where_its_children_are_faint():
    # Face 0 has nothing but a faint splat, which is split: the children stay in its place, not beside it.
    densifier, optimiser, _ = splats_of([0, 1], [0.05, 0.005], [0.001, 0.5], 2)
    densify(densifier, [0])
    assert densifier.binding.tolist() == [1, 0, 0]
    np.testing.assert_allclose(optimiser["log_scales"][1:].detach().exp(), 0.05 / SHRINK)


@pytest.mark.parametrize(("iteration", "left"), [(100, 2), (101, 1)])
def test_splats_large_in_the_world_go_once_that_is_on(iteration, left):
    densifier, _, _ = splats_of([0, 0], [0.05, 0.02], [0.5] * 2, 1)
    densify(densifier, [], iteration, [4.0])
    assert len(densifier.binding) == left


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_books_agree_and_no_face_is_ever_emptied(seed):
    rng = np.random.default_rng(seed)
    faces, count = 5, 30
    binding = np.concatenate([np.arange(faces), rng.integers(0, faces, count - faces)]).tolist()
    scales, opacities = rng.uniform(0.001, 0.3, count), rng.uniform(0.0005, 0.02, count)
    densifier, optimiser, _ = splats_of(binding, scales, opacities, faces, seed=seed)
    for iteration in (99, 101, 150):
        current = len(densifier.binding)
        asking = np.flatnonzero(rng.random(current) < 0.3)
        densify(densifier, asking, iteration, rng.uniform(0.5, 2, faces))
        current = len(densifier.binding)
        assert np.bincount(densifier.binding.numpy(), minlength=faces).min() >= 1
        for name in NAMES:
            assert len(optimiser[name]) == current
            assert optimiser.moments(name)["exp_avg"].shape == optimiser[name].shape
        state = densifier.state()
        assert state["gradient_sum"].shape == state["views"].shape == (current,)
        assert not state["views"].any()


def test_a_bound_takes_the_largest_gradients():
    config = replace(SplatTraining(), max_splats=5)
    densifier, _, _ = splats_of([0, 1, 2, 3], [0.005] * 4, [0.5] * 4, 4, config)
    densify(densifier, {0: 1.0, 1: 3.0, 2: 2.0, 3: 0.5})
    assert densifier.binding.tolist() == [0, 1, 2, 3, 1]


def test_reset_cuts_opacities_and_forgets_their_moments():
    densifier, optimiser, _ = splats_of([0, 1], [0.005] * 2, [0.5, 0.007], 2)
    densifier.reset_opacity()
    np.testing.assert_allclose(torch.sigmoid(optimiser["opacities"].detach()), [0.01, 0.007])
    assert (optimiser.moments("opacities")["exp_avg"] == 0).all()
    assert (optimiser.moments("means")["exp_avg"] != 0).all()


def with_table(binding, opacities, rows, **more):
    """Splats with a table whose rows tell their owner: the first splat's are 0.0, 0.1, ..., the next one's 1.0, ..."""
    count = len(binding)
    parameters = {
        "means": torch.zeros(count, 3),
        "log_scales": torch.full((count, 3), float(np.log(0.005))),
        "quats": torch.ones(count, 4),
        "opacities": torch.tensor([logit(o) for o in opacities]),
        "table": torch.tensor([[n + 0.1 * k] for n, b in enumerate(binding) for k in range(rows[b])]),
    }
    optimiser = Optimiser({n: nn.Parameter(v) for n, v in parameters.items()}, dict.fromkeys(parameters, 0.1))
    books = {"tables": ("table",), "table_rows": torch.tensor(rows)}
    names, binding = tuple(parameters)[:-1], torch.tensor(binding)
    return Densifier(PUBLISHED, optimiser, names, binding, len(rows), EXTENT, 0, **books, **more), optimiser


def test_tables_follow_their_splats():
    """Splats on triangles with 2, 0 and 3 rows: the third is cloned, the second goes, so does the first's first row."""
    densifier, optimiser = with_table([0, 1, 2, 0], [0.5, 0.001, 0.5, 0.001], [2, 0, 3], keep_last=False)
    densify(densifier, [2])
    assert densifier.binding.tolist() == [0, 2, 2]
    expected = [0.0, 0.1, 2.0, 2.1, 2.2, 2.0, 2.1, 2.2]
    np.testing.assert_allclose(optimiser["table"].detach()[:, 0], expected, atol=1e-6)


@pytest.mark.parametrize("keep_last", [True, False])
def test_a_last_splat_goes_only_where_that_is_allowed(keep_last):
    densifier, _ = with_table([0, 1], [0.001, 0.5], [1, 1], keep_last=keep_last)
    densify(densifier, [])
    assert densifier.binding.tolist() == ([0, 1] if keep_last else [1])


def test_triangles_may_ask_at_thresholds_of_their_own():
    densifier, _ = with_table([0, 1], [0.5, 0.5], [1, 1], thresholds=torch.tensor([1e-3, 2e-4]))
    densify(densifier, {0: 1e-4, 1: 1e-4})  # 5e-4 in normalised device units of a 10 x 10 image
    assert densifier.binding.tolist() == [0, 1, 1]


@settings(max_examples=30, deadline=None)
@given(counts=st.lists(st.integers(0, 4), min_size=1, max_size=8), data=st.data())
def test_rows_of_tables_are_found(counts, data):
    splats = data.draw(st.lists(st.integers(0, len(counts) - 1), max_size=8))
    owners = [n for n, count in enumerate(counts) for _ in range(count)]
    expected = [row for splat in splats for row, owner in enumerate(owners) if owner == splat]
    found = rows_of_tables(torch.tensor(counts), torch.tensor(splats, dtype=torch.int64))
    assert found.tolist() == expected


def textbook(values, gradients, rate, epsilon=1e-15):
    """Kingma and Ba 2015, algorithm 1, in float64."""
    m = v = np.zeros_like(values)
    for t, g in enumerate(gradients, 1):
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        values = values - rate * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + epsilon)
    return values


def make(rows=4, **options):
    values = torch.arange(rows * 3, dtype=torch.float64).reshape(rows, 3)
    optimiser = Optimiser(
        {"a": nn.Parameter(values.clone()), "b": nn.Parameter(torch.zeros(2, dtype=torch.float64))},
        {"a": 0.1, "b": 0.2},
        **options,
    )
    return optimiser, values.numpy()


def step(optimiser, gradient):
    optimiser["a"].grad = torch.as_tensor(gradient)
    optimiser.step()
    optimiser.zero_grad()


def test_steps_are_adams():
    optimiser, start = make()
    gradients = np.random.default_rng(0).normal(size=(5, 4, 3))
    for gradient in gradients:
        step(optimiser, gradient)
    np.testing.assert_allclose(optimiser["a"].detach(), textbook(start, gradients, 0.1), rtol=1e-12)
    assert (optimiser["b"] == 0).all()  # no gradient, no step


def test_a_parameter_may_have_an_epsilon_of_its_own():
    optimiser, start = make(epsilons={"a": 0.3})
    gradients = np.random.default_rng(0).normal(size=(3, 4, 3))
    for gradient in gradients:
        optimiser["b"].grad = torch.full_like(optimiser["b"], 1e-9)
        step(optimiser, gradient)
    np.testing.assert_allclose(optimiser["a"].detach(), textbook(start, gradients, 0.1, 0.3), rtol=1e-12)
    expected = textbook(np.zeros(2), np.full((3, 2), 1e-9), 0.2)
    np.testing.assert_allclose(optimiser["b"].detach(), expected, rtol=1e-12)


def test_select_keeps_rows_with_their_moments():
    optimiser, start = make()
    gradients = np.random.default_rng(1).normal(size=(4, 4, 3))
    for gradient in gradients[:2]:
        step(optimiser, gradient)
    optimiser.select(["a"], torch.tensor([True, False, True, True]))
    for gradient in gradients[2:]:
        step(optimiser, gradient[[0, 2, 3]])
    expected = textbook(start, gradients, 0.1)[[0, 2, 3]]
    np.testing.assert_allclose(optimiser["a"].detach(), expected, rtol=1e-12)


def test_state_restores_another_number_of_rows_and_continues():
    one, _ = make()
    gradients = np.random.default_rng(2).normal(size=(4, 3, 3))
    step(one, np.ones((4, 3)))
    one.select(["a"], torch.tensor([True, True, False, True]))
    one.set_learning_rate("a", 0.05)
    other, _ = make()
    other.load_state(one.state())
    for gradient in gradients:
        step(one, gradient)
        step(other, gradient)
    assert torch.equal(one["a"], other["a"])
