"""Names in a run folder run code only if this command names them, too, or trusts the folder."""

from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine.captures import PROGRAMS, check_trusted, run_configuration
from headbench.bench.engine.config import RunConfig, RunOptions
from headbench.bench.errors import InputError
from headbench.bench.manifest import Manifest

OTHERS = "stranger:SPEC"


@pytest.mark.parametrize("trust", [False, True])
@pytest.mark.parametrize(
    ("key", "name", "given", "allowed"),
    [
        ("methods", "ga", {}, True),
        ("methods", OTHERS, {}, False),
        ("methods", OTHERS, {OTHERS}, True),
        ("methods", OTHERS, {"other:SPEC"}, False),
        ("reader", OTHERS, {}, False),
        ("conditions", "", {}, True),
        (PROGRAMS, "ga-official", {}, False),
        (PROGRAMS, "ga-official", {"ga-official"}, True),
    ],
)
def test_the_rule(key, name, given, allowed, trust):
    def check():
        check_trusted(Path("run.json"), {"tasks": ("novel_view",), key: (name,)}, given, trust=trust)

    if allowed or trust:
        check()
        return
    with pytest.raises(InputError, match=f"configuration.{key}: .*'{name}'"):
        check()


CHANGED = Condition("changed", clip=Named(OTHERS))
RUN = {
    "method": ({"methods": ("ga", OTHERS)}, "methods"),
    "metric": ({"metrics": ("psnr", OTHERS)}, "metrics"),
    "profile": ({"metric_profiles": ("canonical", OTHERS)}, "metric_profiles"),
    "change of a condition": ({"conditions": (PLAIN, CHANGED)}, "conditions"),
    "reader": ({"reader": OTHERS}, "reader"),
    "change of captures": ({"clip": Named(OTHERS)}, "conditions"),
}
"""Changes of a run's configuration, and the key of what they run."""


@pytest.mark.parametrize("case", sorted(RUN))
def test_commands_that_read_a_run_apply_it(tmp_path, monkeypatch, case):
    monkeypatch.setattr("headbench.bench.engine.captures._named", lambda config: {"data": config.data})
    changes, key = RUN[case]
    plain = RunConfig(str(tmp_path), str(tmp_path), methods=("ga",), metrics=("psnr",))
    Manifest(replace(plain, **changes), (), (), (), {}, {}).write(tmp_path / "run.json")
    with pytest.raises(InputError, match=f"configuration.{key}: .*--trust"):
        run_configuration(tmp_path, RunOptions())
    assert run_configuration(tmp_path, RunOptions(trust=True)).data == str(tmp_path)
