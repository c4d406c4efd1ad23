"""What methods have in common around their training."""

import subprocess
import sys

import pytest

from headbench.bench.contracts import PreparedMethod
from headbench.methods.ga.method import GA
from headbench.methods.shared import method as shared

FIRST_STEP = """
import sys, torch
from headbench.methods.shared.method import load_optimisers
load_optimisers()
before = set(sys.modules)
weight = torch.zeros(1, requires_grad=True)
weight.grad = torch.ones(1)
torch.optim.Adam([weight]).step()
print(len(set(sys.modules) - before))
"""


def test_optimisers_are_loaded_before_a_training_and_not_to_draw(monkeypatch):
    loaded = []
    monkeypatch.setattr(shared, "load_optimisers", lambda: loaded.append(True))
    method = GA()
    method._use("cpu")
    assert loaded == []
    assert isinstance(method, PreparedMethod)  # prepared before the clock of a training starts
    method.prepare("cpu")
    assert loaded == [True]


@pytest.mark.slow
def test_the_first_step_of_a_process_imports_next_to_nothing():
    said = subprocess.run([sys.executable, "-c", FIRST_STEP], capture_output=True, text=True, check=True)
    assert int(said.stdout) < 20  # several hundred without
