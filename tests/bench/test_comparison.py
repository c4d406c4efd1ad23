"""The demo: what it says before it starts and after it has ended, and how its avatars are trained."""

import pytest

from headbench.bench import comparison
from headbench.bench.contracts import no_progress
from headbench.bench.engine import run as runner
from headbench.bench.errors import InputError
from headbench.bench.specs import CommandResult


@pytest.mark.parametrize(
    ("preset", "takes"),
    [("quick", "about 3 minutes on two cores"), ("demo", "about 16 minutes on two cores")],
)
def test_the_demo_says_how_long_it_takes(monkeypatch, tmp_path, preset, takes):
    started = []

    def run(config, execution, **record):
        started.append((config, execution))

    monkeypatch.setattr(comparison, "resolve", lambda name: lambda **settings: None)
    monkeypatch.setattr(runner, "run", run)
    monkeypatch.setattr(comparison, "_result", lambda run: CommandResult("the table", {}))
    out = str(tmp_path / "out")
    result = comparison.demo(comparison.DemoSettings(out, preset), no_progress)
    ((config, execution),) = started
    assert execution.executor == "auto"
    assert bool(config.conditions[1:]) == (preset == "demo")  # coded avatars
    first = (tmp_path / "out" / "run.log").read_text().splitlines()[0]
    assert "trains 6 methods" in first
    assert takes in first
    assert first.endswith(f"{out}.")
    assert result.text.startswith("the table\nOne subject ranks nobody")


def test_the_preset_of_the_demo_is_no_setting(tmp_path):
    with pytest.raises(InputError, match="--preset"):
        comparison.demo(comparison.DemoSettings(str(tmp_path / "out"), set=("preset=demo",)), no_progress)
