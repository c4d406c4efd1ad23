import itertools
import re

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from headbench.bench.errors import InputError
from headbench.bench.rows import ALL, Row, Rows

NAMED = {"method": ALL, "metric": ALL, "task": ALL, "region": ALL, "seeds": ALL}


@pytest.fixture
def rows():
    """A row of every combination; the value numbers them."""
    places = itertools.product(
        "ab", (0, 1), ("novel_view", "self_reenactment"), ("full", "face"), ("psnr", "ssim")
    )
    return Rows.of(
        Row(method, "1", seed, task, "s", "EMO", 0, "c", region, metric, float(index), f"hash-{task}")
        for index, (method, seed, task, region, metric) in enumerate(places)
    )


def test_words_of_every_row_are_changed():
    cells = [("b", ""), ("a", "less"), ("a", ""), ("b", "less"), ("a", "less")]
    rows = Rows.of(
        Row(m, "1", 0, "", "s", "", -1, "", "full", "storage", float(i), f"hash-{m}", condition=c)
        for i, (m, c) in enumerate(cells)
    )

    def found(changed, column):
        return changed.select(**NAMED, condition=ALL).sort_values("value")[column].tolist()

    assert found(rows.labelled(), "method") == ["b", "a+less", "a", "b+less", "a+less"]
    assert found(rows.labelled(), "condition") == [""] * 5
    assert found(rows.renamed({"a": "x", "b": "y"}), "method") == ["y", "x", "x", "y", "x"]
    assert found(rows.of_protocols({"hash-a": "new"}), "protocol") == [
        "hash-b",
        "new",
        "new",
        "hash-b",
        "new",
    ]
    for changed in (Rows.of([]).labelled(), Rows.of([]).renamed({}), Rows.of([]).of_protocols({})):
        assert len(changed) == 0


@pytest.mark.parametrize("forgotten", NAMED)
def test_a_query_that_forgets_a_name_is_refused(rows, forgotten):
    named = {name: value for name, value in NAMED.items() if name != forgotten}
    with pytest.raises(TypeError, match=forgotten):
        rows.select(**named)


@pytest.mark.parametrize(
    ("named", "count"),
    [
        ({}, 32),
        ({"region": "face"}, 16),
        ({"region": "full", "metric": "psnr", "task": "novel_view", "method": "b", "seeds": (1,)}, 1),
        ({"seeds": (0, 1), "method": "a"}, 16),
        ({"seeds": ()}, 0),
        ({"subject": "another"}, 0),
    ],
)
def test_a_query_gives_what_agrees_with_every_name(rows, named, count):
    found = rows.select(**{**NAMED, **named})
    assert len(found) == count
    for column in named.keys() - {"seeds"}:
        assert set(found[column]) <= {named[column]}


def test_rows_of_metrics_are_the_queries_joined(rows):
    order = ["ssim", "absent", "psnr"]
    expected = Rows.joined([Rows(rows.select(**{**NAMED, "metric": name})) for name in order])
    assert rows.of_metrics(order).select(**NAMED).equals(expected.select(**NAMED))


def test_many_parts_are_joined_in_order(rows):
    whole = rows.select(**NAMED)
    parts = [Rows(whole[index % len(whole) :][:3]) for index in range(200)]
    expected = pd.concat([part.select(**NAMED) for part in parts], ignore_index=True)
    pd.testing.assert_frame_equal(Rows.joined(parts).select(**NAMED), expected)


def test_rows_are_the_same_when_read_back(rows, tmp_path):
    rows.write(tmp_path / "rows.parquet")
    again = Rows.read(tmp_path / "rows.parquet")
    assert again.select(**NAMED).equals(rows.select(**NAMED))


def test_the_file_has_encodings_of_parquet_1_alone(rows, tmp_path):
    rows.write(tmp_path / "rows.parquet")
    group = pq.ParquetFile(tmp_path / "rows.parquet").metadata.row_group(0)
    columns = [group.column(index) for index in range(group.num_columns)]
    assert {name for column in columns for name in column.encodings} <= {"PLAIN", "RLE", "RLE_DICTIONARY"}
    assert {column.compression for column in columns} <= {"GZIP", "SNAPPY", "UNCOMPRESSED"}


def test_single_precision_keeps_seven_digits(rows, tmp_path):
    table = pd.concat([rows.select(**NAMED)] * 100, ignore_index=True)
    table["value"] = np.random.default_rng(0).uniform(20, 40, len(table))
    exact, short = Rows(table), Rows(table).in_single_precision()
    sizes = []
    for number, each in enumerate((Rows(table.assign(value=0.0)), exact, short)):
        each.write(path := tmp_path / f"{number}.parquet")
        sizes.append(path.stat().st_size)
    found = Rows.read(path).select(**NAMED)["value"].to_numpy()
    np.testing.assert_allclose(found, table["value"], rtol=2**-24, atol=0)
    assert sizes[2] - sizes[0] < 0.65 * (sizes[1] - sizes[0])


def written(path, frame, **how):
    frame.to_parquet(path, index=False, **how)
    return path


def replaced(path, old, new):
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda p, f: written(p, f.drop(columns="protocol")), "no protocol"),
        (lambda p, f: written(p, f.assign(value="a")), "a Parquet file of rows"),
        (lambda p, f: replaced(p, b"\x08protocol", b"\x08p\xecotocol"), "a Parquet file of rows"),
    ],
)
def test_a_file_that_holds_no_rows_is_refused(rows, tmp_path, spoil, found):
    path = tmp_path / "rows.parquet"
    rows.write(path)
    spoil(path, rows.select(**NAMED))
    with pytest.raises(InputError, match=re.escape(found)) as caught:
        Rows.read(path)
    assert caught.value.file == str(path)


def test_reasons_are_plain_and_of_bounded_length(tmp_path):
    place = ("a", "1", 0, "novel_view", "s", "EMO", 0, "c", "full", "psnr", float("nan"), "hash", "failed")
    Rows.of(Row(*place, reason) for reason in ("a\x1b[2J\nb", "x" * 10**6)).write(tmp_path / "rows.parquet")
    again = Rows.read(tmp_path / "rows.parquet").select(**NAMED)
    assert again["value"].isna().all()
    assert again["reason"][0] == "a\\x1b[2J\nb"
    assert len(again["reason"][1]) < 5000


def test_no_rows_are_read_back_as_none(tmp_path):
    Rows.of([]).write(tmp_path / "rows.parquet")
    assert len(Rows.read(tmp_path / "rows.parquet")) == 0
