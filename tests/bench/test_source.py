"""Which files are the code of a plug-in: each edit of one of them changes the digest, no other edit does."""

import importlib
import sys
from importlib.machinery import EXTENSION_SUFFIXES

import pytest

from headbench.bench.source import code_digest, forget_code, is_outside

COMPILED = f"plug/fast{EXTENSION_SUFFIXES[0]}"
FILE = {"plug.py": "import beside, json\nclass M: pass", "beside.py": "from further import near"}
FILE |= {"further/near.py": "", "other.py": "", "further/notes.txt": "", "json.py": ""}
PACKAGE = {"plug/__init__.py": "", "plug/deep/impl.py": "class M: pass", "plug/named_by_text.py": ""}
PACKAGE |= {COMPILED: "", "plug/data/table.csv": "", "plug/not-a-module/x.py": "", "plug_tests/test.py": ""}
FOLDER = {"plug/impl.py": "class M: pass", "plug/net.py": "", "other/__init__.py": ""}
SHARED = {"plug/mine/__init__.py": "class M: pass", "plug/mine/net.py": "", "plug/theirs/__init__.py": ""}
INSTALLED = {"site-packages/plug.py": "import beside\nclass M: pass", "site-packages/beside.py": ""}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write files into a folder on the module path; return the digest of an object as a new process would find it."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "site-packages")

    def drop():
        for name in list(sys.modules):
            if name.partition(".")[0] in ("plug", "beside", "further"):
                del sys.modules[name]

    def write(files, reference):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        drop()
        importlib.invalidate_caches()
        forget_code()
        return code_digest(reference)

    yield write
    drop()
    forget_code()


@pytest.mark.parametrize(
    ("files", "reference", "counted"),
    [
        (FILE, "plug:M", ("plug.py", "beside.py", "further/near.py")),
        (
            PACKAGE,
            "plug.deep.impl:M",
            ("plug/__init__.py", "plug/deep/impl.py", "plug/named_by_text.py", COMPILED),
        ),
        (FOLDER, "plug.impl:M", ("plug/impl.py", "plug/net.py")),
        (SHARED, "plug.mine:M", ("plug/mine/__init__.py", "plug/mine/net.py")),
        (INSTALLED, "plug:M", ("site-packages/plug.py",)),
    ],
    ids=["file", "package", "folder", "namespace", "installed"],
)
def test_an_edit_counts_in_each_file_of_the_code(write, files, reference, counted):
    known = write(files, reference)
    assert len(known) == 12
    changed = {
        name for name, text in files.items() if write({**files, name: f"{text}\n#"}, reference) != known
    }
    assert changed == set(counted)
    assert write(files, reference) == known


def test_a_file_that_cannot_be_parsed_counts_as_well(write):
    """It may be imported where it is not reached, and is a file of the plug-in all the same."""
    files = {"plug.py": "class M: pass\nif False: import beside", "beside.py": "def"}
    assert write(files, "plug:M") != write({**files, "beside.py": "class"}, "plug:M")


def test_code_of_this_package_is_the_folder_of_the_module():
    ga, config = (code_digest(f"headbench.methods.ga.{name}") for name in ("spec:GA", "config:GAConfig"))
    assert ga == config != code_digest("headbench.methods.gbs.spec:GBS")
    assert [is_outside(name) for name in ("headbench.methods.ga.spec:GA", "toy:M", "")] == [
        False,
        True,
        False,
    ]
