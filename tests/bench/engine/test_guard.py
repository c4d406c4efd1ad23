"""A method gets training images only and cannot change what other methods are given; its frames are checked."""

import numpy as np
import pytest

from headbench.bench.contracts import Frame, FrameKey
from headbench.bench.engine.scoring import TrainingView, check_frame
from headbench.bench.errors import HeadbenchError, InputError


@pytest.fixture
def view(toy, tmp_path):
    return TrainingView(toy.ToyClip(tmp_path / "s"))


@pytest.mark.parametrize("split", ["novel_view", "self_reenactment"])
@pytest.mark.parametrize("read", ["image", "mask"])
def test_a_held_out_frame_cannot_be_read(view, split, read):
    assert view.image(view.splits["train"][0])[0, 0, 0] == 40
    with pytest.raises(HeadbenchError, match="not a training frame"):
        getattr(view, read)(view.splits[split][0])


CHANGES = {
    "camera": lambda view: view.cameras["a"].K.fill(0),
    "expression": lambda view: view.poses[0].expression.fill(0),
    "shape": lambda view: view.shape.fill(0),
    "image": lambda view: view.image(view.splits["train"][0]).fill(0),
    "image, flag": lambda view: view.image(view.splits["train"][0]).setflags(write=True),
    "poses": lambda view: view.poses.clear(),
    "splits": lambda view: view.splits.update(train=()),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_shared_inputs_are_read_only(view, change):
    with pytest.raises((ValueError, AttributeError)):
        change(view)


@pytest.mark.parametrize(
    ("rgb", "alpha", "match"),
    [
        (np.full((2, 3, 3), 1.0005), np.zeros((2, 3)), None),
        (np.full((2, 3, 3), 1.002), np.zeros((2, 3)), "rgb of .*from 1.002"),
        (np.full((2, 3, 3), -np.inf), np.zeros((2, 3)), "rgb"),
        (np.zeros((2, 3, 3)), np.full((2, 3), np.nan), "alpha of .*nan"),
        (np.zeros((3, 2, 3)), np.zeros((2, 3)), "rgb of .*shape"),
        (np.zeros((2, 3, 3)), np.zeros((2, 3, 1)), "alpha of .*shape"),
    ],
)
def test_size_and_values_of_a_frame_are_checked(rgb, alpha, match):
    key = FrameKey("s", "EMO", 0, "a")
    if match is None:
        check_frame(Frame(rgb, alpha), (2, 3), "cell", key)
    else:
        with pytest.raises(InputError, match=match):
            check_frame(Frame(rgb, alpha), (2, 3), "cell", key)
