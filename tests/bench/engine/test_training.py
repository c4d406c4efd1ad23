"""What is recorded of a training: its losses, and why it failed."""

import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from headbench.bench.engine import run as runner
from headbench.bench.errors import reason_of
from headbench.bench.io.files import write_json


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory")]
)
def test_out_of_memory_is_an_outcome_of_that_name(error):
    assert reason_of(error).startswith("out of memory: ")
    assert reason_of(ValueError("5")) == "ValueError: 5"


def test_losses_are_written_as_csv_and_for_tensorboard(config, toy, monkeypatch):
    original, written = toy.ToyMethod.fit, []

    def fit(self, clip, out, *arguments, **options):
        original(self, clip, out, *arguments, **options)
        write_json(out / "training.json", {"losses": [[1, 0.5], [2, 0.25]]})

    class Writer(nullcontext):
        def __enter__(self):
            return self

        def add_scalar(self, name, value, step):
            written.append((name, value, step))

    monkeypatch.setattr(toy.ToyMethod, "fit", fit)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    runner.run(config)
    (losses,) = Path(config.out).glob("*/toy/seed-0/losses.csv")
    assert losses.read_text() == "iteration,loss\n1,0.5\n2,0.25\n"
    assert written == [("loss", 0.5, 1), ("loss", 0.25, 2)]
