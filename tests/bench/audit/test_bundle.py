"""A bundle holds the results of a run and nothing of the machine's folders; what was changed in it is found."""

import io
import json
import zipfile

import pytest

from headbench.bench import cli
from headbench.bench.audit.bundle import INDEX, read_bundle
from headbench.bench.audit.settings import BundleSettings
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError
from headbench.bench.io.documents import read_json


def bundle(run, out, *options):
    return cli.main(["bundle", str(run), "--out", str(out), "--by", "A. Person", *options])


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items() if isinstance(files, dict) else files:
            archive.writestr(name, content)


@pytest.fixture
def packed(run, tmp_path):
    """A bundle with renders."""
    assert bundle(run, tmp_path / "b.zip", "--renders") == 0
    return tmp_path / "b.zip"


def test_bundle_is_a_run_folder_with_listed_digests(run, packed, tmp_path):
    index = read_bundle(packed, tmp_path / "again")
    again, first = RunFolder(tmp_path / "again"), RunFolder(run)
    rows = [folder.read_rows(folder.read_manifest()) for folder in (again, first)]
    assert rows[0]._table.equals(rows[1]._table)
    assert set(index.files) == set(members(packed)) - {INDEX}
    frames = {path.name: path.read_bytes() for path in run.rglob("renders/*/*.png")}
    assert frames == {path.name: path.read_bytes() for path in again.root.rglob("*.png")}
    assert len(frames) == 5


def test_nothing_tells_the_folders_of_the_machine(packed, tmp_path):
    assert not [name for name, content in members(packed).items() if str(tmp_path).encode() in content]


def test_the_same_run_makes_the_same_bytes(run, packed, tmp_path):
    assert bundle(run, tmp_path / "c.zip", "--renders") == 0
    assert packed.read_bytes() == (tmp_path / "c.zip").read_bytes()


def test_a_bundle_verifies_against_the_capture_named(packed, tmp_path, capsys):
    words = ["verify", str(packed), "--trust", "--data", str(tmp_path / "data")]
    assert cli.main([*words, "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["runs"]
    assert (found["files"], found["values"], found["recomputed"]) == (5, 5, ["psnr"])
    assert found["unverified"]["files"] == "not registered here"


def test_without_renders_no_value_is_called_recomputed(run, tmp_path, capsys):
    assert bundle(run, tmp_path / "b.zip") == 0
    assert cli.main(["verify", str(tmp_path / "b.zip")]) == 0
    assert "No value was recomputed" in capsys.readouterr().out


def test_a_real_capture_has_to_be_named(packed, capsys):
    assert cli.main(["verify", str(packed), "--trust"]) == 3
    assert "Name the folder of the capture with --data" in capsys.readouterr().out


def relisted(files):
    """The files with digests that fit: what somebody does who changes a result on purpose."""
    import hashlib

    index = json.loads(files[INDEX])
    index["files"] = {n: hashlib.sha256(c).hexdigest() for n, c in files.items() if n != INDEX}
    return {**files, INDEX: json.dumps(index).encode()}


def with_changed_value(files):
    import pandas as pd

    rows = pd.read_parquet(io.BytesIO(files["rows.parquet"]))
    rows.loc[rows["metric"] == "psnr", "value"] += 1.0
    return relisted({**files, "rows.parquet": rows.to_parquet()})


def test_values_unlike_the_renders_are_found(packed, tmp_path, capsys):
    write(packed, with_changed_value(members(packed)))
    assert cli.main(["verify", str(packed), "--trust", "--data", str(tmp_path / "data")]) == 1
    assert "5 mismatches" in capsys.readouterr().out


def listing(**changes):
    return lambda files: {**files, INDEX: json.dumps({**json.loads(files[INDEX]), **changes}).encode()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda files: {**files, "run.json": files["run.json"] + b" "}, r"run.json, digest: expected"),
        (lambda files: {**files, "more.txt": b""}, r"more.txt: expected the files that bundle.json lists"),
        (lambda files: {n: c for n, c in files.items() if n != "rows.parquet"}, "rows.parquet: .* in the list only"),
        (lambda files: relisted({**files, "../x/seed-0/fit.json": b"{}"}), "expected files of a run"),
        (lambda files: relisted({**files, "a/b/seed-0/avatar.pkl": b""}), "expected files of a run"),
        (lambda files: {n: c for n, c in files.items() if not n.startswith("protocols/")}, "protocols/.* in the list only"),
        (lambda files: {n: c for n, c in files.items() if n != INDEX}, "bundle.json: expected a list of the files"),
        (lambda files: [*files.items(), ("run.json", b"{}")], "each name once"),
        (listing(link="javascript:alert(1)"), "link: expected an address"),
        (listing(by="x" * 200), "by: expected at most 120 printable characters"),
        (listing(files=[]), "files"),
        (listing(format=2), "format"),
        (lambda files: {**files, INDEX: b"{"}, "valid JSON"),
    ],
)  # fmt: skip
def test_a_bundle_that_is_not_as_listed_is_refused(packed, tmp_path, change, words):
    write(packed, change(members(packed)))
    with pytest.raises(InputError, match=words):
        read_bundle(packed, tmp_path / "again")


def test_content_much_larger_than_the_file_is_refused(packed, tmp_path):
    with zipfile.ZipFile(packed, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros.json", bytes(10**8))
    with pytest.raises(InputError, match="at most .* bytes"):
        read_bundle(packed, tmp_path / "again")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        # Within the deflated run.json, past names and sizes.
        (
            lambda data, at: data[: at + 20] + bytes([data[at + 20] ^ 255]) + data[at + 21 :],
            "unreadable content",
        ),
        (lambda data, at: data[: len(data) // 2], "unreadable content"),
    ],
)
def test_damaged_archives_are_refused(packed, tmp_path, change, words):
    with zipfile.ZipFile(packed) as archive:
        info = archive.getinfo("run.json")
    data = packed.read_bytes()
    packed.write_bytes(change(data, info.header_offset + 30 + len(info.filename)))
    with pytest.raises(InputError, match=words):
        read_bundle(packed, tmp_path / "again")


def test_compressions_without_bound_are_refused(packed, tmp_path):
    files = members(packed)
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_LZMA) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    with pytest.raises(InputError, match="stored or deflated"):
        read_bundle(packed, tmp_path / "again")


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04 and nothing more"])
def test_what_is_no_archive_is_refused(tmp_path, content, capsys):
    path = tmp_path / "b.zip"
    path.write_bytes(content)
    assert cli.main(["verify", str(path)]) == 3
    assert "a bundle of `headbench bundle`" in capsys.readouterr().out


def test_unknown_methods_and_damaged_frames_are_refused(run, cell, tmp_path, capsys):
    assert bundle(run, tmp_path / "b.zip", "--methods", "ours") == 2
    frame = next(cell.folder.rglob("*.png"))
    frame.write_bytes(frame.read_bytes() + b"x")
    assert bundle(run, tmp_path / "b.zip", "--renders") == 2
    assert "is not as it was written" in capsys.readouterr().err
    assert not (tmp_path / "b.zip").exists()


def test_only_the_named_methods_are_in_it(run, tmp_path):
    assert bundle(run, tmp_path / "b.zip", "--methods", "toy") == 0
    read_bundle(tmp_path / "b.zip", tmp_path / "again")
    assert [m["name"] for m in read_json(tmp_path / "again" / "run.json")["methods"]] == ["toy"]


@pytest.mark.parametrize("field", ["by", "link", "comment"])
def test_text_that_no_page_can_show_is_refused(field):
    with pytest.raises(InputError, match=field):
        BundleSettings("run", "b.zip", **{"by": "A", field: "line\nbreak"})
