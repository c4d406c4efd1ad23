"""What methods have in common around their training."""

from headbench.bench.contracts import PreparedMethod
from headbench.methods.ga.method import GA
from headbench.methods.shared import method as shared


def test_optimisers_are_loaded_before_a_training_and_not_to_draw(monkeypatch):
    loaded = []
    monkeypatch.setattr(shared, "load_optimisers", lambda: loaded.append(True))
    method = GA()
    method._use("cpu")
    assert loaded == []
    assert isinstance(method, PreparedMethod)  # prepared before the clock of a training starts
    method.prepare("cpu")
    assert loaded == [True]
