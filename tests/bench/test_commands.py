"""Commands that packages offer: their settings become options, their findings output and exit code."""

import dataclasses
import inspect
import json
import re
from importlib.metadata import EntryPoint

import pytest

from headbench.bench import cli, commands, parsing, registry, specs
from headbench.bench.io.files import KINDS
from headbench.bench.io.lock import locked

TOY = '''
from dataclasses import dataclass
import tyro
from headbench import CommandSpec, CommandResult, InputError

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

def count(settings, progress):
    return CommandResult("", {"lists": [settings.paths, settings.names, settings.levels]})

def look(settings, progress):
    if settings.limit < 0:
        raise InputError("command line", "limit", "at least 0", str(settings.limit))
    code = 3 if settings.limit == 3 else None
    return CommandResult(f"looked at {settings.path}", {"limit": settings.limit}, settings.limit < 1, code)

def spec(settings="toy_command:Settings", function="toy_command:look", **more):
    return CommandSpec("toy", "toys", "Look at it.", settings, function, **more)

LOOK = spec()
COUNT = spec("toy_command:Lists", "toy_command:count")
MAKE = spec(writes="path")
NO_SETTINGS, NO_DATACLASS = spec("toy_command:not_there"), spec("toy_command:look")
NO_FUNCTION = spec(function="toy_command:not_there")
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

    def offer(*names, spec="toy_command:LOOK"):
        own = [EntryPoint("list", "headbench.bench.builtin:LIST", "headbench.commands")]
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
    with pytest.raises(SystemExit):
        cli.main(["look", "--help"])
    assert "Most that may be wrong." in capsys.readouterr().out


def test_lists_have_commas_or_spaces(offer, capsys):
    offer("count", spec="toy_command:COUNT")
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
def test_words_that_do_not_parse_end_in_one_line(offer, capsys, words, named):
    offer("look")
    assert cli.main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("headbench: command line: ")
    assert named in line
    assert line.count("--help") == 1
    assert not re.search("[│─╭|]", line)


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
        for name, spec in (("make", "LOOK"), ("make twice", "COUNT"))
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: entries)
    assert cli.main(["make", "here"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    assert cli.main(["make", "twice", "here", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lists"] == [["here"], [], [1.0]]


BROKEN = {
    "not_there:LOOK": ("not_there", "broken: "),
    "toy_command:CommandResult": ("a CommandSpec", "broken: "),
    "toy_command:NO_SETTINGS": ("not_there", "Look"),
    "toy_command:NO_DATACLASS": ("a dataclass", "Look"),
    "toy_command:NO_FUNCTION": ("not_there", "Look"),
}


@pytest.mark.parametrize("spec", BROKEN)
def test_a_broken_command_is_listed_and_raises_only_when_called(offer, capsys, spec):
    why, listed = BROKEN[spec]
    offer("look", "look twice", spec=spec)
    assert cli.main(["list", "commands"]) == 0
    assert re.search(rf"(?m)^look twice +{listed}", capsys.readouterr().out)
    for words in (["look", "here"], ["look", "twice", "here"]):
        assert cli.main(words) == 2
        assert why in capsys.readouterr().err


def test_every_command_has_its_settings_and_its_function():
    for plugin in registry.discover("commands").values():
        settings = registry.resolve(plugin.spec.settings)
        parameters = [*inspect.signature(registry.resolve(plugin.spec.function)).parameters.values()]
        assert [parameter.name for parameter in parameters] == ["settings", "progress"], plugin.name
        assert parameters[0].annotation in (settings.__name__, settings.__base__.__name__), plugin.name
        assert plugin.spec.name == plugin.name
        assert {*plugin.spec.kinds} <= {*KINDS}, plugin.name


def test_a_folder_that_is_written_is_locked(offer, capsys, tmp_path):
    offer("make", spec="toy_command:MAKE")
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
