"""The script of ``make gpu``: its bounds, table and exit codes; its steps with the CPU on both sides, at small sizes."""

import importlib.metadata
import json
import math
import subprocess
import types
import zipfile

import pytest

from headbench.bench.errors import InputError
from headbench.tests.gpu import __main__ as script
from headbench.tests.gpu import bare, steps
from headbench.tests.gpu.steps import Bar

CASES = [
    (Bar("x", 1.0, 1.0), "pass"),
    (Bar("x", 1.1, 1.0), "FAIL"),
    (Bar("x", 2.0, 2.0, least=True), "pass"),
    (Bar("x", 1.0, 2.0, least=True), "FAIL"),
    (Bar("x", math.nan, 1.0), "FAIL"),
    (Bar("x", None, 1.0), "FAIL"),
    (Bar("x", 5.0), ""),
]


@pytest.mark.parametrize(("bar", "verdict"), CASES)
def test_a_bound_is_the_largest_or_the_least(bar, verdict):
    assert bar.cells()["verdict"] == verdict
    assert bar.holds == (verdict != "FAIL")


def raising(device, folder, report):
    """One that fails."""
    raise ValueError("no")


def finding(*values):
    def step(device, folder, report):
        """One of known outcome."""
        for value in values:
            report(Bar(f"on {device}", value, 1.0))

    return step


@pytest.mark.parametrize(
    ("step", "code", "shown"),
    [
        (finding(0.5, 1.0), 0, "pass"),
        (finding(0.5, 1.5), 1, "FAIL"),
        (finding(math.inf), 1, "none"),
        (raising, 1, "ended: ValueError"),
    ],
)
def test_one_step_alone_prints_its_table(monkeypatch, tmp_path, capsys, step, code, shown):
    monkeypatch.setattr(script, "STEPS", {1: step, 2: raising})
    assert script.main(["--device", "cpu", "--out", str(tmp_path), "--step", "1"]) == code
    assert shown in capsys.readouterr().out
    record = json.loads((tmp_path / "step-1.json").read_text())
    assert record["device"] == "cpu"
    assert record["machine"]["packages"]["torch"]
    assert [path.name for path in tmp_path.glob("*.json")] == ["step-1.json"]


@pytest.mark.parametrize(("second", "code"), [("ends", 0), ("hangs", 1), ("crashes", 1)])
def test_all_steps_run_as_processes_of_limited_time(monkeypatch, tmp_path, capsys, second, code):
    monkeypatch.setattr(script, "STEPS", {1: finding(0.5), 2: finding(0.25)})
    (tmp_path / "step-2.json").write_text(json.dumps({"device": "cpu", "bars": []}))  # of an earlier time

    def run(command, timeout, **options):
        assert timeout == script.LIMITS_S[int(command[command.index("--step") + 1])]
        own = command[command.index("headbench.tests.gpu") + 1 :]
        if own[1] == "2" and second != "ends":
            if second == "hangs":
                raise subprocess.TimeoutExpired(command, timeout)
            return
        script.run_step(int(own[1]), own[3], tmp_path)

    monkeypatch.setattr(script, "subprocess", types.SimpleNamespace(**vars(subprocess) | {"run": run}))
    assert script.main(["--device", "cpu", "--out", str(tmp_path)]) == code
    table = capsys.readouterr().out
    assert table.count("pass") == 4 - 2 * code
    assert ("none" in table) == (code == 1)


def test_without_a_gpu_one_sentence_and_code_3(monkeypatch, tmp_path, capsys):
    def refuse(device):
        raise InputError("device", "cuda", "a device", "none")

    monkeypatch.setattr(script, "check_device", refuse)
    assert script.main(["--out", str(tmp_path / "out")]) == 3
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_step_of_another_device_does_not_count(monkeypatch, tmp_path):
    monkeypatch.setattr(script, "STEPS", {1: finding(0.5)})
    script.run_step(1, "cpu", tmp_path)
    assert [bar.holds for bar in script.kept(1, "cuda", tmp_path)] == [False]


def test_what_was_found_before_a_step_was_ended_is_kept(monkeypatch, tmp_path):
    def killed(device, folder, report):
        report(Bar("first", 0.5, 1.0))
        raise KeyboardInterrupt

    monkeypatch.setattr(script, "STEPS", {1: killed})
    with pytest.raises(KeyboardInterrupt):
        script.run_step(1, "cpu", tmp_path)
    assert [(bar.what, bar.holds) for bar in script.kept(1, "cpu", tmp_path)] == [
        ("first", True),
        ("ended", False),
    ]


def test_the_folder_has_what_a_python_lacks(tmp_path):
    for name, inside in (("numpy-0.1", "numpy/no.py"), ("nosuch_package-0.1", "nosuch_package/x.py")):
        with zipfile.ZipFile(tmp_path / f"{name}-py3-none-any.whl", "w") as wheel:
            wheel.writestr(inside, "")
            wheel.writestr(f"{name.split('-')[0]}/tests/test_x.py", "")
        bare.shrink(tmp_path / f"{name}-py3-none-any.whl")
    bare.unpack(tmp_path, tmp_path / "site")
    files = [path.relative_to(tmp_path / "site") for path in (tmp_path / "site").rglob("*.py")]
    assert [str(path) for path in files] == ["nosuch_package/x.py"]


def test_without_an_installation_all_plug_ins_are_found(tmp_path):
    bare.install(tmp_path)
    own = next(importlib.metadata.distributions(path=[str(tmp_path)]))
    found = {(entry.group, entry.name, entry.value) for entry in own.entry_points}
    installed = importlib.metadata.distribution("headbench").entry_points
    assert found == {(e.group, e.name, e.value) for e in installed if e.group != "console_scripts"}
    assert (tmp_path / "headbench/__init__.py").exists()


def test_the_rasteriser_keeps_its_bounds_on_the_cpu(tmp_path):
    bars = []
    steps.rasteriser("cpu", tmp_path, bars.append)
    assert len(bars) == 6
    assert all(bar.holds and bar.found > 0 for bar in bars), bars


@pytest.mark.slow
@pytest.mark.parametrize(("number", "least"), [(2, 12), (3, 15)])
def test_the_other_steps_run_on_the_cpu(tmp_path, number, least):
    bars = []
    steps.STEPS[number]("cpu", tmp_path / "step", bars.append)
    assert len(bars) >= least
    assert all(bar.holds for bar in bars if "time over" not in bar.what), bars
