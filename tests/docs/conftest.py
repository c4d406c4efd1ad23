"""The generated reference as text, and the documentation as Sphinx builds it, each made once for all tests."""

import importlib.util
import io
from pathlib import Path
from warnings import catch_warnings, simplefilter

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="session")
def reference():
    """Text of every generated page, by its path below ``reference/generated``."""
    spec = importlib.util.spec_from_file_location("reference_pages", DOCS / "_ext" / "reference_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.pages()


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The folder into which Sphinx has written every page, and its warnings."""
    application = pytest.importorskip("sphinx.application")
    out, warnings = tmp_path_factory.mktemp("site"), io.StringIO()
    app = application.Sphinx(DOCS, DOCS, out, out / "trees", "html", status=None, warning=warnings)
    with catch_warnings():
        simplefilter("ignore")  # of extensions, about coming versions of Sphinx
        app.build()
    return out, warnings.getvalue()
