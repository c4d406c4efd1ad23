"""The loop on a model small enough to know its course in closed form."""

import pytest
import torch
from torch import nn

from headbench.bench.contracts import Budget, PreparedMethod, no_progress
from headbench.bench.errors import InputError
from headbench.methods.ga.method import GA
from headbench.methods.ops.splats import position_penalty, scale_penalty
from headbench.methods.shared import loop
from headbench.methods.shared import method as shared
from headbench.methods.shared.loop import CHECKPOINT, Fit, train
from headbench.methods.shared.optimisation import Optimiser
from headbench.methods.shared.threads import threads, torch_threads


def test_optimisers_are_loaded_before_a_training_and_not_to_draw(monkeypatch):
    loaded = []
    monkeypatch.setattr(shared, "load_optimisers", lambda: loaded.append(True))
    method = GA()
    method._use("cpu")
    assert loaded == []
    assert isinstance(method, PreparedMethod)  # prepared before the clock of a training starts
    method.prepare("cpu")
    assert loaded == [True]


def test_penalties_have_zero_gradient_where_nothing_exceeds():
    means = torch.zeros(4, 3, requires_grad=True)
    log_scales = torch.full((4, 3), -5.0, requires_grad=True)
    visible = torch.ones(4, dtype=torch.bool)
    (position_penalty(means, visible, 1.0) + scale_penalty(log_scales, visible, 0.6)).backward()
    assert (means.grad == 0).all()
    assert (log_scales.grad == 0).all()
    assert float(position_penalty(means.detach() + 9, ~visible, 1.0)) == 0  # nothing visible costs nothing


class Drift:
    """One number with a gradient of one per step; remembers which calls it saw."""

    def __init__(self, clock=None, cost=0.0, loss=None):
        self.optimiser = Optimiser({"x": nn.Parameter(torch.zeros(1, dtype=torch.float64))}, {"x": 0.5})
        self.calls, self.clock, self.cost, self.value = [], clock, cost, loss

    def begin(self, timeline):
        self.timeline = timeline

    def loss(self, iteration, index):
        self.calls.append((iteration, index))
        if self.clock is not None:
            self.clock.now += self.cost
        factor = 1.0 if self.value is None else self.value
        return (self.optimiser["x"] * factor).sum()

    def after_backward(self, iteration):
        pass

    def state(self):
        return {"optimiser": self.optimiser.state()}

    def load_state(self, state):
        self.optimiser.load_state(state["optimiser"])

    def note(self):
        return "drifting"


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def run(
    model, folder, budget, progress=no_progress, clock=None, every=1e9, name="run", began=None, device="cpu"
):
    fit = Fit(None, folder, budget, device, 0, progress, name, clock or Clock(), began)
    sampler = lambda iteration: iteration % 3
    return train(model, sampler, fit, published_length=100, checkpoint_every_s=every)


def killing(at):
    def progress(done, total, note=""):
        if done == at:
            raise KeyboardInterrupt

    return progress


def test_iterations_count_from_one_and_the_last_makes_no_step(tmp_path):
    model = Drift()
    outcome = run(model, tmp_path, Budget(iterations=7))
    assert model.calls == [(i, i % 3) for i in range(1, 8)]
    # Adam's step for a constant gradient is the learning rate: six steps of 0.5.
    assert model.optimiser["x"].item() == pytest.approx(-3.0)
    assert (outcome.iterations, outcome.planned) == (7, 7)
    assert (model.timeline.total, model.timeline.published) == (7, 100)


@pytest.mark.parametrize(("compiled", "expected"), [(True, (1, 3)), (False, (3, 3))])
def test_torch_has_one_thread_where_kernels_are_compiled(tmp_path, monkeypatch, compiled, expected):
    monkeypatch.setattr(loop, "instruction_sets", lambda: {"cpu": ""} if compiled else {})
    seen = []
    with torch_threads(3):
        report = lambda *_: seen.append((torch.get_num_threads(), threads()))
        run(Drift(), tmp_path, Budget(iterations=2), report)
    assert seen == [expected] * 2


def test_steps_are_timed_until_their_device_has_done_them(tmp_path, monkeypatch):
    clock, queue = Clock(), Clock()

    def synchronize(device):
        assert device == "cuda:1"
        clock.now, queue.now = clock.now + queue.now, 0.0

    monkeypatch.setattr(torch.cuda, "synchronize", synchronize)
    outcome = run(Drift(queue, 0.5), tmp_path, Budget(seconds=80.0), clock=clock, device="cuda:1")
    assert outcome.planned == 100
    assert outcome.seconds == pytest.approx(0.5 * (100 + loop.TIMED_STEPS + 1))


def test_seconds_alone_give_an_estimate_of_iterations(tmp_path):
    clock, notes = Clock(), []
    model = Drift(clock, cost=0.1)
    outcome = run(model, tmp_path, Budget(seconds=16.0), lambda d, n, note="": notes.append(note), clock)
    assert "100 iterations estimated" in notes[0]  # 16 s / (0.1 s * 1.6)
    assert f"{outcome.planned} iterations estimated" in [note for note in notes if note][-1]
    assert outcome.iterations == outcome.planned == model.timeline.total
    # The trial steps changed nothing: training still starts at its first iteration from zero.
    assert model.optimiser["x"].item() == pytest.approx(-0.5 * (outcome.planned - 1))


@pytest.mark.parametrize("late", [0.5, 2.0])
def test_seconds_are_used_although_the_first_steps_mislead(tmp_path, late):
    clock = Clock()

    class Cached(Drift):
        def loss(self, iteration, index):
            # The first steps cost three times as much; later the cost grows to ``late`` times that of an early one.
            first = 3.0 if len(self.calls) < 20 else 1.0
            self.cost = 0.01 * first * (1 + (late - 1) * min(clock.now / 50, 1))
            return super().loss(iteration, index)

    outcome = run(Cached(clock), tmp_path, Budget(seconds=50.0), clock=clock)
    assert 0.9 * 50 <= outcome.seconds <= 1.01 * 50
    # The schedule ends with the run, but for a few steps where the last part was slower than estimated.
    assert outcome.iterations >= 0.95 * outcome.planned


def test_a_killed_run_in_seconds_keeps_its_estimate(tmp_path):
    clock = Clock()
    with pytest.raises(KeyboardInterrupt):
        run(Drift(clock, 0.1), tmp_path, Budget(seconds=16.0), killing(90), clock, every=0.0)
    outcome = run(Drift(clock, 0.1), tmp_path, Budget(seconds=16.0), clock=clock)
    assert outcome.iterations == outcome.planned
    assert 0.95 * 16 <= outcome.seconds <= 16


def test_whichever_bound_comes_first_ends_the_run(tmp_path):
    clock = Clock()
    outcome = run(Drift(clock, cost=1.0), tmp_path, Budget(iterations=50, seconds=10.0), clock=clock)
    assert (outcome.iterations, outcome.planned) == (10, 50)


@pytest.mark.parametrize("kill_at", [1, 2, 5, 11])
def test_a_killed_run_goes_on_from_its_checkpoint(tmp_path, kill_at):
    unbroken = Drift()
    run(unbroken, tmp_path / "a", Budget(iterations=12))
    with pytest.raises(KeyboardInterrupt):
        run(Drift(), tmp_path / "b", Budget(iterations=12), killing(kill_at), every=0.0)
    assert (tmp_path / "b" / CHECKPOINT).exists()
    again = Drift()
    run(again, tmp_path / "b", Budget(iterations=12))
    assert again.calls[0][0] == kill_at + 1
    assert torch.equal(again.optimiser["x"], unbroken.optimiser["x"])


@pytest.mark.parametrize("kill_at", [None, 10, 15])
def test_losses_are_recorded_from_every_tenth_iteration(tmp_path, kill_at):
    if kill_at:
        with pytest.raises(KeyboardInterrupt):
            run(Drift(), tmp_path, Budget(iterations=23), killing(kill_at), every=0.0)
    outcome = run(Drift(), tmp_path, Budget(iterations=23))
    # Adam's step for a constant gradient is the learning rate.
    assert outcome.losses == [(i, pytest.approx(-0.5 * (i - 1))) for i in (1, 10, 20, 23)]


def test_seconds_of_preparation_count(tmp_path):
    clock = Clock()
    clock.now = 30.0
    outcome = run(Drift(clock, 1.0), tmp_path / "seconds", Budget(seconds=40.0), clock=clock, began=6.0)
    # 24 s are gone before the trial steps, which take 6.
    assert outcome.seconds == pytest.approx(24 + 6 + outcome.iterations)
    assert 39 <= outcome.seconds <= 40

    # Time between the parts of a run does not count, nor does a second preparation.
    with pytest.raises(KeyboardInterrupt):
        run(
            *(Drift(clock, 1.0), tmp_path, Budget(iterations=9), killing(4), clock),
            every=0.0,
            began=clock.now - 5,
        )
    clock.now += 1000
    outcome = run(Drift(clock, 1.0), tmp_path, Budget(iterations=9), clock=clock, began=clock.now - 2)
    assert outcome.seconds == pytest.approx(5 + 9)


def test_divergence_is_reported(tmp_path):
    with pytest.raises(InputError, match="diverged"):
        run(Drift(loss=float("nan")), tmp_path, Budget(iterations=20))


@pytest.mark.parametrize("budget", [Budget(), Budget(iterations=0), Budget(seconds=-1.0)])
def test_an_empty_budget_is_refused(tmp_path, budget):
    with pytest.raises(InputError, match="budget"):
        run(Drift(), tmp_path, budget)
