"""Commands that packages offer: their settings become options, their findings output and exit code."""

import dataclasses
import importlib.metadata
import inspect
import json
import re
import subprocess
from importlib.metadata import EntryPoint
from typing import get_type_hints

import pytest

from headbench.bench import cli, commands, parsing, registry, specs
from headbench.bench.engine.config import AvatarFolder
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


@pytest.mark.parametrize(
    ("words", "lists"),
    [
        (["a,b", "c"], [["a,b", "c"], [], [1.0]]),  # a comma in a file's name is one
        (["a", "--names", "x,y", "z", "--levels", "0.5,2"], [["a"], ["x", "y", "z"], [0.5, 2.0]]),
        (["a", "--names", "x,", "y", "--levels=-1,2"], [["a"], ["x", "y"], [-1.0, 2.0]]),
    ],
)
def test_lists_have_commas_or_spaces(offer, capsys, words, lists):
    offer("count", spec="toy_command:COUNT")
    assert cli.main(["count", *words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"lists": lists}


@pytest.mark.parametrize("words", [["--levels"], ["--levels", ","], ["--names", "--levels", "1"]])
def test_a_list_without_values_is_refused(offer, capsys, words):
    offer("count", spec="toy_command:COUNT")
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


@pytest.mark.parametrize(("words", "hint"), [("run --device cuda", True), ("doctor --devic cuda", False)])
def test_settings_without_an_option_are_explained(capsys, words, hint):
    assert cli.main(words.split()) == 2
    assert ("with --set" in capsys.readouterr().err) is hint


def test_commands_that_take_an_avatar_describe_it_alike():
    settings = {n: registry.resolve(p.spec.settings) for n, p in registry.discover("commands").items()}
    found = {
        name: get_type_hints(own, include_extras=True)["avatar"]
        for name, own in settings.items()
        if get_type_hints(own).get("avatar") is str
    }
    assert {"export compact", "export html", "export ply", "render", "submission render"} <= found.keys()
    assert set(found.values()) == {AvatarFolder}


def test_findings_decide_the_exit_code(offer, capsys):
    offer("look")
    assert [cli.main(["look", "here", "--limit", limit]) for limit in ("2", "-1", "3")] == [1, 2, 3]
    assert "at least 0" in capsys.readouterr().err


def test_two_words_share_the_first(offer, capsys):
    offer("make big", "make small")
    assert cli.main(["make", "small", "here"]) == 0
    assert capsys.readouterr().out == "looked at here\n"
    assert cli.main(["make"]) == 2
    assert "one of big, small, found nothing" in capsys.readouterr().err
    for words in (["--help"], ["make", "--help"]):
        assert cli.main(words) == 0
        assert re.search(r"(?m)^Toys\n  make big +Look at it.\n  make small +Look", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("train", "`headbench run`"),
        ("fit", "`headbench run`"),
        ("diagnose", "`headbench doctor`"),
        ("benchmark", "`headbench run`"),
        ("eval", "`headbench evaluate`"),
        ("EVAL", "`headbench evaluate`"),
        ("viewer", "`headbench view`"),
        ("tabel", "`headbench table`"),
        ("export-ply", "`headbench export ply`"),
        ("export pyl", "`headbench export ply`"),
        ("xyzzy", "`headbench --help` lists them"),
    ],
)
def test_an_unknown_command_is_answered_with_the_nearest(capsys, words, answer):
    assert cli.main(words.split()) == 2
    error = capsys.readouterr().err
    assert answer in error
    assert ("Did you mean" in error) == (words != "xyzzy")


def test_words_of_other_toolkits_lead_to_commands_that_exist():
    names = set(registry.discover("commands"))
    assert set(commands.COMMAND_ALIASES.values()) <= names
    assert not set(commands.COMMAND_ALIASES) & names


def test_help_lists_commands_in_groups(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert (
        text.index("\n  demo ")
        < text.index("\n  run ")
        < text.index("\n  table ")
        < text.index("\n  export ply ")
    )
    headings = [group.capitalize() for group in specs.COMMAND_GROUPS]
    assert re.findall(r"(?m)^([A-Z]\w+)$", text) == headings
    assert "--version" in text


def test_version_is_that_of_the_package(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"headbench {importlib.metadata.version('headbench')}\n"


def test_bash_completes_commands_their_second_words_and_options(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--tyro-print-completion", "bash"])
    script = capsys.readouterr().out
    for typed, offered in (
        ("ex", "export"),
        ("export p", "ply"),
        ("run --da", "--data"),
        ("run swe", "sweep"),
    ):
        ask = f"COMP_WORDS=(headbench {typed}); COMP_CWORD={len(typed.split())}; _tyro_headbench; echo ${{COMPREPLY[*]}}"
        lines = f"{script}\n{ask}\n"
        answer = subprocess.run(["bash"], check=True, input=lines, capture_output=True, text=True)
        assert answer.stdout.strip() == offered, answer.stderr


def test_help_shows_the_settings_text(offer, capsys):
    offer("look")
    with pytest.raises(SystemExit):
        cli.main(["look", "--help"])
    assert "Most that may be wrong." in capsys.readouterr().out


def test_a_word_calls_a_command_alone_and_before_a_second_word(offer, capsys):
    offer("make")
    monkeyed = registry.entry_points(group="headbench.commands")
    offer("make twice", spec="toy_command:COUNT")
    both = [*monkeyed, *registry.entry_points(group="headbench.commands")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "entry_points", lambda group: both)
        assert cli.main(["make", "here"]) == 0
        assert capsys.readouterr().out == "looked at here\n"
        assert cli.main(["make", "twice", "here", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["lists"] == [["here"], [], [1.0]]
        with pytest.raises(SystemExit):
            cli.main(["make", "--help"])
        assert "`headbench make twice`" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("spec", "why", "listed"),
    [
        ("not_there:LOOK", "not_there", "broken: "),
        ("toy_command:not_there", "not_there", "broken: "),
        ("toy_command:CommandResult", "a CommandSpec", "broken: "),
        ("toy_command:NO_SETTINGS", "not_there", "Look"),
        ("toy_command:NO_DATACLASS", "a dataclass", "Look"),
        ("toy_command:NO_FUNCTION", "not_there", "Look"),
    ],
)
@pytest.mark.parametrize("name", ["look", "look twice"])
def test_a_broken_command_is_listed_and_raises_only_when_called(offer, capsys, spec, why, listed, name):
    offer(name, spec=spec)
    assert cli.main(["list", "commands"]) == 0
    assert re.search(rf"(?m)^{name} +{listed}", capsys.readouterr().out)
    assert cli.main([*name.split(), "here"]) == 2
    assert why in capsys.readouterr().err


def test_every_command_has_its_settings_and_its_function():
    for plugin in registry.discover("commands").values():
        settings = registry.resolve(plugin.spec.settings)
        parameters = [*inspect.signature(registry.resolve(plugin.spec.function)).parameters.values()]
        assert [parameter.name for parameter in parameters] == ["settings", "progress"], plugin.name
        assert parameters[0].annotation in (settings.__name__, settings.__base__.__name__), plugin.name
        assert plugin.spec.name == plugin.name


def test_a_folder_that_is_written_is_locked(offer, capsys, tmp_path):
    offer("make", spec="toy_command:MAKE")
    with locked(tmp_path):
        assert cli.main(["make", str(tmp_path)]) == 2
    assert "no other process works in" in capsys.readouterr().err
    assert cli.main(["make", str(tmp_path)]) == 0


def test_every_command_with_a_folder_to_write_locks_it():
    """All but those that lock for themselves: they check first, or lock what they find to be written."""
    own = {"demo", "drive", "evaluate", "prepare nersemble", "run", "synth"}
    own |= {f"run {what}" for what in ("curve", "extremes", "reenact", "sweep")}
    files = {
        "doctor bench",
        "export glb",
        "export html",
        "export ply",
        "export sog",
        "protocols",
        "report",
        "doctor stress",
        "table",
    }  # --out is one
    for plugin in registry.discover("commands").values():
        spec = plugin.spec
        names = {field.name for field in dataclasses.fields(registry.resolve(spec.settings))}
        assert ("out" in names) == (spec.writes == "out" or spec.name in own | files), spec.name


@pytest.mark.parametrize(
    "mark", ["run.json", "transforms_train.json", "subject.npz", "sparse/x", "900_A/transforms.json"]
)
def test_a_folder_of_another_kind_is_refused_untouched(capsys, tmp_path, mark):
    (tmp_path / mark).parent.mkdir(exist_ok=True)
    (tmp_path / mark).write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    commands = [
        "export colmap x",
        "import ga x.ply",
        "import tracking x --head x",
        "inspect x",
        "prepare refit x --target ga",
        "render x --capture x",
    ]
    commands += [
        "export compact x",
        "report pareto x",
        "prepare tongue x",
        "demo",
        "synth",
        "report x --split",
    ]
    continued = {"run.json": {"demo"}, "subject.npz": {"import ga x.ply", "export compact x"}}
    continued |= {
        "sparse/x": {"export colmap x"},
        "900_A/transforms.json": {"synth", "prepare refit x --target ga", "import tracking x --head x"},
    }
    for command in commands:
        if command not in continued.get(mark, ()):
            assert cli.main([*command.split(), "--out", str(tmp_path)]) == 2
            assert "Nothing was written" in capsys.readouterr().err, command
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("~/a", "/h/a"),
        ("--out=~/a=b", "--out=/h/a=b"),
        ("--out=~", "--out=/h"),
        ("reader_settings.head=~/a", "reader_settings.head=/h/a"),
        ("settings.ga.x=~", "settings.ga.x=~"),
        ("--set=a.b=~/c", "--set=a.b=/h/c"),
        ("a=b~c", "a=b~c"),
    ],
)
def test_a_tilde_on_the_command_line_is_the_home_folder(monkeypatch, word, expected):
    monkeypatch.setenv("HOME", "/h")
    assert parsing.with_home(word) == expected


def test_a_tilde_in_a_configuration_is_the_home_folder(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "run.yaml").write_text("data: ~/cap\nout: ~/run\n")
    assert cli.main(["run", "--config=~/run.yaml"]) == 2
    assert f"{tmp_path}/cap" in capsys.readouterr().err


def test_kinds_of_folders_that_commands_write_are_known():
    for plugin in registry.discover("commands").values():
        assert {*plugin.spec.kinds} <= {*KINDS}, plugin.spec.name
