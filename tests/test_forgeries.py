"""What somebody who wants a better place may do to a bundle: it is refused, or visibly not verified."""

import hashlib
import io
import json
import math
import re
import zipfile

import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.audit.bundle import INDEX
from headbench.bench.registry import get, resolve

from .small_run import run_on


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A synthetic capture, which `verify` can make again."""
    folder = tmp_path_factory.mktemp("capture")
    size = {"size": (24, 32), "cameras": 3, "timesteps": 6}
    resolve(get("datasets", "synthetic").implementation)(
        folder, subjects=1, head="procedural", seed=5, **size
    )
    return folder


@pytest.fixture(scope="module")
def honest(capture, tmp_path_factory):
    """The files of an honest bundle with renders: two baselines, which train in no time, with two seeds."""
    folder = tmp_path_factory.mktemp("honest")
    metrics = ("psnr", "ssim", "storage", "fps", "training_time")
    run = run_on(capture, folder / "run", "mean-image", "nearest-camera", metrics=metrics, seeds=(0, 1))
    words = ["bundle", str(run.root), "--out", str(folder / "b.zip"), "--by", "Honest lab", "--renders"]
    assert cli.main(words) == 0
    return read(folder / "b.zip")


def read(path):
    """The files of an archive by name."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write(path, files, **index):
    """Write a bundle whose list has the digests of its files, as a forger would."""
    known = {**json.loads(files[INDEX]), **index}
    known["files"] = {n: hashlib.sha256(c).hexdigest() for n, c in files.items() if n != INDEX}
    known["renders"] = any(name.endswith(".png") for name in files)
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**files, INDEX: json.dumps(known).encode()}.items():
            archive.writestr(name, content)
    return path


def rows(change):
    """A forgery of rows: ``change`` returns the changed table."""

    def forge(files):
        table = pd.read_parquet(io.BytesIO(files["rows.parquet"]))
        return {**files, "rows.parquet": change(table).to_parquet(index=False)}

    return forge


def record(change, name="run.json"):
    """A forgery of JSON files whose name ends with ``name``: ``change`` alters the content."""

    def forge(files):
        changed = {}
        for path, content in files.items():
            if path.endswith(name):
                values = json.loads(content)
                change(values)
                content = json.dumps(values).encode()
            changed[path] = content
        return changed

    return forge


def metric(name, **changes):
    """Another definition of a metric."""
    return record(lambda r: next(m for m in r["metrics"] if m["name"] == name).update(changes))


def method(**changes):
    """Another description of the first method."""
    return record(lambda r: r["methods"][0].update(changes))


def setting(name, value, when=None):
    """Set a column of the rows that ``when`` selects; ``value`` is a function of the old ones, or a constant."""

    def change(table):
        where = table["metric"] == "psnr" if when is None else when(table)
        table.loc[where, name] = value(table.loc[where, name]) if callable(value) else value
        return table

    return rows(change)


def worst(table):
    """The worst frame of each method."""
    own = table[table["metric"] == "psnr"]
    return table.index.isin(own.groupby("method")["value"].idxmin())


def called_missing(table):
    """Bad frames called missing."""
    table.loc[worst(table), ["status", "value", "reason"]] = ["missing", math.nan, "not available"]
    return table


def best_frame(table):
    """The best frame of each method alone."""
    own = table[(table["metric"] == "psnr") & (table["seed"] == 0)]
    return table.loc[own.groupby(["method", "task"])["value"].idxmax()]


def without_renders(files):
    return {name: content for name, content in files.items() if not name.endswith(".png")}


def together(*forgeries):
    def forge(files):
        for each in forgeries:
            files = each(files)
        return files

    return forge


def copied_under_another_name(files):
    """The renders and rows of the first method as those of the second one."""
    table = pd.read_parquet(io.BytesIO(files["rows.parquet"]))
    own = table[table["method"] == "nearest-camera"]
    table = pd.concat([own, own.assign(method="mean-image")])
    theirs = {n.replace("/nearest-camera/", "/mean-image/"): c for n, c in files.items()}
    return {**files, **theirs, "rows.parquet": table.to_parquet(index=False)}


def renamed(name, old="nearest-camera"):
    """A method under another name."""

    def forge(files):
        files = rows(lambda t: t.assign(method=t["method"].replace(old, name)))(files)
        files = record(lambda r: next(m for m in r["methods"] if m["name"] == old).update(name=name))(files)
        return {path.replace(f"/{old}/", f"/{name}/"): content for path, content in files.items()}

    return forge


def copied_seed(files):
    """The renders of seed 0 as those of seed 1."""
    return {**files, **{n.replace("/seed-0/", "/seed-1/"): c for n, c in files.items() if "/seed-0/" in n}}


def of(name):
    return lambda table: table["metric"] == name


def fewer_frames(files):
    """A protocol of one frame under the hash of all."""
    return {
        name: json.dumps({**json.loads(content), "keys": json.loads(content)["keys"][:1]}).encode()
        if name.startswith("protocols/")
        else content
        for name, content in files.items()
    }


CONTRADICTED = {
    "bad frames called missing": (rows(called_missing), "psnr .*expected a value, .* found missing"),
    "values raised": (setting("value", lambda v: v + 1), "psnr .*expected"),
    "lower is better": (
        metric("psnr", higher_is_better=False),
        "psnr, higher_is_better: expected True, found False",
    ),
    "no digits, so that more is tolerated": (
        together(metric("psnr", digits=0), setting("value", lambda v: v + 0.04)),
        "psnr, digits: expected 2, found 0",
    ),
    "another unit": (metric("psnr", unit="bit"), "psnr, unit: expected dB, found bit"),
    "another label": (metric("psnr", label="SSIM"), "psnr, label: expected PSNR, found SSIM"),
    "another kind": (metric("psnr", kind="avatar"), "psnr, kind: expected .*, found avatar"),
    "bound to a machine": (
        metric("psnr", machine_bound=True),
        "psnr, machine_bound: expected False, found True",
    ),
    "a metric that is not asked for": (
        together(
            record(lambda r: r["configuration"].update(metrics=["ssim", "storage"])),
            setting("value", lambda v: v + 1),
        ),
        "psnr .*expected",
    ),
    "a baseline called a method": (method(trivial=False), "mean-image, trivial: expected True, found False"),
    "another program under a known name": (
        method(implementation="m:M"),
        "mean-image, implementation: expected .*, found m:M",
    ),
    "rows of another version": (
        setting("version", "99", lambda t: t["method"] == "mean-image"),
        "version .*99",
    ),
    "the best frame alone": (rows(best_frame), "a row with"),
    "fewer frames under the same hash": (fewer_frames, "protocol"),
}
"""Changes that the renders or the registry contradict, and what is said of them."""


def verify(path, *others, capture=None):
    return cli.main(["verify", str(path), *map(str, others), *(["--data", str(capture)] if capture else [])])


@pytest.mark.parametrize("forgery", CONTRADICTED)
def test_a_contradicted_bundle_does_not_verify(honest, capture, tmp_path, capsys, forgery):
    forge, words = CONTRADICTED[forgery]
    assert verify(write(tmp_path / "b.zip", forge(honest)), capture=capture) in (1, 3)
    assert re.search(words, capsys.readouterr().out)


UNVERIFIED = {
    "storage": (setting("value", 0.001, of("storage")), r"storage(, \w+)* \(a bundle holds no avatars"),
    "speed": (setting("value", 9e9, of("fps")), r"fps(, \w+)* \(a bundle holds no avatars"),
    "time": (
        setting("value", 0.0, of("training_time")),
        r"training_time(, \w+)* \(a bundle holds no avatars",
    ),
    "budget": (
        record(lambda r: r["methods"][0]["budget"].update(iterations=1)),
        "budget.*nothing was trained again",
    ),
    "settings": (
        record(lambda r: r["configuration"].update(preset="paper")),
        "settings,.*nothing was trained again",
    ),
    "processor time": (record(lambda r: r.update(processor_seconds=0.1), "fit.json"), "processor time"),
    "machine": (record(lambda r: r["machine"].update(processor="abacus")), r"machine \(as it was recorded"),
    "a version": (
        together(method(version="0"), setting("version", "0", lambda t: t["method"] == "mean-image")),
        "version 0 of mean-image",
    ),
    "all of it": (
        together(without_renders, setting("value", 99.0)),
        r"Not verified: .*psnr, ssim, storage, fps, training_time \(the bundle has no renders",
    ),
    "a failure": (
        rows(lambda t: t.assign(status=t["status"].where(t["seed"] == 0, "failed"))),
        r"the failure of \w+ mean-image seed 1, the failure of \w+ nearest-camera seed 1, machine \(as",
    ),
}
"""Changes that nothing contradicts, and where the result names them."""


@pytest.mark.parametrize("forgery", UNVERIFIED)
def test_what_cannot_be_verified_is_named(honest, capture, tmp_path, capsys, forgery):
    forge, words = UNVERIFIED[forgery]
    assert verify(write(tmp_path / "b.zip", forge(honest)), capture=capture) == 0
    assert re.search(words, capsys.readouterr().out)


@pytest.mark.parametrize(
    ("forge", "words"),
    [
        (together(renamed("mine"), copied_seed), "b.zip: mine seed 0 equal those of .*b.zip: mine seed 1"),
        (copied_under_another_name, "b.zip: mean-image seed 0 equal those of .*b.zip: nearest-camera seed 0"),
    ],
)
def test_equal_renders_are_pointed_out(honest, capture, tmp_path, capsys, forge, words):
    verify(write(tmp_path / "b.zip", forge(honest)), capture=capture)
    assert re.search(rf"frames of .*{words}", capsys.readouterr().out)


def test_equal_renders_of_two_bundles_are_pointed_out(honest, capture, tmp_path, capsys):
    paths = [write(tmp_path / name, honest, by=name) for name in ("a.zip", "b.zip")]
    assert verify(*paths, capture=capture) == 0
    out = capsys.readouterr().out
    assert re.search(r"frames of .*a.zip: mean-image seed 0 equal those of .*b.zip: mean-image seed 0", out)
