"""The end of a run: three lines, whose commands exist and name the real folder."""

import re
import shlex
from types import SimpleNamespace

import pytest

from headbench.bench.comparison import closing
from headbench.bench.registry import discover


def rows(failed=()):
    return SimpleNamespace(subjects={"a"}, methods={"ga", "ours"}, failed=list(failed))


@pytest.mark.parametrize("failed", [(), ("ga",)])
@pytest.mark.parametrize("page", [True, False])
def test_a_run_ends_with_place_contents_and_commands(tmp_path, failed, page):
    run = tmp_path / "a run"
    run.mkdir()
    if page:
        (run / "report.html").touch()
    text = closing(run, rows(failed))
    assert len(text.splitlines()) == 3
    assert ("Report: none" in text) is not page
    assert "2 methods on 1 subject:" in text
    commands = [shlex.split(line) for line in re.findall(r"`(headbench [^`]*)`", text)]
    assert all(words[1] in discover("commands") and str(run) in words for words in commands)
    assert ("status" in [words[1] for words in commands]) is bool(failed)
