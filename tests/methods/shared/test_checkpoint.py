"""Checkpoints: restored as they were, refused when they are not ours."""

import pickle

import pytest
import torch

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.errors import InputError
from headbench.methods.shared.loop import CHECKPOINT, Fit, train
from headbench.methods.shared.tensor_files import load_checkpoint, save_checkpoint


def test_what_was_saved_comes_back(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    shared = torch.randn(4, 3)
    state = {
        "iteration": 3,
        "deep": {"x": shared, "row": shared[1], "turned": shared.T, "name": "a", 7: None},
        "list": [1.5, 2, float("inf"), True, (1, [torch.zeros(0, 2), torch.tensor(3, dtype=torch.uint8)])],
        "small": torch.ones(2, dtype=torch.bfloat16),
    }
    save_checkpoint(path, "run", state)
    found = load_checkpoint(path, "run", "cpu")
    assert str(found) == str(state)
    assert all(torch.equal(found["deep"][name], state["deep"][name]) for name in ("x", "row", "turned"))
    assert found["deep"]["turned"].stride() == state["deep"]["turned"].stride()
    assert found["list"][4][1][1].dtype == torch.uint8


def test_no_file_is_no_checkpoint_and_another_runs_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    assert load_checkpoint(path, "run", "cpu") is None
    save_checkpoint(path, "one", {})
    with pytest.raises(InputError, match="another run"):
        load_checkpoint(path, "two", "cpu")


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    class Touches:
        def __reduce__(self):
            return (open, (str(witness), "w"))

    path, witness = tmp_path / "checkpoint.safetensors", tmp_path / "witness"
    for save in (pickle.dump, torch.save):
        with path.open("wb") as stream:
            save({"layout": 1, "run": "run", "state": Touches()}, stream)
        with pytest.raises(InputError):
            load_checkpoint(path, "run", "cpu")
    assert not witness.exists()


def test_damage_anywhere_is_found(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, "run", {"x": torch.randn(10), "name": [1, "a", None]})
    whole = path.read_bytes()
    flipped = (whole[:i] + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in range(0, len(whole), 3))
    for content in (whole[:200], b"", whole + b"\0", *flipped):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"[Dd]elete it"):
            load_checkpoint(path, "run", "cpu")


@pytest.mark.parametrize(
    "state",
    [
        {},
        {"iteration": 1, "total": 2, "seconds": None},
        {"iteration": 1, "total": 2, "seconds": 0.0, "trainable": []},
    ],
)
def test_a_state_that_is_none_of_the_method_is_refused(tmp_path, state):
    class Method:
        def begin(self, timeline):
            pass

        def load_state(self, state):
            state["means"]

    save_checkpoint(tmp_path / CHECKPOINT, "run", state)
    fit = Fit(None, tmp_path, Budget(iterations=2), "cpu", 0, no_progress, "run")
    with pytest.raises(InputError, match="the state of this method"):
        train(Method(), lambda iteration: 0, fit, published_length=1, checkpoint_every_s=1.0)


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, "run", {"x": 1})
    with pytest.raises((AttributeError, TypeError, pickle.PicklingError, RuntimeError)):
        save_checkpoint(path, "run", {"x": lambda: None})
    assert load_checkpoint(path, "run", "cpu") == {"x": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.safetensors"]
