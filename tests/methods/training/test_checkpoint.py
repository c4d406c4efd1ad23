"""Checkpoints: restored as they were, refused when they are not ours."""

import pickle

import pytest
import torch

from headbench.bench.errors import InputError
from headbench.methods.training.checkpoint import load_checkpoint, save_checkpoint


def test_what_was_saved_comes_back(tmp_path):
    path = tmp_path / "checkpoint.pt"
    state = {"iteration": 3, "deep": {"x": torch.randn(4), "name": "a"}, "list": [1.5, 2]}
    save_checkpoint(path, "run", state)
    found = load_checkpoint(path, "run", "cpu")
    assert torch.equal(found["deep"]["x"], state["deep"]["x"])
    assert (found["iteration"], found["list"]) == (3, [1.5, 2])


def test_no_file_is_no_checkpoint(tmp_path):
    assert load_checkpoint(tmp_path / "checkpoint.pt", "run", "cpu") is None


def test_another_runs_checkpoint_is_refused(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, "one", {})
    with pytest.raises(InputError, match="another run"):
        load_checkpoint(path, "two", "cpu")


class Touches:
    """Would run code if it were unpickled without restriction."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    path, witness = tmp_path / "checkpoint.pt", tmp_path / "witness"
    path.write_bytes(pickle.dumps(Touches(witness), protocol=2))
    with pytest.raises(InputError):
        load_checkpoint(path, "run", "cpu")
    torch.save({"layout": 1, "run": "run", "state": Touches(witness)}, path)
    with pytest.raises(InputError):
        load_checkpoint(path, "run", "cpu")
    assert not witness.exists()


def test_a_damaged_file_is_an_input_error(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, "run", {"x": torch.randn(100)})
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="Delete it"):
        load_checkpoint(path, "run", "cpu")


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, "run", {"x": 1})
    with pytest.raises((AttributeError, TypeError, pickle.PicklingError, RuntimeError)):
        save_checkpoint(path, "run", {"x": lambda: None})
    assert load_checkpoint(path, "run", "cpu") == {"x": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.pt"]
