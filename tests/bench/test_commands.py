"""Commands that rooms offer: their settings become options, their findings output and exit code."""

import json

import pytest

from headbench.bench import cli, commands
from headbench.bench.registry import Plugin
from headbench.bench.specs import CommandSpec

TOY = """
from dataclasses import dataclass
import tyro
from headbench.bench.specs import Findings
from headbench.bench.errors import InputError

@dataclass(frozen=True)
class Settings:
    path: tyro.conf.Positional[str]
    \"\"\"What to look at.\"\"\"
    limit: float = 0.5
    \"\"\"Most that may be wrong.\"\"\"

def run(settings, progress):
    if settings.limit < 0:
        raise InputError("command line", "limit", "at least 0", str(settings.limit))
    code = 3 if settings.limit == 3 else None
    return Findings(f"looked at {settings.path}", {"limit": settings.limit}, settings.limit < 1, code)
"""


@pytest.fixture
def offer(monkeypatch, tmp_path):
    (tmp_path / "toy_command.py").write_text(TOY)
    monkeypatch.syspath_prepend(tmp_path)

    def offer(*names, settings="toy_command:Settings"):
        specs = [CommandSpec(name, "look at it", "toy_command:run", settings) for name in names]
        found = {spec.name.replace(" ", "-"): Plugin(spec.name, "toys 1", spec) for spec in specs}
        monkeypatch.setattr(commands, "discover", lambda group: found)

    return offer


def test_settings_are_options_and_findings_are_printed(offer, capsys):
    offer("look")
    assert cli.main(["look", "here", "--limit", "0.25"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    assert cli.main(["look", "here", "--limit", "0.25", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"limit": 0.25}


def test_what_does_not_pass_is_one_and_bad_input_is_two(offer, capsys):
    offer("look")
    assert cli.main(["look", "here", "--limit", "2"]) == 1
    assert cli.main(["look", "here", "--limit", "-1"]) == 2
    assert "at least 0" in capsys.readouterr().err


def test_findings_may_give_an_exit_code_of_their_own(offer):
    offer("look")
    assert cli.main(["look", "here", "--limit", "3"]) == 3


def test_two_words_share_the_first(offer, capsys):
    offer("make big", "make small")
    assert cli.main(["make", "small", "here"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    with pytest.raises(SystemExit) as stop:
        cli.main(["make"])
    assert stop.value.code == 2
    assert "{big, small}" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    assert "big, small" in capsys.readouterr().out


def test_help_shows_the_settings_text(offer, capsys):
    offer("look")
    with pytest.raises(SystemExit):
        cli.main(["look", "--help"])
    assert "Most that may be wrong." in capsys.readouterr().out


def test_a_broken_command_is_listed_and_raises_only_when_called(offer, capsys):
    offer("look", settings="not_there:Settings")
    assert cli.main(["list", "reports"]) == 0
    assert cli.main(["look"]) == 2
    assert "not_there" in capsys.readouterr().err
