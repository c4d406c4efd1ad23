"""Findings of axe-core, which a package brings, on an open page."""

from pathlib import Path

GRAVE = ("serious", "critical")


def serious_findings(tab):
    """Rules broken in a serious way, each with the elements; the script runs beside the page's own policy."""
    import axe_playwright_python

    script = (Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text("utf-8")
    tab.evaluate(script)
    found = tab.evaluate("axe.run(document, {resultTypes: ['violations']})")
    return [
        (rule["id"], [node["html"][:200] for node in rule["nodes"]])
        for rule in found["violations"]
        if rule["impact"] in GRAVE
    ]
