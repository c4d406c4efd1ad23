"""What a machine lacks: told for each plug-in by what it says itself, and decided by those that count."""

import json
import re
from dataclasses import replace

import pytest

from headbench.bench import cli
from headbench.bench.contracts import no_progress
from headbench.bench.doctor import DoctorSettings, doctor
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.specs import Need


@pytest.fixture
def plugin(toy, monkeypatch):
    """The toy plug-in with methods that need this and that."""

    def needs(config, device):
        yield Need("a wheel", "round", "Turn it.")
        yield Need("a spare wheel", "", "Carry one.", required=False)
        if config.level > 0.9:
            yield Need("an engine", "", "Build one.")

    def fails(config, device):
        yield Need("a wheel", "round")
        raise UnavailableError("The garage is closed.", "Come back.")

    monkeypatch.setattr(toy, "needs", needs, raising=False)
    monkeypatch.setattr(toy, "fails", fails, raising=False)
    made = {
        "CAR": replace(toy.METHOD, name="car", needs="toy_plugin:needs"),
        "TAXI": replace(toy.METHOD, name="taxi", needs="toy_plugin:fails"),
        "GONE": replace(toy.METHOD, name="gone", implementation="toy_plugin:Nothing"),
        "OFFICIAL": replace(toy.METHOD, name="toy-official", native=False),
    }
    for name, spec in made.items():
        monkeypatch.setattr(toy, name, spec, raising=False)
    return toy


CASES = [
    (["CAR"], [], 0, "(?s)car +partly +a wheel: round.*no a spare wheel .works without.. Carry one."),
    (["CAR"], ["level=1.0"], 3, "(?s)missing.*no an engine. Build one.*Cannot run here: car"),
    (["CAR", "TAXI"], [], 3, "(?s)The garage is closed. Come back.*Cannot run here: taxi"),
    (["GONE"], [], 3, "cannot be imported"),
    (["OFFICIAL"], [], 3, "methods/official/README.md"),
    (["METHOD"], [], 0, "toy +ready"),
]


@pytest.mark.parametrize(("names", "settings", "code", "says"), CASES)
def test_what_is_missing_is_told_and_decides(plugin, capsys, names, settings, code, says):
    words = [f"toy_plugin:{name}" for name in names]
    for setting in settings:
        words += ["--set", f"settings.car.{setting}"]
    assert cli.main(["doctor", *words]) == code
    printed = capsys.readouterr().out
    assert re.search(says, printed), printed


def test_default_methods_decide_and_others_inform(capsys):
    assert cli.main(["doctor", "--json"]) == 0
    found = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)["plugins"]}
    assert found["ours"]["counts"]
    assert not found["lpips"]["counts"]
    assert found["synthetic"]["state"] == "ready"


def test_a_default_method_that_cannot_run_gives_no_verdict(monkeypatch):
    from headbench.methods.shared import method

    monkeypatch.setattr(method, "splats", lambda config, device: [Need("a kernel", "", "Compile it.")])
    findings = doctor(DoctorSettings(), no_progress)
    assert (findings.passed, findings.code) == (False, 3)
    assert re.search("Cannot run here: .*ours", findings.text)


@pytest.mark.parametrize(
    "settings",
    [{"methods": ("oours",)}, {"set": ("tasks=novel_view",)}, {"set": ("settings.ours.leveller=1",)}],
)
def test_names_that_are_not_known_are_refused(settings):
    with pytest.raises(InputError):
        doctor(DoctorSettings(**settings), no_progress)
