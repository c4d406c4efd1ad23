"""A table for pages: best rows first, empty columns as a sentence, notes numbered anew."""

import pandas as pd

from headbench.reports.tables import compact

from .conftest import LPIPS, PSNR, SIZE
from .made_rows import avatar_row, row, table_of


def made(values):
    rows = [row(method, "psnr", value) for method, value in values.items()]
    rows += [row(method, "lpips", float("nan"), status="missing", reason="No weights.") for method in values]
    rows += [avatar_row(method, "size", size) for size, method in enumerate(values, 1)]
    return table_of(pd.DataFrame(rows), [PSNR, LPIPS, SIZE], values, ["novel_view"])


def test_rows_are_best_first_and_empty_columns_a_sentence():
    table = made({"a": 20.0, "b": 30.0, "c": 25.0})
    found = compact(table)
    assert [line.method for line in found.rows] == ["b", "c", "a"]
    assert [column.metric for column in found.columns] == ["psnr", "size"]
    assert "No values of Novel view LPIPS: No weights." in found.caption
    assert found.notes == ()
    assert {line.method: line.cells[0].value for line in found.rows} == {
        line.method: line.cells[0].value for line in table.rows
    }


def test_a_table_without_values_stays():
    rows = [row("a", "lpips", float("nan"), status="missing", reason="No weights.")]
    table = table_of(pd.DataFrame(rows), [LPIPS], ["a"], ["novel_view"])
    assert compact(table) == table
