"""The coder of tables: lossless, near the entropy of its model, and closed to what was tampered with."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from headbench.methods.avatars.compact.container import Content, packed, read_content, write_content
from headbench.methods.avatars.compact.entropy import decode, encode
from headbench.methods.avatars.compact.transform import RATE_WEIGHT, levels


@given(hnp.arrays(np.uint32, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=40)))
def test_a_table_comes_back(table):
    stream, _ = encode(list(table))
    np.testing.assert_array_equal(decode(stream, *table.shape), table)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 30, 3000]), st.sampled_from([1, 17, 5000]))
def test_rows_that_depend_on_each_other_come_back(seed, spread, columns):
    rng = np.random.default_rng(seed)
    width = rng.integers(0, spread, columns)
    rows = [width, *(rng.integers(0, width + 1) for _ in range(3)), np.cumsum(rng.integers(0, 3, columns))]
    rows.append(2 * rows[1])
    stream, _ = encode(rows)
    for before, after in zip(rows, decode(stream, len(rows), columns)):
        np.testing.assert_array_equal(before, after)


def entropy(values):
    counts = np.bincount(values)
    shares = counts[counts > 0] / len(values)
    return -(shares * np.log2(shares)).sum() * len(values)


def test_independent_numbers_take_their_entropy():
    rng = np.random.default_rng(0)
    rows = [np.abs(np.rint(rng.normal(size=20_000) * scale)).astype(np.int64) for scale in (1, 4, 30)]
    stream, bits = encode(rows)
    known = sum(map(entropy, rows))
    assert known < 8 * len(stream) < 1.03 * known + 4000
    assert sum(bits) == pytest.approx(8 * len(stream), rel=0.02)


def test_what_an_earlier_row_tells_is_not_paid_twice():
    """Numbers whose spread is given by a row before take their entropy within each spread."""
    rng = np.random.default_rng(0)
    kind = rng.integers(0, 2, 40_000)
    rows = [np.rint(rng.normal(size=len(kind)) * np.where(kind, 200, 1)).astype(np.int64) for _ in range(4)]
    rows = [np.where(row < 0, -2 * row - 1, 2 * row) for row in rows]
    stream, _ = encode([kind, *rows])
    within = entropy(kind) + sum(entropy(row[kind == k]) for row in rows for k in (0, 1))
    apart = entropy(kind) + sum(map(entropy, rows))
    assert 8 * len(stream) < within + 0.25 * (apart - within)


def test_neighbours_and_equal_rows_are_predicted():
    rng = np.random.default_rng(0)
    steady = 2 * np.cumsum(rng.integers(0, 2, 20_000))  # signs are folded: even numbers are positive
    noise = rng.integers(0, 2**16, 20_000)
    _, bits = encode([steady, noise, noise])
    assert bits[0] < 1.2 * 20_000
    assert bits[2] < 0.01 * bits[1]
    assert bits[1] == pytest.approx(16 * 20_000, rel=0.02)


TABLE = np.abs(np.rint(np.random.default_rng(1).normal(size=(3, 3000)) * 9)).astype(np.uint8)


def test_a_damaged_stream_is_refused_or_another_table():
    """No damage raises anything but ValueError or hangs; nearly all of it is noticed."""
    stream, _ = encode(list(TABLE))
    rng = np.random.default_rng(0)
    noticed = 0
    for _ in range(60):
        damaged = bytearray(stream)
        damaged[rng.integers(len(stream))] ^= 1 << rng.integers(8)
        try:
            found = decode(bytes(damaged), *TABLE.shape)
        except ValueError:
            noticed += 1
        else:
            assert [row.shape for row in found] == [row.shape for row in TABLE]
    assert noticed > 50
    for wrong in (stream[:-2], stream + b"more", b"", stream[:8]):
        with pytest.raises(ValueError, match="stream"):
            decode(wrong, *TABLE.shape)
    for shape in ((2, 3000), (4, 3000), (3, 30_000)):
        with pytest.raises(ValueError, match="stream|row"):
            decode(stream, *shape)


def test_a_container_codes_arrays_of_as_many_columns_together(tmp_path):
    arrays = {
        "a": TABLE,
        "b": TABLE[2:].astype(np.uint16),
        "c": np.arange(7, dtype=np.uint8),
        "d": np.ones(3000, np.float32),
    }
    found = packed(arrays)
    assert ["a", "b"] in [list(names) for names in found.tables]
    assert set(found.sizes) == set(arrays)
    assert found.sizes["b"] < 0.2 * found.sizes["a"] / 3  # it is a row of a
    path = tmp_path / "x.safetensors"
    write_content(path, Content(arrays))
    for name, values in read_content(path).arrays.items():
        assert values.dtype == arrays[name].dtype
        np.testing.assert_array_equal(values, arrays[name])
    assert sum(found.sizes.values()) < path.stat().st_size < sum(found.sizes.values()) + 2000


def test_levels_trade_error_for_rate():
    """No uniform quantiser with the nearest level is better at the rate that a bit is worth; fine steps are left alone."""
    values = np.random.default_rng(0).laplace(size=50_000)
    for step in (2.0, 0.5, 0.01):
        scaled = values / step

        def cost(chosen, scaled=scaled):
            bits = entropy(chosen - chosen.min())
            return float(((chosen - scaled) ** 2).sum() + RATE_WEIGHT * bits)

        nearest, chosen = np.rint(scaled).astype(np.int64), levels(scaled)
        assert cost(chosen) <= cost(nearest)
        assert np.abs(chosen - scaled).max() < 2
    assert np.mean(levels(values / 0.001) != np.rint(values / 0.001)) < 0.2
