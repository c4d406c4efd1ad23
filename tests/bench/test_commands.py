"""Commands that packages offer: their settings become options, their findings output and exit code."""

import dataclasses
import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from headbench.bench import cli, commands, parsing, registry, specs
from headbench.bench.io.files import KINDS
from headbench.bench.io.lock import locked

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
    assert set(commands.COMMAND_ALIASES.values()) <= names
    assert not set(commands.COMMAND_ALIASES) & names


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
    files = {f"export {form}" for form in ("glb", "html", "ply", "sog")}
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
        assert parsing.with_home(word) == expected
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "run.yaml").write_text("data: ~/cap\nout: ~/run\n")
    assert cli.main(["run", "--config=~/run.yaml"]) == 2
    assert f"{tmp_path}/cap" in capsys.readouterr().err
