"""The built site: links lead somewhere, no request leaves it, pages fit small windows and are accessible."""

import re

import pytest

pytestmark = pytest.mark.commands

SEEN = ("index", "howto/own-data", "reference/generated/methods/ours", "search")
READ = (*SEEN, "explanation/results", "reference/generated/api/contracts", "tutorials/paper-table")


def test_pages_have_no_warning_and_name_no_file_elsewhere(site):
    out, warnings = site
    assert warnings == ""
    loaded = re.compile(r"""<(?:script|link|img|iframe|source)[^>]+(?:src|href)=["'](?:https?:)?//""")
    pages = list(out.rglob("*.html"))
    assert len(pages) > 100
    assert [page.name for page in pages if loaded.search(page.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(("scheme", "width"), [("light", 1440), ("dark", 390)])
def test_pages_fit_and_are_silent(site, browser, scheme, width):
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page, heard = context.new_page(), []
    page.on("request", lambda request: heard.append(request.url) if "//" in request.url[:8] else None)
    page.on("console", lambda message: heard.append(message.text))
    page.on("pageerror", lambda error: heard.append(str(error)))
    for name in SEEN:
        address = (site[0] / f"{name}.html").as_uri()
        page.goto(f"{address}?q=max_splats" if name == "search" else address)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name
    page.wait_for_selector("#search-results li a")
    assert [text for text in heard if not text.startswith("file:")] == []
    context.close()


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_finds_nothing_serious_in_pages(site, new_tab, serious, scheme):
    tab = new_tab(1440, 900, color_scheme=scheme)
    found = {}
    for name in READ:
        tab.goto((site[0] / f"{name}.html").as_uri())
        found[name] = serious(tab)
    assert found == {name: [] for name in READ}
