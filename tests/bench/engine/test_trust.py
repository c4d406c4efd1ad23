"""Names in a run folder run code only if this command names them, too, or trusts the folder."""

from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench.condition import PLAIN, Condition, Named
from headbench.bench.engine.captures import run_configuration
from headbench.bench.engine.config import RunConfig, RunOptions
from headbench.bench.engine.run import grown
from headbench.bench.engine.store import RunFolder
from headbench.bench.engine.trust import PROGRAMS, check_trusted
from headbench.bench.errors import InputError
from headbench.bench.io.files import write_json
from headbench.bench.manifest import Manifest

OTHERS = "stranger:SPEC"


@pytest.mark.parametrize("trust", [False, True])
@pytest.mark.parametrize(
    ("key", "name", "given", "allowed"),
    [
        ("methods", "ga", {}, True),
        ("methods", OTHERS, {}, False),
        ("methods", OTHERS, {"methods": (OTHERS,)}, True),
        ("methods", OTHERS, {"metrics": (OTHERS,)}, False),
        ("reader", OTHERS, {}, False),
        ("conditions", "", {}, True),
        (PROGRAMS, "ga-official", {}, False),
        (PROGRAMS, "ga-official", {PROGRAMS: ("ga-official",)}, True),
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
SET = Condition("set", ("ga-official",), {"python": "/bin/true"})
RUN = {
    "method": ({"methods": ("ga", OTHERS)}, "methods"),
    "metric": ({"metrics": ("psnr", OTHERS)}, "metrics"),
    "profile": ({"metric_profiles": ("canonical", OTHERS)}, "metric_profiles"),
    "change of a condition": ({"conditions": (PLAIN, CHANGED)}, "conditions"),
    "reader": ({"reader": OTHERS}, "reader"),
    "change of captures": ({"clip": Named(OTHERS)}, "conditions"),
    "program": ({"methods": ("ga", "ga-official")}, PROGRAMS),
    "program, settings": ({"methods": ("ga", "ga-official"), "conditions": (PLAIN, SET)}, PROGRAMS),
}
"""Changes of a run's configuration, and the key of what they run."""


@pytest.fixture
def stored(tmp_path, monkeypatch):
    """Write run.json of a plain run with some changes; return the plain configuration."""
    monkeypatch.setattr("headbench.bench.engine.captures._named", lambda config: {"data": config.data})
    plain = RunConfig(str(tmp_path), str(tmp_path), methods=("ga",), metrics=("psnr",))

    def stored(**changes):
        Manifest(replace(plain, **changes), (), (), (), {}, {}).write(tmp_path / "run.json")
        write_json(tmp_path / "rows.parquet", {})
        return plain

    return stored


@pytest.mark.parametrize("case", sorted(RUN))
def test_commands_that_read_or_continue_a_run_apply_it(stored, tmp_path, case):
    changes, key = RUN[case]
    config, folder = stored(**changes), RunFolder(tmp_path)
    if "program" not in case:
        with pytest.raises(InputError, match=f"configuration.{key}: .*--trust"):
            run_configuration(tmp_path, RunOptions())
        assert run_configuration(tmp_path, RunOptions(trust=True)).data == str(tmp_path)
    if case in ("reader", "change of captures"):
        return
    if case == "program, settings":  # of a method that this command names
        config = replace(config, methods=("ga", "ga-official"))
    with pytest.raises(InputError, match=f"configuration.{key}"):
        grown(config, folder)
    whole = grown(config, folder, trust=True)
    assert all(getattr(whole, name) == value for name, value in changes.items())
