"""Settings of official methods are looked at before any work: each fault names the setting and the next step."""

import sys
from dataclasses import replace

import pytest

from headbench.bench.configuration import deciding_settings
from headbench.bench.errors import InputError
from headbench.methods.official.checkout import Repository, inspect_checkout
from headbench.methods.official.config import GAOfficialConfig

NAME = "ga"


def settings(checkout, commit, **changes):
    """Settings that find the stand-in."""
    return GAOfficialConfig(
        **({"checkout": str(checkout), "python": sys.executable, "commit": commit} | changes)
    )


REPOSITORY = Repository("https://example.org/code", "0" * 40, ("train.py", "render.py"), ("json",))


def test_a_checkout_as_it_should_be_is_recorded(repository):
    found = inspect_checkout("ga-official", settings(*repository), REPOSITORY)
    assert found.folder == repository[0].resolve()
    assert found.record["commit"] == repository[1]
    assert found.record["changed"] == []
    assert found.record["python"] == sys.version.split()[0]
    (repository[0] / "train.py").write_text("changed")
    changed = inspect_checkout("ga-official", settings(repository[0], repository[1][:8]), REPOSITORY).record
    assert changed["changed"] == ["train.py"]
    assert len(changed["difference"]) == 64


@pytest.mark.parametrize(
    ("changes", "key", "step"),
    [
        ({"checkout": ""}, "checkout: expected", "git clone"),
        ({"checkout": "nowhere"}, "no such folder", "git clone"),
        ({"checkout": "."}, "none of train.py, render.py", "git clone"),
        ({"commit": "0" * 40}, "expected commit 000000000000, found commit ", "git -C"),
        ({"commit": "main"}, "7 to 40 digits of a commit", ""),
        ({"python": ""}, "python: expected the interpreter", "--set settings.ga-official.python="),
        ({"python": "no-such-python"}, "no-such-python", "--set settings.ga-official.python="),
        ({"python": "'unclosed"}, "python: expected the interpreter", "--set"),
        ({"python": "/bin/false"}, "expected a Python interpreter", ""),
        ({"python": "/bin/echo"}, "expected a Python interpreter", ""),
    ],
)
def test_faults_of_settings_name_the_next_step(repository, tmp_path, monkeypatch, changes, key, step):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as raised:
        inspect_checkout("ga-official", replace(settings(*repository), **changes), REPOSITORY)
    assert key in str(raised.value)
    assert step in str(raised.value)


def test_modules_that_are_missing_are_named(repository):
    lacking = replace(REPOSITORY, modules=("json", "no_such_module"))
    with pytest.raises(InputError, match="no_such_module: ModuleNotFoundError"):
        inspect_checkout("ga-official", settings(*repository), lacking)


def test_a_trial_that_fails_says_what_to_do(repository):
    trying = replace(REPOSITORY, trial="import json; json.loads('{')", trial_remedy="Install another.")
    with pytest.raises(InputError, match=r"JSONDecodeError.*Install another\."):
        inspect_checkout("ga-official", settings(*repository), trying)


def test_a_folder_without_git_needs_an_empty_commit(repository, tmp_path):
    folder = tmp_path / "unpacked"
    folder.mkdir()
    for name in ("train.py", "render.py"):
        (folder / name).write_text("")
    with pytest.raises(InputError, match="not a git checkout"):
        inspect_checkout("ga-official", settings(folder, repository[1]), REPOSITORY)
    assert inspect_checkout("ga-official", settings(folder, ""), REPOSITORY).record["commit"] == ""


def test_a_command_of_several_words_is_an_interpreter(repository):
    found = inspect_checkout("ga-official", settings(*repository, python=f"env {sys.executable}"), REPOSITORY)
    assert found.python[1:] == (sys.executable,)


def test_where_the_checkout_lies_does_not_make_another_avatar():
    one, other = (GAOfficialConfig(checkout=place, python=place) for place in ("a", "b"))
    assert deciding_settings(one) == deciding_settings(other)
    assert deciding_settings(one) != deciding_settings(replace(one, commit="1234567"))
