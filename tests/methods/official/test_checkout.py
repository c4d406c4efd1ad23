"""Settings of official methods are looked at before any work: each fault names the setting and the next step."""

import sys
from dataclasses import replace

import pytest

from headbench.bench.configuration import deciding_settings
from headbench.bench.errors import InputError
from headbench.methods.official.checkout import Repository, inspect_checkout
from headbench.methods.official.spec import GAOfficialConfig

NAME = "ga"


def settings(checkout, commit, **changes):
    """Settings that find the stand-in."""
    return GAOfficialConfig(
        **({"checkout": str(checkout), "python": sys.executable, "commit": commit} | changes)
    )


REPOSITORY = Repository("https://example.org/code", "0" * 40, ("train.py", "render.py"), ("json",))


def test_a_checkout_as_it_should_be_is_recorded(repository):
    python = f"env {sys.executable}"
    found = inspect_checkout("ga-official", settings(*repository, python=python), REPOSITORY)
    assert found.python[1:] == (sys.executable,)
    assert found.folder == repository[0].resolve()
    assert found.record["commit"] == repository[1]
    assert found.record["changed"] == []
    assert found.record["python"] == sys.version.split()[0]
    (repository[0] / "train.py").write_text("changed")
    changed = inspect_checkout("ga-official", settings(repository[0], repository[1][:8]), REPOSITORY).record
    assert changed["changed"] == ["train.py"]
    assert len(changed["difference"]) == 64


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("checkout", folder) for folder in ("", "nowhere", ".")),
        *(("commit", commit) for commit in ("0" * 40, "main")),
        *(("python", name) for name in ("", "no-such-python", "'unclosed", "/bin/false", "/bin/echo")),
    ],
)
def test_faults_of_settings_are_named(repository, tmp_path, monkeypatch, key, value):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=key):
        inspect_checkout("ga-official", replace(settings(*repository), **{key: value}), REPOSITORY)


def test_modules_that_are_missing_are_named(repository):
    lacking = replace(REPOSITORY, modules=("json", "no_such_module"))
    with pytest.raises(InputError, match="no_such_module: ModuleNotFoundError"):
        inspect_checkout("ga-official", settings(*repository), lacking)


def test_a_folder_without_git_needs_an_empty_commit(repository, tmp_path):
    folder = tmp_path / "unpacked"
    folder.mkdir()
    for name in ("train.py", "render.py"):
        (folder / name).write_text("")
    with pytest.raises(InputError, match="not a git checkout"):
        inspect_checkout("ga-official", settings(folder, repository[1]), REPOSITORY)
    assert inspect_checkout("ga-official", settings(folder, ""), REPOSITORY).record["commit"] == ""


def test_where_the_checkout_lies_does_not_make_another_avatar():
    one, other = (GAOfficialConfig(checkout=place, python=place) for place in ("a", "b"))
    assert deciding_settings(one) == deciding_settings(other)
    assert deciding_settings(one) != deciding_settings(replace(one, commit="1234567"))
