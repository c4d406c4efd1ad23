import errno
import io
import json
import os
import shlex
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.runner.config import DemoConfig, parse_size

GALLERY = Path(__file__).parents[2] / "reports" / "gallery"


@pytest.mark.parametrize("command", ["demo", "synth", "run", "table", "list", "bench", "stress"])
def test_help_teaches_every_option(command, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main([command, "--help"])
    assert caught.value.code == 0
    assert "usage: headbench" in capsys.readouterr().out


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252", "utf-8"])
@pytest.mark.parametrize("words", [["table"], ["table", "--format", "json"], ["compare"], ["--help"]])
def test_output_is_readable_in_every_encoding(monkeypatch, encoding, words):
    folder = [] if words == ["--help"] else [str(GALLERY)]
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    with suppress(SystemExit):
        assert cli.main([*words, *folder]) == 0
    sys.stdout.flush()
    text = sys.stdout.buffer.getvalue().decode(encoding)
    assert "\\u" not in text
    assert "PSNR" in text or words == ["--help"]
    assert "?" not in text
    assert encoding != "utf-8" or words != ["table"] or "\N{UPWARDS ARROW}" in text


def test_what_no_encoding_holds_is_escaped(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert cli.main(["table", str(tmp_path / "\N{CJK UNIFIED IDEOGRAPH-9762}\udcff")]) == 2
    sys.stderr.flush()
    assert rb"\u9762\udcff" in sys.stderr.buffer.getvalue()


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


def test_json_gives_the_numbers_of_the_table():
    means = cli._means(GALLERY)
    found = {
        (mean["task"], mean["method"], mean["metric"]): (mean["value"], mean["status"]) for mean in means
    }
    rows = pd.read_parquet(GALLERY / "rows.parquet")
    own = rows[(rows["task"] == "novel_view") & (rows["method"] == "ga") & (rows["metric"] == "psnr")]
    own = own[own["region"] == "full"]
    expected = own.groupby("sequence")["value"].mean().mean()
    assert found["novel_view", "ga", "psnr"] == (pytest.approx(expected, abs=1e-9), "ok")
    assert len(found) == len(means) == 7 * 8  # methods, columns of the comparison


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


@pytest.mark.parametrize(
    ("raised", "code", "line"),
    [
        (InputError("a.json", "x", "1", "2"), 2, "headbench: a.json, x: expected 1, found 2.\n"),
        (HeadbenchError("no"), 2, "headbench: no\n"),
        (OSError(errno.EACCES, "Permission denied", "a"), 2, "headbench: a: Permission denied\n"),
        (OSError(errno.EISDIR, "Is a directory", "a"), 2, "headbench: a: Is a directory\n"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a"), 2, "headbench: a: File name too long\n"),
        (OSError(errno.EIO, "Input/output error"), 2, "headbench: Input/output error\n"),
        (OSError(errno.ENOSPC, "No space left on device", "a"), 2, "start again.\n"),
        (OSError("of a library,\nin two lines"), 2, "headbench: of a library, in two lines\n"),
        (
            BrokenPipeError(errno.EPIPE, "Broken pipe"),
            2,
            "headbench: Broken pipe\n",
        ),  # not of standard output
        (KeyboardInterrupt(), 130, "headbench: interrupted; start it again to continue\n"),
        (KeyError("x"), 70, "please report it with the lines above\n"),
        (RecursionError(), 70, "please report it with the lines above\n"),
    ],
)
def test_an_error_ends_in_a_line_and_its_exit_code(capfd, monkeypatch, raised, code, line):
    def fail(*arguments, **settings):
        raise raised

    monkeypatch.setattr(cli, "_call", fail)
    with open(os.devnull, "w") as stdout:
        monkeypatch.setattr("sys.stdout", stdout)
        assert cli.main(["table", "run"]) == code
    error = capfd.readouterr().err
    assert error.endswith(line)
    assert ("Traceback" in error) == (code == 70)


MAKE_ROOM = "Make room (or let it be written) and start again.\n"
LONG = "n" * 300


@pytest.mark.parametrize(
    "arguments",
    [
        ["table", LONG],
        ["table", "."],
        ["run", "--data", LONG, "--out", "out"],
        ["run", "--data", ".", "--out", LONG],
        ["run", "--config", LONG],
        ["run", "--config", "."],
        ["synth", "--out", LONG],
        ["synth", "--out", "/dev/null"],
        ["stress", "statistics", "--out", "."],
        ["bench", "statistics", "--out", LONG],
        ["bench", "statistics", "--out", "/dev/null"],
        ["gate", ".", "--baseline", "b", "--junit", "."],
        ["gate", ".", "--baseline", "b", "--junit", LONG],
        ["gate", ".", "--baseline", "b", "--markdown", "/dev/full"],
        ["gate", ".", "--baseline", ".", "--update"],
    ],
    ids=lambda arguments: " ".join(arguments).replace(LONG, "LONG"),
)
def test_a_path_that_cannot_be_used_is_code_2(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("headbench: ")
    assert error.count("\n") == 1
    assert list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("headbench list methods > /dev/full", 2),
        ("headbench --help > /dev/full", 2),
        ("headbench list methods >&-", 0),
        ("headbench list methods | true; exit ${PIPESTATUS[0]}", 0),
        ("headbench gate none --baseline none | true; exit ${PIPESTATUS[0]}", 3),
    ],
)
def test_output_that_goes_nowhere(command, code):
    """A full disk is an error of its own; a reader that has gone changes no verdict."""
    executable = shlex.join([sys.executable, "-m", "headbench.bench.cli"])
    done = subprocess.run(
        ["bash", "-c", command.replace("headbench", executable, 1)],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    assert done.stderr == ("headbench: standard output: No space left on device. " + MAKE_ROOM) * (code == 2)


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
