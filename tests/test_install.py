"""``make setup``: what is missing is named before anything is installed, and uv reads what pip is configured with."""

import importlib.util
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

FILE = Path(__file__).parents[1] / ".ci" / "install.py"


@pytest.fixture
def script():
    spec = importlib.util.spec_from_file_location("install", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("of", "name", "value", "found"),
    [
        (sys, "version_info", (3, 10, 4), "3.10.4"),
        (sys, "version_info", (3, 14, 0), "3.14.0"),
        (shutil, "which", lambda name: None, "compiler"),
        (shutil, "disk_usage", lambda path: SimpleNamespace(free=3e9), "3.0 GB"),
    ],
)
def test_what_a_machine_lacks_is_named(script, monkeypatch, of, name, value, found):
    script.check_machine("")
    monkeypatch.setattr(of, name, value)
    with pytest.raises(script.Failed, match=re.escape(found)):
        script.check_machine("")


def test_uv_reads_what_pip_is_configured_with(script, monkeypatch, tmp_path):
    listed = "global.find-links='/a\\n/b'\nglobal.timeout='9'\n:env:.index-url=\"https://one'two/simple\"\n"
    monkeypatch.setattr(script.subprocess, "run", lambda *args, **options: SimpleNamespace(stdout=listed))
    monkeypatch.setattr(script.os, "environ", {"UV_HTTP_TIMEOUT": "5"})
    own = {"UV_FIND_LINKS": "/a,/b", "UV_DEFAULT_INDEX": "https://one'two/simple", "UV_HTTP_TIMEOUT": "5"}
    assert script.uv_environment("python") == {"UV_INDEX_STRATEGY": "unsafe-best-match", **own}


@pytest.mark.parametrize(
    ("printed", "reason"),
    [
        ("error: dns error: failed to lookup", "no package index can be reached"),
        ("OSError: [Errno 28] No space left on device", "no space left"),
        ("something else", "something else"),
    ],
)
def test_the_reason_is_a_sentence_on_the_last_program(script, tmp_path, printed, reason):
    (tmp_path / "install.log").write_text(f"\n$ first\nOSError: [Errno 28]\n\n$ second\n{printed}\n")
    assert reason in script.Installer.reason(SimpleNamespace(log=tmp_path / "install.log"))
