"""``headbench lint``: exit codes, JSON, list, places; and no false alarm on a synthetic capture."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from headbench.bench.cli import main
from headbench.bench.errors import InputError
from headbench.datasets.ga.layout import Declaration
from headbench.datasets.lint.command import lint
from headbench.datasets.lint.settings import LintSettings
from headbench.datasets.synthetic.capture import synthesize


def _exclude(capture, excluded):
    replace(Declaration.read(capture.union), excluded=excluded).write(capture.union)


def test_clean_warning_and_strict(good):
    settings = LintSettings(str(good.union), views=4, duplicates=20)
    assert lint(settings).passed
    _exclude(good, {3: ""})
    findings = lint(settings)
    assert findings.passed
    assert findings.data["counts"] == {"error": 0, "warning": 1, "note": 0}
    assert not lint(replace(settings, strict=True)).passed
    assert lint(replace(settings, strict=True, ignore=("HB109",))).passed


def test_an_error_does_not_pass_and_names_its_place(good):
    _exclude(good, {77: "tongue out"})
    findings = lint(LintSettings(str(good.union), views=4, duplicates=20, ignore=("HB100",)))
    assert not findings.passed
    (found,) = findings.data["findings"]
    assert (found["code"], found["severity"], found["key"]) == ("HB108", "error", "excluded")
    assert found["file"] == f"{good.union.name}/headbench.json"
    assert found["remedy"]
    for text in ("HB108 error", "77", found["file"], "1 error, 0 warnings"):
        assert text in findings.text


@pytest.mark.parametrize(
    "settings", [LintSettings(), LintSettings("nowhere"), LintSettings("x", ignore=("HB999",))]
)
def test_bad_input(settings):
    with pytest.raises(InputError):
        lint(settings)


@pytest.mark.commands
def test_exit_codes_and_json_on_the_command_line(good, capsys):
    arguments = ["lint", str(good.union), "--json", "--views", "4"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["findings"] == []
    _exclude(good, {77: "tongue out"})
    assert main(arguments) == 1
    assert not json.loads(capsys.readouterr().out)["passed"]
    assert main(["lint", str(good.union / "nothing")]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_nothing_is_found_in_a_synthetic_capture(tmp_path, noise):
    """Hair over the mesh, soft masks, dark skin, tracking noise: nothing of that is a fault."""
    synthesize(
        tmp_path, cameras=2, timesteps=16, size=(96, 136), seed=3, tracking_noise=noise, samples_per_pixel=9
    )
    few = ("HB110", "HB616")  # cameras and timesteps
    assert lint(LintSettings(str(tmp_path), ignore=few)).data["findings"] == []
