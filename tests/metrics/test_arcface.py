"""ArcFace: alignment against a linear least-squares solution, and a small network whose numbers have a closed form."""

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.metrics.csim import PLACES, ArcFace, alignment, five_points

RNG = np.random.default_rng(0)
WEIGHTS, BIAS = RNG.normal(size=(3, 512)).astype(np.float32), RNG.normal(size=512).astype(np.float32)


def _number(value):
    return bytes([value]) if value < 128 else bytes([value & 127 | 128]) + _number(value >> 7)


def _field(number, value):
    """A field of a message in the format of protocol buffers."""
    if isinstance(value, int):
        return _number(number << 3) + _number(value)
    content = value.encode() if isinstance(value, str) else value
    return _number(number << 3 | 2) + _number(len(content)) + content


def _tensor(name, values):
    sizes = b"".join(_field(1, size) for size in values.shape)
    return _field(5, sizes + _field(2, 1) + _field(8, name) + _field(9, values.tobytes()))


def _picture(number, name, shape):
    sizes = b"".join(_field(1, _field(1, size)) for size in shape)
    return _field(number, _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, sizes))))


def onnx(length=None, channels=3, bias=BIAS, weights=WEIGHTS, side=112):
    """A file of ONNX: the mean colour of a picture, times weights, plus a bias."""
    length = length or len(bias)
    nodes = (
        ("GlobalAveragePool", ("x",), "mean"),
        ("Flatten", ("mean",), "flat"),
        ("Gemm", ("flat", "w", "b"), "y"),
    )
    graph = b"".join(
        _field(1, b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, kind))
        for kind, inputs, output in nodes
    )
    weights = np.resize(weights, (channels, weights.shape[1]))[:, :length]
    graph += _field(2, "g") + _tensor("w", weights) + _tensor("b", bias[:length])
    graph += _picture(11, "x", (1, channels, side, side)) + _picture(12, "y", (1, length))
    return _field(1, 8) + _field(7, graph) + _field(8, _field(2, 13))


@pytest.fixture
def path(tmp_path):
    (tmp_path / "network.onnx").write_bytes(onnx())
    return tmp_path / "network.onnx"


def marks(five):
    """68 landmarks with these middles of the eyes, tip of the nose and corners of the mouth."""
    landmarks = np.full((68, 2), np.nan)
    circle = np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1)
    landmarks[36:42], landmarks[42:48] = five[0] + 5 * circle, five[1] + 5 * circle
    landmarks[30], landmarks[48], landmarks[54] = five[2:]
    return landmarks


def test_alignment_is_the_least_squares_solution():
    points = PLACES @ [[1.1, 1.7], [-1.7, 1.1]] + (300, -20) + RNG.normal(size=(5, 2))
    x, y = points.T
    one, none = np.ones(5), np.zeros(5)
    rows = np.concatenate([np.stack([x, -y, one, none], 1), np.stack([y, x, none, one], 1)])
    a, b, right, down = np.linalg.lstsq(rows, PLACES.T.ravel(), rcond=None)[0]
    np.testing.assert_allclose(alignment(points, PLACES), [[a, -b, right], [b, a, down]], atol=1e-9)
    np.testing.assert_allclose(five_points(marks(points)), points)


def test_numbers_are_of_the_colours_of_the_aligned_face(path):
    colours = np.array([200, 100, 30], np.uint8)
    image = np.zeros((400, 400, 3), np.uint8)
    image[50:274, 120:344] = colours  # the crop, at half its scale
    found = ArcFace(path)(image, marks(2 * PLACES + (120, 50)))
    np.testing.assert_allclose(found, (colours / 127.5 - 1) @ WEIGHTS + BIAS, atol=1e-3)  # of the crop's edge
    assert found.dtype == np.float64  # the cosine between equal numbers is at most 1


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", ""),
        (b"not a network", ""),
        (onnx()[:-400], ""),
        (onnx(511), r"an output of shape \(1, 511\)"),
        (onnx(channels=1), ""),
        (onnx(bias=np.nan * BIAS), "not finite"),
    ],
    ids=["empty", "text", "cut", "length", "input", "numbers"],
)
def test_other_files_are_refused(path, content, found):
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"expected a network of ONNX.*{found}"):
        ArcFace(path)
