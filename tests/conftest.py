"""What all tests share: a user's cache of their own, seeded random numbers."""

from __future__ import annotations

import gc
import os
import re
import shutil
from pathlib import Path

# OpenMP's workers spin while they wait, as the command line prevents; processes that share the cores take one each. Read
# when torch is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Nothing that is imported or collected is garbage: looking through it takes a fifth of the time of collecting.
gc.disable()

import pytest
import torch
from hypothesis import HealthCheck, settings

from headbench.bench.io import files
from headbench.methods.shared.threads import torch_threads

from . import world
from .axe import serious_findings

# How long an example takes says something of the machine's load, nothing of the code. The examples are the same in every
# run, so that a red run is the change's doing; `make nightly` looks for new ones among damaged files.
how = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow], "derandomize": True}
settings.register_profile("repeatable", max_examples=50, **how)
settings.load_profile("repeatable")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Digests of the tests' captures stay out of the user's cache; weights are still found in torch hub's."""
    with pytest.MonkeyPatch.context() as patch:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        patch.setenv("TORCH_HOME", os.environ.get("TORCH_HOME") or str(cache / "torch"))
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def seeded():
    """Every test starts from the same random numbers, in whatever order the tests run."""
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def one_torch_thread():
    """More threads cost small work more processor time than they save."""
    with torch_threads(1):
        yield


@pytest.fixture(scope="module")
def browser():
    """Chromium without a screen, with WebGL drawn by the processor."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome")
    chromium = next(filter(None, map(shutil.which, names)), None)
    if chromium is None:
        pytest.skip("there is no Chromium on this machine")
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=flags)
        yield browser
        browser.close()


@pytest.fixture
def new_tab(browser):
    """Open a tab of its own context; afterwards no page raised an error, and nothing else is in ``new_tab.faults``."""
    contexts, faults = [], []

    def new_tab(width=640, height=400, **options):
        contexts.append(browser.new_context(viewport={"width": width, "height": height}, **options))
        tab = contexts[-1].new_page()
        tab.set_default_timeout(60_000)  # a busy machine takes tens of seconds to open a page
        tab.on("pageerror", lambda error: faults.append(str(error)))
        return tab

    new_tab.faults = faults  # type: ignore[attr-defined]
    yield new_tab
    for context in contexts:
        context.close()
    assert faults == []


@pytest.fixture
def serious():
    """Serious findings of axe-core on an open page."""
    pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")
    return serious_findings


@pytest.fixture(scope="session", autouse=True)
def no_flushes():
    """Leave out the waiting for the disk, which takes more time than all else that tests do with files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "_flush", lambda path: None)
        yield


ALLOWED_SKIPS = {
    r"needs a GPU and gsplat": "no GPU in CI",
    r"is not beside the repository|beside the repository$|which is not there$": "files of others, which are not committed",
    r"^Slurm is not installed": "run on a cluster with `pytest -m slurm`",
}
"""Reasons for which a test may be skipped in CI (regular expressions), and why each is accepted."""


def pytest_sessionfinish(session):
    """Remove the shared world. In CI a skipped test is an error unless its reason is one of `ALLOWED_SKIPS`."""
    world.forget()
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if not os.environ.get("CI") or "PYTEST_XDIST_WORKER" in os.environ or reporter is None:
        return
    reasons = {report.longrepr[2].removeprefix("Skipped: ") for report in reporter.stats.get("skipped", [])}
    refused = sorted(r for r in reasons if not any(re.search(known, r) for known in ALLOWED_SKIPS))
    if refused:
        reporter.section("skips that are not allowed in CI")
        reporter.write_line("\n".join(refused))
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


SLOW_FILES = (
    "test_end_to_end.py",
    "test_readme.py",
    "test_flame_files.py",
    "test_benchmarks.py",
)


def pytest_collection_modifyitems(items):
    """Put slow files first that would come last: with several processes the other files fill the time that they take."""
    items.sort(key=lambda item: item.path.name not in SLOW_FILES)


def pytest_collection_finish():
    """From here on there is garbage, among what the tests make."""
    gc.freeze()
    gc.enable()
