"""The pages of tables meet axe-core's rules, and a fault is found."""

import pytest

from headbench.reports.table_report import table_text

pytestmark = pytest.mark.commands


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious_in_a_table(new_tab, serious, write_run, scheme):
    tab = new_tab(390, 700, color_scheme=scheme)
    run = write_run("run", {"good": 30.0, "better": 31.25, "mean-image": 12.0})
    tab.set_content(table_text([run], "html"))
    assert serious(tab) == []


def test_axe_finds_a_picture_without_a_text(new_tab, serious):
    tab = new_tab()
    tab.set_content("<!DOCTYPE html><html lang=en><title>t</title><main><h1>t</h1><img src='data:,'></main>")
    assert [rule for rule, _ in serious(tab)] == ["image-alt"]
