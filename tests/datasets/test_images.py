"""The image store: its memory bound, its order of eviction, threads."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headbench.bench.errors import InputError
from headbench.datasets import images
from headbench.datasets.head.geometry import on_grid
from headbench.datasets.images import ImageStore, read_image, write_image


@pytest.mark.parametrize(
    ("value", "rounded"), [(0.3, 0.25), (0.375, 0.5), (0.125, 0.0), (-0.6, -0.5), (-1e-18, 0.0), (7.0, 7.0)]
)
def test_values_go_to_the_nearest_multiple_ties_to_even(value, rounded):
    found = on_grid(np.array([value]), 2)
    np.testing.assert_array_equal(found, [rounded])
    assert not np.signbit(found[0]) or rounded < 0.0


WHITE = (1.0, 1.0, 1.0)
BYTES = 10 * 10 * 3


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    result = [folder / f"{i}.png" for i in range(6)]
    for i, path in enumerate(result):
        write_image(path, np.full((10, 10, 3), i, np.uint8))
    return result


@pytest.fixture
def reads(monkeypatch):
    """Paths decoded, in order."""
    decoded = []
    original = images.read_pixels
    monkeypatch.setattr(images, "read_pixels", lambda path: decoded.append(path) or original(path))
    return decoded


def held(store):
    return sum(array.nbytes for array in store._arrays.values())


def test_least_recently_used_goes_first(paths, reads):
    store = ImageStore(3 * BYTES / 1e6)
    for i in (0, 1, 2, 0, 3):  # 1 is the least recently used when 3 comes
        store.image(paths[i], WHITE)
    reads.clear()
    for i in (0, 2, 3):
        store.image(paths[i], WHITE)
    assert reads == []
    store.image(paths[1], WHITE)
    assert reads == [paths[1]]


@settings(max_examples=30, deadline=None)
@given(order=st.lists(st.integers(0, 5), max_size=30), capacity=st.integers(0, 4))
def test_bound_holds_after_every_read_and_pixels_are_right(paths, order, capacity):
    store = ImageStore(capacity * BYTES / 1e6)
    for i in order:
        assert (store.image(paths[i], WHITE) == i).all()
        assert held(store) <= capacity * BYTES
    assert held(store) == min(capacity, len(set(order))) * BYTES


def test_many_threads_read_right_pixels_within_the_bound(paths):
    store = ImageStore(2 * BYTES / 1e6)
    order = np.random.default_rng(0).integers(0, len(paths), size=400).tolist()

    def read(i):
        return i, int(store.image(paths[i], WHITE).max())

    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(read, order))
    assert all(i == value for i, value in results)
    assert held(store) == 2 * BYTES == store._held


def test_jpeg_channels_are_in_order(tmp_path):
    cv2.imwrite(str(tmp_path / "red.jpg"), np.full((16, 16, 3), (0, 0, 200), np.uint8))  # BGR
    pixel = read_image(tmp_path / "red.jpg", WHITE)[8, 8].astype(int)
    assert np.abs(pixel - [200, 0, 0]).max() <= 3


def test_file_that_does_not_decode_is_named(tmp_path):
    path = tmp_path / "bad.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\nrubbish")
    with pytest.raises(InputError, match="bad.png"):
        ImageStore().image(path, WHITE)
    with pytest.raises(InputError, match="none.png"):
        ImageStore().mask(tmp_path / "none.png")
    with pytest.raises(InputError, match="limit_mb"):
        ImageStore(-1)
