"""Which files are the code of a plug-in: each edit of one of them changes the digest, no other edit does."""

import importlib
import sys

import pytest

from headbench.bench.registry import is_outside
from headbench.bench.source import code_digest, forget_code

FILE = {"plug.py": "class M: pass", "beside.py": "", "further/near.py": "", "notes.txt": ""}
PACKAGE = {"plug/__init__.py": "", "plug/deep/__init__.py": "", "plug/deep/impl.py": "class M: pass"}
PACKAGE |= {"plug/net/layers.py": "", "plug/data/table.csv": "", "plug_tests/test.py": ""}
FOLDER = {"plug/impl.py": "class M: pass", "plug/net.py": "", "other/__init__.py": ""}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write files into a folder on the module path; return the digest of an object as a new process would find it."""
    monkeypatch.syspath_prepend(tmp_path)

    def drop():
        for name in [name for name in sys.modules if name.partition(".")[0] == "plug"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        forget_code()

    def write(files, reference):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        drop()
        return code_digest(reference)

    yield write
    drop()


@pytest.mark.parametrize(
    ("files", "reference", "counted"),
    [
        (FILE, "plug:M", {"plug.py", "beside.py"}),
        (PACKAGE, "plug.deep.impl:M", {name for name in PACKAGE if name.startswith("plug/")} - {"plug/data/table.csv"}),
        (FOLDER, "plug.impl:M", {"plug/impl.py", "plug/net.py"}),
    ],
    ids=["file", "package", "folder"],
)  # fmt: skip
def test_an_edit_counts_in_each_file_of_the_code(write, files, reference, counted):
    known = write(files, reference)
    assert len(known) == 12
    changed = {
        name for name, text in files.items() if write({**files, name: f"{text}\n#"}, reference) != known
    }
    assert changed == counted
    assert write(files, reference) == known


def test_code_of_this_package_is_the_folder_of_the_module():
    ga, config = (code_digest(f"headbench.methods.ga.{name}") for name in ("spec:GA", "config:GAConfig"))
    assert ga == config != code_digest("headbench.methods.gbs.spec:GBS")
    assert [is_outside(f"{name}:X") for name in ("headbench.methods.ga.spec", "toy")] == [False, True]
