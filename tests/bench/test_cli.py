import errno
import io
import json
import os
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from headbench.bench import cli, comparison
from headbench.bench.engine import captures
from headbench.bench.engine.config import DemoConfig, parse_size
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.registry import Plugin, discover
from headbench.bench.specs import CommandResult
from headbench.datasets.synthetic import capture

GALLERY = Path(__file__).parents[2] / "reports" / "gallery"


@pytest.mark.parametrize(
    ("words", "encoding"),
    [
        *((["table"], encoding) for encoding in ("ascii", "cp1252", "utf-8")),
        *((words, "ascii") for words in (["table", "--format", "json"], ["--help"])),
    ],
)
def test_output_is_readable_in_every_encoding(monkeypatch, run, words, encoding):
    folder = [] if words == ["--help"] else [str(run)]
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


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("", "usage: headbench "),
        ("help", "usage: headbench "),
        ("help run", "usage: headbench run "),
        ("version", "headbench "),
        ("-V", "headbench "),
    ],
)
def test_help_and_version_are_found_by_their_usual_words(words, shown, capsys):
    with suppress(SystemExit):
        assert cli.main(words.split()) == 0
    assert capsys.readouterr().out.startswith(shown)


def test_what_no_encoding_holds_is_escaped(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert cli.main(["table", str(tmp_path / "\N{CJK UNIFIED IDEOGRAPH-9762}\udcff")]) == 2
    sys.stderr.flush()
    assert rb"\u9762\udcff" in sys.stderr.buffer.getvalue()


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("run --data none --out out", "no such folder"),
        ("run --data . --out out --methods our,ga", "Did you mean 'ours'"),
        ("run --data . --out out --set iteratoins=3", "Did you mean settings.METHOD.budget.iterations?"),
        ("run --data . --out out --set sedes=3", "Did you mean 'seeds'"),
        ("demo --out out --set resolutio=3", "Did you mean settings.ours.planes.resolution?"),
        ("run --config run.yaml", "run.yaml, metods: expected one of"),
        ("run --out x", "--data"),
        ("table .", "run.json"),
        ("demo --out out --set methodss=ga", "Did you mean 'methods'"),
        ("demo --out out --set methods=gaa", "Did you mean 'ga'"),
        ("demo --out out --set capture=3", "a group of settings"),
        ("demo --out out --set capture.sizee=3", "capture.sizee"),
        ("demo --out out --set device=gpu7", "device"),
        ("demo --out run.yaml/out", "can be written"),
        ("demo --out a\0b", "can be written"),
        ("synth --out run.yaml/out", "can be written"),
        ("synth --out a\0b", "can be written"),
        ("synth --out out --size 5x5", "WIDTHxHEIGHT"),
        ("run --data . --out out --seeds one", "seeds"),
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


@pytest.mark.parametrize(
    "words",
    [
        "demo --preset smoke --set capture.head=none.npz",
        "synth --cameras 99",
        "run --data none",
        "run suite --methods none",
        "render none --capture none",
        "prepare refit none --target 2023",
        "inspect none",
        "export colmap none",
        "import ga none.ply",
        "export compact none",
    ],
)
def test_a_refused_command_leaves_no_folder(capsys, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*words.split(), "--out", "above/out"]) == 2
    assert "none" in capsys.readouterr().err or "99" in words
    assert list(tmp_path.iterdir()) == []


def test_lists_are_machine_readable(capsys):
    assert cli.main(["list", "methods", "--json"]) == 0
    names = [entry["name"] for entry in json.loads(capsys.readouterr().out)]
    assert {"ours", "ga", "mean-image", "nearest-camera"} <= set(names)
    assert cli.main(["list", "presets"]) == 0
    assert "ours paper" in capsys.readouterr().out


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


def test_json_gives_the_numbers_of_the_table():
    means = comparison.means(GALLERY)
    found = {(m["task"], m["method"], m["metric"]): (m["value"], m["status"]) for m in means}
    rows = pd.read_parquet(GALLERY / "rows.parquet")
    own = rows[(rows["task"] == "novel_view") & (rows["method"] == "ga") & (rows["metric"] == "psnr")]
    own = own[(own["region"] == "full") & (own["condition"] == "")]
    expected = own.groupby("sequence")["value"].mean().mean()
    assert found["novel_view", "ga", "psnr"] == (pytest.approx(expected, abs=1e-9), "ok")
    assert (
        len(found) == len(means) == 8 * (3 * 3 + 4)
    )  # methods; metrics of three tasks, storage, coded, by coding, speed


@pytest.mark.parametrize(
    ("words", "terminal", "pipes", "styles"),
    [
        ([], True, False, True),
        ([], False, True, False),
        (["--format", "md"], True, True, False),
        (["--format", "text"], False, False, False),
        (["--json"], True, False, False),
    ],
)
def test_a_table_is_aligned_text_on_a_terminal(
    capsys, monkeypatch, config, finished, words, terminal, pipes, styles
):
    finished(replace(config, methods=("toy_plugin:METHOD", "toy_plugin:MIRROR", "mean-image")))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    assert cli.main(["table", config.out, *words]) == 0
    printed = capsys.readouterr().out
    assert ("|" in printed, "\x1b" in printed) == (pipes, styles)
    assert ("<ins>" in printed) == pipes


@pytest.mark.parametrize("command", ["run", "run suite"])
def test_help_lists_the_presets_of_every_method(capsys, command):
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for name, plugin in discover("methods").items():
        if plugin.spec.presets:
            assert re.search(rf"\b{name}\b[^:]*: {', '.join(plugin.spec.presets)}[;.]", text), name


@pytest.fixture
def toy_benchmark(monkeypatch, tmp_path):
    (tmp_path / "toy_benchmark.py").write_text(
        "from headbench.bench.specs import BenchmarkSpec, CommandResult\n"
        "def speed(quick, progress):\n"
        "    return CommandResult('a table', {'quick': quick})\n"
        "def stress(quick, progress):\n"
        "    return CommandResult('a bad table', {}, passed=False)\n"
        "SPEC = BenchmarkSpec('toy', 'a toy', speed='toy_benchmark:speed', stress='toy_benchmark:stress')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("toy_benchmark")
def test_a_benchmark_prints_tables_or_json_and_writes_a_file(capsys, tmp_path):
    assert cli.main(["doctor", "bench", "toy_benchmark:SPEC"]) == 0
    assert capsys.readouterr().out == "a table\n"
    out = tmp_path / "out.json"
    assert cli.main(["doctor", "bench", "toy_benchmark:SPEC", "--quick", "--json", "--out", str(out)]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(out.read_text()) == {"quick": True}


@pytest.mark.usefixtures("toy_benchmark")
def test_a_benchmark_that_finds_a_fault_fails_the_command(capsys):
    assert cli.main(["doctor", "stress", "toy_benchmark:SPEC"]) == 1
    assert capsys.readouterr().out == "a bad table\n"
    assert cli.main(["doctor", "bench", "toy_benchmark:SPEC", "--tradeoffs"]) == 2
    assert "tradeoffs" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raised", "code", "line"),
    [
        (InputError("a.json", "x", "1", "2"), 2, "headbench: a.json, x: expected 1, found 2.\n"),
        (HeadbenchError("no"), 2, "headbench: no\n"),
        (OSError(errno.EACCES, "Permission denied", "a"), 2, "headbench: a: Permission denied\n"),
        (FileExistsError(errno.EEXIST, "File exists", __file__), 2, ": expected a folder, found a file\n"),
        (FileExistsError(errno.EEXIST, "File exists", "."), 2, "headbench: .: File exists\n"),
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


MAKE_ROOM = "Free disk space or allow writing, then start again.\n"
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
        ["doctor", "stress", "statistics", "--out", "."],
        ["doctor", "bench", "statistics", "--out", LONG],
        ["doctor", "bench", "statistics", "--out", "/dev/null"],
        ["compare", ".", "--baseline", "b", "--junit", "."],
        ["compare", ".", "--baseline", "b", "--junit", LONG],
        ["compare", ".", "--baseline", "b", "--markdown", "/dev/full"],
        ["compare", ".", "--baseline", ".", "--update"],
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
        ("headbench list methods >&-", 0),
        ("headbench list methods | true; exit ${PIPESTATUS[0]}", 0),
    ],
)
def test_output_that_goes_nowhere(command, code):
    """A full disk is an error of its own; a reader that has gone changes no verdict."""
    line = command.replace("headbench", shlex.join([sys.executable, "-m", "headbench.bench.start"]), 1)
    done = subprocess.run(["bash", "-c", line], stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == code, done.stderr
    assert done.stderr == ("headbench: standard output: No space left on device. " + MAKE_ROOM) * (code == 2)


def test_seeds_are_a_list_and_presets_are_those_of_the_methods(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(
        comparison,
        "_run",
        lambda config, execution, unchecked: (
            seen.append((config.seeds, config.preset)) or CommandResult("", {})
        ),
    )
    for words in ([], ["--seeds", "3,1,4"], ["--seeds", "7", "--preset", "of-a-plug-in"]):
        assert cli.main(["run", "--data", str(tmp_path), "--out", str(tmp_path / "out"), *words]) == 0
    assert seen == [((0,), "fast"), ((3, 1, 4), "fast"), ((7,), "of-a-plug-in")]


def test_a_run_takes_the_reader_that_finds_its_capture(monkeypatch, tmp_path, toy):
    seen = []
    plugins = {name: Plugin(name, "", replace(toy.READER, name=name)) for name in ("toy", "other")}
    monkeypatch.setattr(captures, "discover", lambda group: {"toy": plugins["toy"]})
    monkeypatch.setattr(
        comparison,
        "_run",
        lambda config, execution, unchecked: seen.append(config.reader) or CommandResult("", {}),
    )
    (tmp_path / "data").mkdir()
    words = ["run", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert cli.main(words) == 0
    (tmp_path / "data" / "subject1").mkdir()
    assert cli.main(words) == 0
    assert cli.main([*words, "--set", "reader=colmap"]) == 0
    assert seen == ["ga", "toy", "colmap"]
    monkeypatch.setattr(captures, "discover", lambda group: plugins)
    assert cli.main(words) == 2


@pytest.mark.parametrize(
    ("words", "executor", "workers", "partition"),
    [
        ((), "inline", None, None),
        (("--executor", "processes", "--workers", "3"), "processes", 3, None),
        (
            ("--set", "execution.executor=slurm", "--set", "execution.slurm.partition=gpu"),
            "slurm",
            None,
            "gpu",
        ),
    ],
)
def test_a_run_takes_its_executor_from_options_and_settings(
    words, executor, workers, partition, tmp_path, monkeypatch
):
    seen = []
    monkeypatch.setattr(
        comparison,
        "_run",
        lambda config, execution, unchecked: seen.append(execution) or CommandResult("", {}),
    )
    assert cli.main(["run", "--data", "d", "--out", str(tmp_path / "o"), *words]) == 0
    assert [(e.executor, e.workers, e.slurm.partition) for e in seen] == [(executor, workers, partition)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--set execution.slurm.partitoin=x", "Did you mean 'partition'"),
        ("--set execution.workers=0", "at least 1"),
        ("--set execution.slurm.hours=0", "at least a minute"),
        ("--set execution.executor=dask", "inline"),
        ("--set execution=3", "execution: expected a group of settings"),
        ("--workers 2", "--workers: expected --executor processes"),
    ],
)
@pytest.mark.parametrize("command", ["run --data d", "synth"])
def test_settings_of_executors_are_checked(command, words, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(comparison, "_run", lambda *arguments: pytest.fail("went on"))
    monkeypatch.setattr(capture, "synthesize", lambda **arguments: pytest.fail("went on"))
    assert cli.main([*command.split(), "--out", str(tmp_path / "o"), *words.split()]) == 2
    assert message in capsys.readouterr().err
