"""The network of a person's mask, by a stand-in."""

import sys
import types

import numpy as np
import pytest

from headbench.bench.errors import InputError, UnavailableError
from headbench.datasets.video.clip import SelfieSegmentation


@pytest.fixture
def network(monkeypatch, tmp_path):
    """A stand-in whose coverage is the red channel of what it is given."""
    shapes = {"input": (1, 8, 4, 3), "output": (1, 8, 4, 1)}

    class Interpreter:
        def __init__(self, model_path, num_threads):
            self.given = None

        def allocate_tensors(self):
            pass

        def get_input_details(self):
            return [{"index": 0, "shape": np.array(shapes["input"])}]

        def get_output_details(self):
            return [{"index": 1, "shape": np.array(shapes["output"])}]

        def set_tensor(self, index, value):
            assert (index, value.shape, value.dtype) == (0, shapes["input"], np.float32)
            self.given = value

        def invoke(self):
            pass

        def get_tensor(self, index):
            return self.given[..., :1]

    module = types.ModuleType("ai_edge_litert.interpreter")
    module.Interpreter = Interpreter
    monkeypatch.setitem(sys.modules, "ai_edge_litert", types.ModuleType("ai_edge_litert"))
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", module)
    (tmp_path / "selfie.tflite").write_bytes(b"")
    return tmp_path / "selfie.tflite", shapes


def test_the_mask_has_the_size_of_the_image(network):
    image = np.zeros((32, 16, 3), np.uint8)
    image[:16, :, 0] = 255
    mask = SelfieSegmentation(network[0]).mask(image)
    assert (mask.shape, mask.dtype) == ((32, 16), np.uint8)
    assert (mask[:12] == 255).all()
    assert (mask[20:] == 0).all()


def test_what_cannot_segment_is_refused(network, monkeypatch, tmp_path):
    path, shapes = network
    with pytest.raises(InputError, match="no such file"):
        SelfieSegmentation(tmp_path / "none.tflite")
    shapes["output"] = (1, 8, 4, 2)
    with pytest.raises(InputError, match=r"an output of shape \(1, 8, 4, 2\)"):
        SelfieSegmentation(path)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(UnavailableError, match="ai-edge-litert"):
        SelfieSegmentation(path)
