"""The README keeps its word: its links lead somewhere, its example is a method, its commands exist."""

import re
from pathlib import Path

import pytest

from headbench.bench.cli import COMMANDS
from headbench.bench.conformance import check_method
from headbench.bench.registry import discover, get
from headbench.bench.run_config import resolve_method

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINKS = [link for link in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in link]


@pytest.mark.parametrize("link", LINKS)
def test_links_lead_somewhere(link):
    assert (ROOT / link).exists()


def test_the_example_method_keeps_the_contract(monkeypatch, tmp_path):
    code = re.search(r"```python\n(# grey\.py\n.*?)```", README, re.DOTALL)
    assert code is not None
    (tmp_path / "grey.py").write_text(code[1])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "tests" / "bench")
    from toy_plugin import ToyClip

    method = resolve_method(get("methods", "grey:SPEC"), "demo", {})
    assert check_method(method, ToyClip(tmp_path / "subject1"), tmp_path / "out") == []


def test_the_commands_are_those_of_the_command_line():
    named = set(re.findall(r"^\| `headbench ([a-z]+(?: [a-z]+)?)(?: [A-Z]+)?`", README, re.MULTILINE))
    offered = {
        plugin.spec.name for plugin in discover("commands").values() if plugin.origin.startswith("headbench ")
    }
    assert named == set(COMMANDS) | offered


def test_make_targets_exist():
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"make (demo|test|setup|check|bench)\b", README)) <= targets
    assert {"setup", "demo", "test", "check", "bench"} <= targets


def test_ci_runs_the_test_command_of_the_readme():
    assert "make test" in README
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_the_table_is_generated_from_the_stored_rows_never_typed():
    from headbench.reports.readme import BEGIN, END, GALLERY, block

    shown = README.split(BEGIN)[1].split(END)[0].strip()
    assert shown == block(ROOT / GALLERY).strip()
