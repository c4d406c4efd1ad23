"""The documentation, built once for all tests of it, without running its notebooks."""

import io
import os
from pathlib import Path
from warnings import catch_warnings, simplefilter

import pytest

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The application of Sphinx after it has written every page, and its warnings."""
    application = pytest.importorskip("sphinx.application")
    before = os.environ.get("HEADBENCH_DOCS_NOTEBOOKS")
    os.environ["HEADBENCH_DOCS_NOTEBOOKS"] = "no"
    out, warnings = tmp_path_factory.mktemp("site"), io.StringIO()
    try:
        app = application.Sphinx(DOCS, DOCS, out, out / "trees", "html", status=None, warning=warnings)
        with catch_warnings():
            simplefilter("ignore")  # of extensions, about coming versions of Sphinx
            app.build()
    finally:
        if before is None:
            del os.environ["HEADBENCH_DOCS_NOTEBOOKS"]
        else:
            os.environ["HEADBENCH_DOCS_NOTEBOOKS"] = before
    return app, warnings.getvalue()
