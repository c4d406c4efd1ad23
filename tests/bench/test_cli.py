import dataclasses
import errno
import importlib.metadata
import io
import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from headbench.bench import cli, comparison, registry, specs
from headbench.bench.engine import run as runner
from headbench.bench.engine.config import parse_size
from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.io.files import KINDS
from headbench.bench.io.lock import locked
from headbench.bench.registry import Plugin
from headbench.bench.specs import CommandResult
from headbench.datasets.synthetic import capture

TOY = '''
from dataclasses import dataclass
import tyro
from headbench import CommandResult, InputError, command

@dataclass(frozen=True)
class Settings:
    path: tyro.conf.Positional[str]
    """What to look at."""
    limit: float = 0.5
    """Most that may be wrong."""

@dataclass(frozen=True)
class Lists:
    paths: tyro.conf.Positional[tuple[str, ...]]
    """Where."""
    names: tuple[str, ...] = ()
    """Which."""
    levels: tuple[float, ...] = (1.0,)
    """How much."""

@command("count", group="toys")
def count(settings: Lists, progress):
    """Count it."""
    return CommandResult("", {"lists": [settings.paths, settings.names, settings.levels]})

@command("look", group="toys")
def look(settings: Settings, progress):
    """Look
    at it.

    More.
    """
    if settings.limit < 0:
        raise InputError("command line", "limit", "at least 0", str(settings.limit))
    code = 3 if settings.limit == 3 else None
    return CommandResult(f"looked at {settings.path}", {"limit": settings.limit}, settings.limit < 1, code)

@command("make", group="toys", writes="path")
def make(settings: Settings, progress):
    """Make it."""
    return CommandResult("", {})
'''


@pytest.fixture(scope="module")
def toys(tmp_path_factory):
    """Folder of the module of commands, whose source is read as long as it is imported."""
    folder = tmp_path_factory.mktemp("toys")
    (folder / "toy_command.py").write_text(TOY)
    return folder


@pytest.fixture
def offer(monkeypatch, toys):
    monkeypatch.syspath_prepend(toys)

    def offer(*names, spec="toy_command:look"):
        own = [EntryPoint("list", "headbench.bench.listing:list_installed", "headbench.commands")]
        entries = [*own, *(EntryPoint(name, spec, "headbench.commands") for name in names)]
        monkeypatch.setattr(registry, "entry_points", lambda group: entries)

    return offer


def test_settings_are_options_and_findings_are_printed(offer, capsys):
    offer("look")
    assert cli.main(["look", "here", "--limit", "0.25"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    assert cli.main(["look", "here", "--limit", "0.25", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"limit": 0.25}
    assert [cli.main(["look", "here", "--limit", limit]) for limit in ("2", "-1", "3")] == [1, 2, 3]
    assert "at least 0" in capsys.readouterr().err
    assert cli.main(["look", "--help"]) == 0
    assert "Most that may be wrong." in capsys.readouterr().out


def test_parameters_of_a_command_are_its_options_in_any_order():
    """A required one by name may stand behind one with a default."""

    @specs.command("jot", group="toys")
    def jot(text: str = "a", *, data: str, progress):
        """Note it."""

    assert vars(jot.options(data="x")) == {"text": "a", "data": "x"}


def test_lists_have_commas_or_spaces(offer, capsys):
    offer("count", spec="toy_command:count")
    for words, lists in (
        (["a,b", "c"], [["a,b", "c"], [], [1.0]]),  # a comma in a file's name is one
        (["a", "--names", "x,y", "z", "--levels", "0.5,2"], [["a"], ["x", "y", "z"], [0.5, 2.0]]),
        (["a", "--names", "x,", "y", "--levels=-1,2"], [["a"], ["x", "y"], [-1.0, 2.0]]),
    ):
        assert cli.main(["count", *words, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == {"lists": lists}
    for words in (["--levels"], ["--levels", ","], ["--names", "--levels", "1"]):
        assert cli.main(["count", "a", *words]) == 2
        assert "at least one value" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "named"),
    [("look", "What to look at"), ("look here --limti 1", "--limti"), ("look here --limit much", "--limit")],
)
def test_words_that_do_not_parse_are_named(offer, capsys, words, named):
    offer("look")
    assert cli.main(words.split()) == 2
    printed = capsys.readouterr()
    assert named in printed.err
    assert "look --help" in printed.err
    assert printed.out == ""


def test_two_words_share_the_first(offer, capsys):
    offer("make big", "make small")
    assert cli.main(["make", "small", "here"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    assert cli.main(["make"]) == 2
    assert "one of big, small, found nothing" in capsys.readouterr().err
    for words in (["--help"], ["make", "--help"]):
        assert cli.main(words) == 0
        assert re.search(r"(?m)^Toys\n  make big +Look at it.\n  make small +Look", capsys.readouterr().out)


def test_an_unknown_command_is_answered_with_the_nearest(capsys):
    answers = {
        "train": "run",
        "EVAL": "evaluate",
        "tabel": "table",
        "export-ply": "export ply",
        "export pyl": "export ply",
    }
    for words, answer in answers.items():
        assert cli.main(words.split()) == 2
        assert f"Did you mean `headbench {answer}`" in capsys.readouterr().err
    assert cli.main(["xyzzy"]) == 2
    assert "Did you mean" not in capsys.readouterr().err
    names = set(registry.discover("commands"))
    assert set(cli.COMMAND_ALIASES.values()) <= names
    assert not set(cli.COMMAND_ALIASES) & names


def test_help_lists_commands_in_groups(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    places = [text.index(f"\n  {name} ") for name in ("demo", "run", "table", "export ply")]
    assert places == sorted(places)
    headings = [group.capitalize() for group in specs.COMMAND_GROUPS]
    assert re.findall(r"(?m)^([A-Z]\w+)$", text) == headings


def test_a_word_calls_a_command_alone_and_before_a_second_word(offer, capsys, monkeypatch):
    entries = [
        EntryPoint(name, f"toy_command:{spec}", "headbench.commands")
        for name, spec in (("make", "look"), ("make twice", "count"))
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: entries)
    assert cli.main(["make", "here"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    assert cli.main(["make", "twice", "here", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lists"] == [["here"], [], [1.0]]


BROKEN = {"not_there:look": "not_there", "toy_command:Settings": "a function with @command"}


@pytest.mark.parametrize("function", BROKEN)
def test_a_broken_command_is_listed_and_raises_only_when_called(offer, capsys, function):
    offer("look", "look twice", spec=function)
    assert cli.main(["list", "commands"]) == 0
    assert re.search(r"(?m)^look twice +broken: ", capsys.readouterr().out)
    for words in (["look", "here"], ["look", "twice", "here"]):
        assert cli.main(words) == 2
        assert BROKEN[function] in capsys.readouterr().err


def test_the_command_of_the_page_lists_the_worst_frames(run, offer, capsys, tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "howto" / "command.md").read_text()
    (tmp_path / "worst.py").write_text(re.search("```python\n(.*?)```", page, re.DOTALL)[1])
    monkeypatch.syspath_prepend(tmp_path)
    offer("worst", spec="worst:worst")
    assert cli.main(["worst", str(run), "--count", "2", "--json"]) == 0
    listed = [each["value"] for each in json.loads(capsys.readouterr().out)]
    rows = pq.read_table(run / "rows.parquet").to_pylist()
    assert (
        listed
        == sorted(row["value"] for row in rows if (row["metric"], row["region"]) == ("psnr", "full"))[:2]
    )
    assert cli.main(["worst", "--help"]) == 0
    assert "Number of frames. (default: 5)" in capsys.readouterr().out
    assert cli.main(["worst"]) == 2
    assert "Folder of the run" in capsys.readouterr().err


def test_the_index_has_every_command_of_headbench_as_it_is():
    assert registry.INDEX.read_text() == registry.index_text(), "`make index` writes it"
    for name, plugin in registry.discover("commands").items():
        assert plugin.spec.name == name
        assert plugin.spec.summary.endswith(".")
        assert {*plugin.spec.kinds} <= {*KINDS}, name


def test_a_folder_that_is_written_is_locked(offer, capsys, tmp_path):
    offer("make", spec="toy_command:make")
    with locked(tmp_path):
        assert cli.main(["make", str(tmp_path)]) == 2
    assert "no other process works in" in capsys.readouterr().err
    assert cli.main(["make", str(tmp_path)]) == 0


def test_every_command_with_a_folder_to_write_locks_it():
    """All but those that lock for themselves, since they check first, and those whose --out is a file."""
    own = {"demo", "drive", "evaluate", "prepare nersemble", "run", "synth"}
    own |= {f"run {what}" for what in ("curve", "extremes", "reenact", "sweep")}
    files = {f"export {form}" for form in ("glb", "html", "lam", "ply", "sog")}
    files |= {"doctor bench", "doctor stress", "protocols", "report", "table"}
    for plugin in registry.discover("commands").values():
        spec = plugin.spec
        names = {field.name for field in dataclasses.fields(registry.resolve(spec.settings))}
        assert ("out" in names) == (spec.writes == "out" or spec.name in own | files), spec.name


def test_a_folder_of_another_kind_is_refused_untouched(capsys, tmp_path):
    (tmp_path / "transforms_train.json").write_text("{}")
    commands = (
        ["colmap x", "compact x"],
        ["ga x.ply", "tracking x --head x"],
        ["refit x --target ga", "tongue x"],
    )
    words = [
        f"{first} {rest}" for first, each in zip(("export", "import", "prepare"), commands) for rest in each
    ]
    words += ["inspect x", "render x --capture x", "report pareto x", "demo", "synth", "report x --split"]
    for command in words:
        assert cli.main([*command.split(), "--out", str(tmp_path)]) == 2
        assert "Nothing was written" in capsys.readouterr().err, command
    assert [path.name for path in tmp_path.iterdir()] == ["transforms_train.json"]
    (tmp_path / "transforms_train.json").rename(tmp_path / "subject.npz")  # an avatar may be written again
    assert cli.main(["export", "compact", "x", "--out", str(tmp_path)]) == 2
    assert "Nothing was written" not in capsys.readouterr().err


def test_a_tilde_on_the_command_line_is_the_home_folder(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("HOME", "/h")
    for word, expected in {
        "~/a": "/h/a",
        "--out=~/a=b": "--out=/h/a=b",
        "reader_settings.head=~/a": "reader_settings.head=/h/a",
        "settings.ga.x=~": "settings.ga.x=~",
        "--set=a.b=~/c": "--set=a.b=/h/c",
        "a=b~c": "a=b~c",
    }.items():
        assert cli.with_home(word) == expected
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "run.yaml").write_text("data: ~/cap\nout: ~/run\n")
    assert cli.main(["run", "--config=~/run.yaml"]) == 2
    assert f"{tmp_path}/cap" in capsys.readouterr().err


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
        *(("auto", None, None), ("processes", 3, None), ("slurm", None, "gpu"))
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
