import errno
import importlib.metadata
import io
import json
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from headbench.bench import cli, comparison, registry
from headbench.bench.engine import run as runner
from headbench.bench.engine.config import parse_size
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.registry import Plugin
from headbench.bench.specs import CommandResult
from headbench.datasets.synthetic import capture

GALLERY = Path(__file__).parents[2] / "reports" / "gallery"


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_output_is_readable_in_every_encoding(monkeypatch, run, encoding):
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    assert cli.main(["table", str(run)]) == 0
    if encoding == "ascii":
        assert cli.main(["table", str(run), "--format", "json"]) == cli.main(["--help"]) == 0
    assert cli.main(["table", "\N{CJK UNIFIED IDEOGRAPH-9762}\udcff"]) == 2
    sys.stdout.flush()
    sys.stderr.flush()
    text = sys.stdout.buffer.getvalue().decode(encoding)
    assert "PSNR" in text
    assert "\\u" not in text
    assert "?" not in text
    assert ("\N{UPWARDS ARROW}" in text) == (encoding == "utf-8")
    assert rb"\udcff" in sys.stderr.buffer.getvalue()


def test_help_and_version_are_found_by_their_usual_words(capsys):
    version = f"headbench {importlib.metadata.version('headbench')}\n"
    shown = {"": "headbench compares", "help": "usage: headbench ", "help run": "usage: headbench run "}
    for words, text in (shown | {"version": version, "-V": version, "--version": version}).items():
        assert cli.main(words.split()) == 0
        assert capsys.readouterr().out.startswith(text)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("run --data none --out out", "no such folder"),
        ("run --data . --out out --methods our,ga", "Did you mean 'ours'"),
        ("run --data . --out out --set iteratoins=3", "Did you mean settings.METHOD.budget.iterations?"),
        ("run --data . --out out --set sedes=3", "Did you mean 'seeds'"),
        ("run --config run.yaml", "run.yaml, metods: expected one of"),
        ("table .", "run.json"),
        ("demo --out out --set methods=gaa", "Did you mean 'ga'"),
        ("demo --out out --set capture=3", "a group of settings"),
        ("demo --out out --set device=gpu7", "device"),
        ("demo --out a\0b", "can be written"),
        ("synth --out out --size 5x5", "WIDTHxHEIGHT"),
    ],
)
def test_bad_input_is_refused_before_work(capsys, tmp_path, monkeypatch, words, found):
    monkeypatch.setattr(capture, "synthesize", lambda **arguments: pytest.fail("a capture was made"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.yaml").write_text("data: a\nout: b\nmetods: [ga]\n")
    assert cli.main(words.split(" ")) == 2
    error = capsys.readouterr().err
    assert found in error
    assert "Traceback" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["run.yaml"]


def test_a_capture_is_made_in_an_empty_folder_by_one_process(monkeypatch, tmp_path):
    seen = []

    def make(*, out, dynamics, **arguments):
        out.mkdir(exist_ok=True)
        seen.append((list(out.iterdir()), {path.name for path in tmp_path.iterdir()}, dynamics))
        (out / "image.png").touch()

    monkeypatch.setattr(capture, "synthesize", make)
    assert cli.main(["synth", "--out", str(tmp_path / "capture"), "--dynamics", "2"]) == 0
    assert seen == [([], {"capture", ".capture.lock"}, 2.0)]
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def test_sizes_are_width_first():
    assert parse_size("550x802") == (550, 802)
    for text in ("550", "550x", "axb", "0x10", "-5x20", "5x5", "1e3x20"):
        with pytest.raises(InputError):
            parse_size(text)


def test_formats_of_a_table_are_not_wrapped(capsys, monkeypatch, config, finished):
    finished(replace(config, methods=("toy_plugin:METHOD", "toy_plugin:MIRROR", "mean-image")))
    monkeypatch.setenv("COLUMNS", "40")
    for words in (["--format", "md"], ["--json"]):
        texts = []
        for terminal in (True, False):
            monkeypatch.setattr(sys.stdout, "isatty", lambda terminal=terminal: terminal)
            assert cli.main(["table", config.out, *words]) == 0
            texts.append(capsys.readouterr().out)
        assert texts[0] == texts[1]


def test_a_benchmark_prints_a_table_or_json(capsys, tmp_path, monkeypatch):
    (tmp_path / "toy_benchmark.py").write_text(
        "from headbench.bench.specs import BenchmarkSpec, CommandResult\n"
        "def speed(quick, progress):\n"
        "    return CommandResult('a table', {'quick': quick})\n"
        "def stress(quick, progress):\n"
        "    return CommandResult('a bad table', {}, passed=False)\n"
        "SPEC = BenchmarkSpec('toy', 'a toy', speed='toy_benchmark:speed', stress='toy_benchmark:stress')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert cli.main(["doctor", "bench", "toy_benchmark:SPEC"]) == 0
    assert capsys.readouterr().out == "a table\n"
    out = tmp_path / "out.json"
    assert cli.main(["doctor", "bench", "toy_benchmark:SPEC", "--quick", "--json", "--out", str(out)]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(out.read_text()) == {"quick": True}
    assert cli.main(["doctor", "stress", "toy_benchmark:SPEC"]) == 1
    assert capsys.readouterr().out == "a bad table\n"
    assert cli.main(["doctor", "bench", "toy_benchmark:SPEC", "--tradeoffs"]) == 2


FILE_EXISTS = FileExistsError(errno.EEXIST, "File exists", __file__)
ERRORS = [
    (InputError("a.json", "x", "1", "2"), 2, "headbench: a.json, x: expected 1, found 2.\n"),
    (HeadbenchError("no"), 2, "headbench: no\n"),
    (OSError(errno.EACCES, "Permission denied", "a"), 2, "headbench: a: Permission denied\n"),
    (FILE_EXISTS, 2, ": expected a folder, found a file\n"),
    (OSError(errno.ENOSPC, "No space left on device", "a"), 2, "start again.\n"),
    (OSError("of a library,\nin two lines"), 2, "headbench: of a library, in two lines\n"),
    (BrokenPipeError(errno.EPIPE, "Broken pipe"), 2, "headbench: Broken pipe\n"),  # not of standard output
    (KeyboardInterrupt(), 130, "headbench: interrupted; start it again to continue\n"),
    (KeyError("x"), 70, "please report it with the lines above\n"),
]


@pytest.mark.parametrize(("raised", "code", "line"), ERRORS)
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


MAKE_ROOM = "Free disk space or allow writing, then start again.\n"


@pytest.mark.parametrize("path", ["n" * 300, ".", "/dev/null"], ids=["long", "folder", "device"])
def test_a_path_that_cannot_be_used_is_code_2(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = [
        "table {}",
        "run --config {}",
        "doctor stress statistics --out {}",
        "compare . --baseline b --junit {}",
    ]
    lines += (
        ["run --data . --out {}", "synth --out {}"] if path != "." else ["compare . --baseline {} --update"]
    )
    for line in lines:
        assert cli.main(line.format(path).split()) == 2
        error = capsys.readouterr().err
        assert error.startswith("headbench: ")
        assert error.count("\n") == 1
    assert list(tmp_path.glob(".*")) == []


def test_output_that_goes_nowhere():
    """A full disk is an error of its own; a reader that has gone changes no verdict."""
    command = shlex.join([sys.executable, "-m", "headbench.bench.start"])
    for line, code in (("list methods > /dev/full", 2), ("list methods | true; exit ${PIPESTATUS[0]}", 0)):
        done = subprocess.run(
            ["bash", "-c", f"{command} {line}"], stderr=subprocess.PIPE, text=True, check=False
        )
        assert done.returncode == code, done.stderr
        assert done.stderr == ("headbench: standard output: No space left on device. " + MAKE_ROOM) * (
            code == 2
        )


@pytest.fixture
def seen(monkeypatch):
    """Configurations and executions of the runs that would be made."""
    seen = []
    monkeypatch.setattr(runner, "run", lambda config, execution, unchecked: seen.append((config, execution)))
    monkeypatch.setattr(comparison, "_result", lambda run: CommandResult("", {}))
    return seen


def test_a_run_takes_settings_and_executors_from_its_options(seen, tmp_path):
    slurm = ["--set", "execution.executor=slurm", "--set", "execution.slurm.partition=gpu"]
    processes = ["--executor", "processes", "--workers", "3"]
    for words in ([], ["--seeds", "3,1,4", *processes], ["--seeds", "7", "--preset", "of-a-plug-in", *slurm]):
        assert cli.main(["run", "--data", str(tmp_path), "--out", str(tmp_path / "out"), *words]) == 0
    assert [(config.seeds, config.preset) for config, _ in seen] == [
        *(((0,), "fast"), ((3, 1, 4), "fast"), ((7,), "of-a-plug-in"))
    ]
    assert [(e.executor, e.workers, e.slurm.partition) for _, e in seen] == [
        *(("inline", None, None), ("processes", 3, None), ("slurm", None, "gpu"))
    ]


def test_a_run_takes_the_reader_that_finds_its_capture(monkeypatch, seen, tmp_path, toy):
    plugins = {name: Plugin(name, "", replace(toy.READER, name=name)) for name in ("toy", "other")}
    monkeypatch.setattr(registry, "discover", lambda group: {"toy": plugins["toy"]})
    (tmp_path / "data").mkdir()
    words = ["run", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert cli.main(words) == 0
    (tmp_path / "data" / "subject1").mkdir()
    assert cli.main(words) == 0
    assert cli.main([*words, "--set", "reader=colmap"]) == 0
    assert [config.reader for config, _ in seen] == ["ga", "toy", "colmap"]
    monkeypatch.setattr(registry, "discover", lambda group: plugins)
    assert cli.main(words) == 2


WRONG = {
    "--set execution.slurm.partitoin=x": "Did you mean 'partition'",
    "--set execution.workers=0": "at least 1",
    "--set execution.slurm.hours=0": "at least a minute",
    "--set execution.executor=dask": "inline",
}


@pytest.mark.parametrize("command", ["run --data d", "synth"])
def test_settings_of_executors_are_checked(command, tmp_path, capsys, seen, monkeypatch):
    monkeypatch.setattr(capture, "synthesize", lambda **arguments: seen.append(arguments))
    for words, message in WRONG.items():
        assert cli.main([*command.split(), "--out", str(tmp_path / "o"), *words.split()]) == 2
        assert message in capsys.readouterr().err
    assert seen == []
