"""Frames on their way from a device: what is waited for, and that they arrive as they were drawn."""

import numpy as np
import torch

from headbench.methods.shared import rendering
from headbench.methods.shared.rendering import Drawn, read_back


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
