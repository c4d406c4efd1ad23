import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.images import quantise, read_png, write_png


def test_every_level_survives_the_round_trip(tmp_path):
    image = np.arange(256, dtype=np.uint8).reshape(16, 16, 1) * np.array([1, 3, 7], np.uint8)
    write_png(tmp_path / "a.png", image)
    assert np.array_equal(read_png(tmp_path / "a.png"), image)
    assert np.array_equal(quantise(image.astype(np.float32) / 255), image)


def test_rounding_goes_to_the_nearest_level_and_clamps():
    rgb = np.array([[[-0.5, 0.49 / 255, 0.51 / 255], [254.4 / 255, 254.6 / 255, 2.0]]])
    assert quantise(rgb).tolist() == [[[0, 0, 1], [254, 255, 255]]]


def test_a_non_finite_colour_is_refused():
    with pytest.raises(InputError, match="2 of 3"):
        quantise(np.array([[[np.nan, np.inf, 0.0]]]))


def test_bytes_are_not_taken_for_colours():
    with pytest.raises(InputError, match="floating-point"):
        quantise(np.zeros((1, 1, 3), np.uint8))


@pytest.mark.parametrize("content", [None, b"", b"\x89PNG\r\n\x1a\n truncated"])
def test_a_missing_or_damaged_image_is_refused(tmp_path, content):
    path = tmp_path / "a.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png"):
        read_png(path)
