import errno
import json

import pytest

from headbench.bench import cli
from headbench.bench.demo import DemoConfig, parse_size
from headbench.bench.errors import InputError


@pytest.mark.parametrize("command", ["demo", "synth", "run", "table", "list", "bench", "stress"])
def test_help_teaches_every_option(command, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main([command, "--help"])
    assert caught.value.code == 0
    assert "usage: headbench" in capsys.readouterr().out


def test_bad_input_is_one_paragraph_and_exit_code_2(capsys, tmp_path):
    code = cli.main(["run", "--data", str(tmp_path / "none"), "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert code == 2
    assert "no such folder" in error
    assert "Traceback" not in error


def test_an_unknown_method_names_the_nearest(capsys, tmp_path):
    code = cli.main(["run", "--data", str(tmp_path), "--out", str(tmp_path / "out"), "--methods", "our,ga"])
    assert code == 2
    assert "Did you mean 'ours'" in capsys.readouterr().err


def test_an_unknown_key_in_the_configuration_file_is_refused(capsys, tmp_path):
    (tmp_path / "run.yaml").write_text("data: a\nout: b\nmetods: [ga]\n")
    assert cli.main(["run", "--config", str(tmp_path / "run.yaml")]) == 2
    error = capsys.readouterr().err
    assert "run.yaml, metods" in error
    assert "Did you mean 'methods'" in error


def test_missing_data_is_asked_for(capsys):
    assert cli.main(["run", "--out", "x"]) == 2
    assert "--data" in capsys.readouterr().err


def test_lists_are_machine_readable(capsys):
    assert cli.main(["list", "methods", "--json"]) == 0
    names = [entry["name"] for entry in json.loads(capsys.readouterr().out)]
    assert {"ours", "ga", "mean-image", "nearest-camera"} <= set(names)
    assert cli.main(["list", "presets"]) == 0
    assert "ours paper" in capsys.readouterr().out


def test_a_table_of_nothing_is_refused(capsys, tmp_path):
    assert cli.main(["table", str(tmp_path)]) == 2
    assert "run.json" in capsys.readouterr().err


def test_a_capture_is_made_in_an_empty_folder_by_one_process(monkeypatch, tmp_path):
    seen = []

    def make(*, out, **arguments):
        seen.append((list(out.iterdir()), [path.name for path in tmp_path.iterdir()]))

    monkeypatch.setattr(cli, "resolve", lambda reference: make)
    assert cli.main(["synth", "--out", str(tmp_path / "capture")]) == 0
    ((inside, beside),) = seen
    assert inside == []
    assert set(beside) == {"capture", ".capture.lock"}
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


@pytest.mark.parametrize("text", ["550", "550x", "axb", "0x10", "-5x20", "5x5", "1e3x20"])
def test_a_malformed_size_is_refused(text):
    with pytest.raises(InputError):
        parse_size(text)


def test_sizes_are_width_first():
    assert parse_size("550x802") == (550, 802)


def test_smoke_shrinks_the_capture():
    small, full = DemoConfig(preset="smoke").capture_arguments(), DemoConfig().capture_arguments()
    assert small["cameras"] < full["cameras"]
    assert small["timesteps"] < full["timesteps"]


@pytest.mark.parametrize(
    ("setting", "found"),
    [
        ("methodss=ga", "Did you mean 'methods'"),
        ("methods=gaa", "Did you mean 'ga'"),
        ("capture=3", "a group of settings"),
        ("capture.sizee=3", "capture.sizee"),
        ("device=gpu7", "device"),
    ],
)
def test_the_demo_checks_its_settings_before_it_makes_a_capture(
    capsys, tmp_path, monkeypatch, setting, found
):
    monkeypatch.setattr(cli, "_synthesise", lambda arguments: pytest.fail("a capture was made"))
    assert cli.main(["demo", "--out", str(tmp_path), "--set", setting]) == 2
    assert found in capsys.readouterr().err


@pytest.mark.parametrize("command", ["demo", "synth"])
def test_a_folder_that_cannot_be_written_is_refused_before_work(capsys, tmp_path, monkeypatch, command):
    monkeypatch.setattr(cli, "_synthesise", lambda arguments: pytest.fail("a capture was made"))
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "out", tmp_path / "a\0b"):
        assert cli.main([command, "--out", str(out)]) == 2
        assert "can be written" in capsys.readouterr().err


def test_json_gives_the_numbers_of_the_table(monkeypatch, tmp_path):
    text = "method,version,group,novel_view/psnr,novel_view/psnr/rank,novel_view/psnr/status,fps,fps/rank,fps/status\n"
    text += "ga,1,,25.5,1,ok,,,missing\n"
    monkeypatch.setattr(cli, "resolve", lambda reference: lambda folder, format: text)
    assert cli._means(tmp_path) == [
        {"task": "novel_view", "method": "ga", "metric": "psnr", "value": 25.5, "status": "ok"},
        {"task": "", "method": "ga", "metric": "fps", "value": None, "status": "missing"},
    ]


@pytest.fixture
def toy_benchmark(monkeypatch, tmp_path):
    (tmp_path / "toy_benchmark.py").write_text(
        "from headbench.bench.specs import BenchmarkSpec, Findings\n"
        "def speed(quick, progress):\n"
        "    return Findings('a table', {'quick': quick})\n"
        "def stress(quick, progress):\n"
        "    return Findings('a bad table', {}, passed=False)\n"
        "SPEC = BenchmarkSpec('toy', 'a toy', speed='toy_benchmark:speed', stress='toy_benchmark:stress')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("toy_benchmark")
def test_a_benchmark_prints_tables_or_json_and_writes_a_file(capsys, tmp_path):
    assert cli.main(["bench", "toy_benchmark:SPEC"]) == 0
    assert capsys.readouterr().out == "a table\n"
    out = tmp_path / "out.json"
    assert cli.main(["bench", "toy_benchmark:SPEC", "--quick", "--json", "--out", str(out)]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(out.read_text()) == {"quick": True}


@pytest.mark.usefixtures("toy_benchmark")
def test_a_benchmark_that_finds_a_fault_fails_the_command(capsys):
    assert cli.main(["stress", "toy_benchmark:SPEC"]) == 1
    assert capsys.readouterr().out == "a bad table\n"
    assert cli.main(["bench", "toy_benchmark:SPEC", "--tradeoffs"]) == 2
    assert "tradeoffs" in capsys.readouterr().err


def test_the_splat_benchmark_is_listed(capsys):
    assert cli.main(["list", "benchmarks"]) == 0
    assert "splats" in capsys.readouterr().out


def test_a_full_disk_is_told_in_a_line_with_its_remedy(capsys, monkeypatch):
    def full(*arguments, **settings):
        raise OSError(errno.ENOSPC, "No space left on device", "somewhere/rows.parquet")

    monkeypatch.setattr(cli, "_call", full)
    assert cli.main(["table", "run"]) == 2
    told = capsys.readouterr().err
    assert "somewhere/rows.parquet" in told
    assert "No space left" in told
    assert "Make room" in told


def test_other_faults_of_the_system_are_not_hidden(monkeypatch):
    def broken(*arguments, **settings):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(cli, "_call", broken)
    with pytest.raises(OSError, match="Input/output"):
        cli.main(["table", "run"])


def test_seeds_are_given_as_a_list(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(cli, "_run", lambda settings, json: seen.append(settings.seeds) or 0)
    arguments = ["run", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    assert cli.main([*arguments, "--seeds", "3,1,4"]) == 0
    assert cli.main([*arguments, "--seeds", "7"]) == 0
    assert seen == [(0,), (3, 1, 4), (7,)]
    assert cli.main([*arguments, "--seeds", "one"]) == 2


def test_a_synthetic_capture_is_given_a_folder_as_empty_as_it_was(tmp_path, monkeypatch):
    from headbench.datasets.synthetic import capture

    found = []

    def synthesize(out, **settings):
        found.append((list(out.iterdir()), settings["dynamics"]))
        return []

    monkeypatch.setattr(capture, "synthesize", synthesize)
    assert cli.main(["synth", "--out", str(tmp_path / "new"), "--dynamics", "2"]) == 0
    assert found == [([], 2.0)]
