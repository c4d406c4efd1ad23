"""A fault is found by axe-core."""

import pytest

pytestmark = pytest.mark.commands


def test_axe_finds_a_picture_without_a_text(new_tab, serious):
    tab = new_tab()
    tab.set_content("<!DOCTYPE html><html lang=en><title>t</title><main><h1>t</h1><img src='data:,'></main>")
    assert [rule for rule, _ in serious(tab)] == ["image-alt"]
