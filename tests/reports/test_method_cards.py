"""Citations of methods with printed figures."""

import json

from headbench.bench.registry import discover
from headbench.reports import papers as method_cards
from headbench.reports.papers import (
    citations,
    measured_figures,
    measured_text,
    printed_figures,
)


def figures(name):
    return printed_figures(discover("methods")[name].spec)


def test_claims_of_a_paper_come_before_what_others_ran():
    found = figures("ours")
    own = [figure.own for figure in found]
    assert own == sorted(own, reverse=True)
    claimed, others = (
        {f.values.get("novel_view/psnr") for f in found if f.own == kind} for kind in (True, False)
    )
    assert "32.97" in claimed
    assert {"31.28", "26.33"} <= others


def test_measured_figures_say_on_what_they_were_measured(tmp_path, monkeypatch):
    file = tmp_path / "measured.json"
    monkeypatch.setattr(method_cards, "MEASURED", file)
    assert measured_figures("ours") is None
    stored = {"suite": "suite", "data": "two subjects", "methods": {"ours": {"novel_view/psnr": "30.10"}}}
    file.write_text(json.dumps(stored))
    assert measured_figures("ga") is None
    assert (
        measured_text(measured_figures("ours")) == "novel view 30.10 dB (by headbench, suite: two subjects)"
    )


def test_every_method_with_a_source_has_a_citation():
    cards = {card["name"]: card for card in citations()}
    for name, plugin in discover("methods").items():
        spec = plugin.spec
        if spec is not None and spec.source:
            assert spec.source in cards[name]["summary"]
            assert spec.bibtex.strip().splitlines()[:1] == cards[name]["bibtex"].splitlines()[:1]
