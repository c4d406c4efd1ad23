"""``headbench doctor check`` on plug-ins written outside, which import nothing but the root of headbench."""

import ast
import json
import subprocess
import sys

import pytest

import headbench
from headbench.bench import cli, contracts, errors, specs
from headbench.bench.conformance import command
from headbench.bench.engine import captures

PLUGINS = ("camera_mean:SPEC", "outside_reader:SPEC", "mae:MAE") + tuple(
    f"outside_metric:{name}" for name in ("ERROR", "JUMP", "FILES", "HOURS")
)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_plugins_written_outside_conform(outside, npz_capture, capsys, plugin):
    read_by = ["--reader", "outside_reader:SPEC", "--data", str(npz_capture)]
    data = {"camera_mean:SPEC": read_by, "outside_reader:SPEC": read_by[2:]}.get(plugin, [])
    assert cli.main(["doctor", "check", plugin, *data]) == 0
    assert "keeps its contract" in capsys.readouterr().out


def test_plugins_written_outside_import_the_root_alone(outside):
    for path in outside.glob("*.py"):
        names = {
            node.module for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)
        }
        assert {name for name in names if name.startswith("headbench")} <= {"headbench"}


def test_an_experiment_written_outside_runs_its_conditions(outside, npz_capture, tmp_path, monkeypatch):
    monkeypatch.setattr("headbench.bench.api.reader_of", lambda data: "outside_reader:SPEC")
    noise = headbench.Named("outside_experiment:NOISE", {"deviation": 40})
    conditions = [headbench.PLAIN, headbench.Condition("noise-40", clip=noise)]
    how = {"methods": ["mean-image"], "preset": "smoke", "metrics": ["psnr"], "conditions": conditions}
    run = headbench.run(npz_capture, tmp_path / "run", **how)
    rows = headbench.RunData.read(run).rows
    how = {"metric": "psnr", "task": "self_reenactment", "region": "full", "seeds": headbench.ALL}
    plain, noisy = (
        rows.select(method=name, **how)["value"].mean() for name in ("mean-image", "mean-image+noise-40")
    )
    assert plain != noisy


@pytest.fixture
def check(npz_capture):
    """The words that check the tutorial's method."""
    return [
        "doctor",
        "check",
        "camera_mean:SPEC",
        "--reader",
        "outside_reader:SPEC",
        "--data",
        str(npz_capture),
    ]


def test_breaches_are_listed_and_the_exit_code_is_one(outside, check, capsys, monkeypatch):
    monkeypatch.setattr("camera_mean.CameraMeanAvatar.files", lambda self: [])
    assert cli.main(check) == 1
    assert "1 breach of the contract of a method\n- files() names no file" in capsys.readouterr().out
    assert cli.main([*check, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["breaches"] == ["files() names no file"]


def test_what_a_plugin_raises_is_a_breach_with_its_line(outside, check, capsys):
    method = outside / "camera_mean.py"
    method.write_text(method.read_text().replace("progress(done, len(cameras))", "1 / 0"))
    assert cli.main([*check, "--set", "timesteps=many"]) == 2  # not of its type
    assert cli.main(check) == 1
    assert "ZeroDivisionError: division by zero (camera_mean.py, line" in capsys.readouterr().out


def test_without_data_a_method_is_tried_on_a_synthetic_capture(monkeypatch):
    made = []
    monkeypatch.setattr(command, "resolve", lambda reference: lambda **arguments: made.append(arguments))
    monkeypatch.setattr(captures, "open_clips", lambda config: [made.append(config.data)])
    monkeypatch.setattr(command, "_adapted", lambda *_: None)
    monkeypatch.setattr(command, "check_method", lambda *_, **__: [])
    command.check_plugin(command.CheckPluginSettings("mean-image"))
    arguments, data = made[-2:]
    assert str(arguments["out"]) == data
    assert arguments["cameras"] * arguments["timesteps"] <= 12


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["ga"], "--kind, one of methods, datasets"),
        (["ga", "--kind", "datasets"], "--data: expected a capture"),
        (["nothing"], "a name that `headbench list` shows"),
        (["no_module:SPEC"], "PYTHONPATH"),
        (["outside_metric:hours"], "a MethodSpec, a DatasetSpec or a MetricSpec"),
        (["synthetic", "--data", "."], "one that makes captures"),
        (["outside_reader:SPEC", "--data", ".", "--set", "drak=true"], "dark"),
    ],
)
def test_wrong_usage_is_refused(outside, capsys, arguments, error):
    assert cli.main(["doctor", "check", *arguments]) == 2
    assert error in capsys.readouterr().err


def test_the_root_exports_what_plugins_need_and_imports_it_late():
    code = (
        "import sys, headbench\n"
        "assert 'numpy' not in sys.modules\n"
        "assert set(headbench.__all__) <= set(dir(headbench))\n"
        "scripts = {'evaluate', 'list_methods', 'open_clip', 'run', 'train'}\n"
        "for name in set(headbench.__all__) - scripts: getattr(headbench, name)\n"
        "assert not {'torch', 'cv2'} & set(sys.modules)\n"
        "for name in scripts: getattr(headbench, name)\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        headbench.Nothing  # noqa: B018


def test_every_specification_and_protocol_is_exported():
    public = {
        name
        for module in (contracts, specs, errors)
        for name, value in vars(module).items()
        if isinstance(value, type) and value.__module__ == module.__name__
    }
    assert public - set(headbench.__all__) <= {"CommandSpec", "ExitCode", "Interruption"}
