"""Citations of methods with printed figures."""

from headbench.bench.registry import discover
from headbench.reports.method_cards import citations, figure_text, printed_figures


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


def test_a_figure_says_what_was_printed_and_by_whom():
    (first, *_) = figures("ours")
    text = figure_text(first)
    assert text.startswith(
        "novel view 32.97 dB, self-reenactment 28.07 dB, speed 300 FPS (claimed: tensorial-2025"
    )


def test_every_method_with_a_source_has_a_citation():
    cards = {card["name"]: card for card in citations()}
    for name, plugin in discover("methods").items():
        spec = plugin.spec
        if spec is not None and spec.source:
            assert spec.source in cards[name]["summary"]
            assert spec.bibtex.strip().splitlines()[:1] == cards[name]["bibtex"].splitlines()[:1]
