"""Frames on their way from a device: what is waited for, and that they arrive as they were drawn; and their depth."""

import numpy as np
import pytest
import torch

from headbench.bench.contracts import Camera
from headbench.methods.ops.splats import WorldSplats
from headbench.methods.shared import rendering
from headbench.methods.shared.rendering import Drawn, read_back, splat_depth
from headbench.methods.shared.threads import threads, torch_on_one_thread, torch_threads


def nested():
    """Two levels, the outer one left by an error."""
    with torch_on_one_thread(True):
        with torch_on_one_thread(True):
            assert (torch.get_num_threads(), threads()) == (1, 3)
        assert (torch.get_num_threads(), threads()) == (1, 3)
        raise KeyError


def test_torch_on_one_thread_leaves_kernels_theirs():
    with torch_threads(3):
        with pytest.raises(KeyError):
            nested()
        assert (torch.get_num_threads(), threads()) == (3, 3)
        with torch_on_one_thread(False):
            assert (torch.get_num_threads(), threads()) == (3, 3)


class Event:
    """An event that says what was asked of it."""

    def __init__(self, log):
        self._log, self._name = log, f"frame {sum(entry[0] == 'record' for entry in log)}"

    def record(self, stream):
        self._log.append(("record", self._name))

    def synchronize(self):
        self._log.append(("wait", self._name))


def test_a_frame_is_waited_for_alone_once_it_is_read(monkeypatch):
    log = []
    monkeypatch.setattr(torch.cuda, "Event", lambda: Event(log))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: None)
    rng = torch.Generator().manual_seed(0)
    frames = [Drawn(torch.rand(5, 7, 3, generator=rng), torch.rand(5, 7, generator=rng)) for _ in range(2)]
    copied = [rendering._copied_ahead(frame) for frame in frames]
    assert log == [("record", "frame 0"), ("record", "frame 1")]
    for frame, copy, name in zip(frames, copied, ("frame 0", "frame 1"), strict=True):
        found, expected = read_back(copy), read_back(frame)
        assert log[-1] == ("wait", name)
        assert all(np.array_equal(a, b) and a.shape == b.shape for a, b in zip(found, expected, strict=True))


def test_depth_is_the_mean_of_what_is_shown():
    camera = Camera("c", 9, 9, np.array([[50.0, 0, 4.5], [0, 50, 4.5], [0, 0, 1]]), np.eye(4))
    means = torch.tensor([[0.0, 0, 1.5], [0.0, 0, 2.5]])
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4).contiguous()
    opacities = torch.tensor([0.6, 0.5])
    world = WorldSplats(means, quats, torch.full((2, 3), 0.05))
    depth = splat_depth(world, opacities, camera, "cpu")
    front, behind = 0.6, 0.4 * 0.5  # what the pixel in the middle, where both are whole, shows of each
    assert depth[4, 4] == pytest.approx((front * 1.5 + behind * 2.5) / (front + behind), rel=1e-3)
    assert np.isnan(depth[0, 0])  # beyond the splats
    moved = np.eye(4)
    moved[2, 3] = 1.0
    further = splat_depth(world, opacities, Camera("d", 9, 9, camera.K, moved), "cpu")
    assert further[4, 4] - depth[4, 4] == pytest.approx(1.0, abs=1e-3)
