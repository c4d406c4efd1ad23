"""What somebody who wants a better place may do to a bundle: it is refused, or visibly not verified."""

import hashlib
import io
import json
import math
import re
import zipfile

import cv2
import numpy as np
import pandas as pd
import pytest

from headbench.bench import cli
from headbench.bench.audit.bundle import INDEX
from headbench.bench.audit.settings import VerifySettings
from headbench.bench.audit.verify import verify_run
from headbench.bench.errors import ExitCode
from headbench.bench.protocol import Protocol
from headbench.datasets.synthetic.plan import EDITION
from headbench.reports.leaderboard import submissions
from headbench.reports.leaderboard.page import build
from headbench.reports.leaderboard.settings import LeaderboardSettings

from .datasets.head.toy import toy_head
from .datasets.tiny_capture import make_plan, write_tiny_capture
from .world import run_on


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture; a synthetic one would take longer than all that is done with it."""
    head = toy_head(16, version="procedural2020")
    return write_tiny_capture(tmp_path_factory.mktemp("capture"), make_plan(head=head)).union


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


def recompressed(files):
    """The same pixels in files of other bytes, for seed 1 of the method "mine"."""
    return {
        name: cv2.imencode(
            ".png", cv2.imdecode(np.frombuffer(c, np.uint8), -1), [cv2.IMWRITE_PNG_COMPRESSION, 0]
        )[1].tobytes()
        if "/seed-1/renders/" in name
        else c
        for name, c in files.items()
    }


def listed_again(files):
    """Records whose digests are those of the renders."""
    changed = dict(files)
    for path, content in files.items():
        if path.endswith("digests.json"):
            state, folder = json.loads(content), path.rpartition("/")[0]
            state["files"] = {n: hashlib.sha256(files[f"{folder}/{n}"]).hexdigest() for n in state["files"]}
            changed[path] = json.dumps(state).encode()
    return changed


def synthetic(**changes):
    """A record that names a synthetic capture, with these settings; None leaves one out."""
    made = {
        "head": "procedural",
        "size": [24, 32],
        "cameras": 3,
        "timesteps": 6,
        "subjects": 1,
        "seed": 5,
        "edition": EDITION,
        **changes,
    }
    settings = {name: value for name, value in made.items() if value is not None}

    def change(values):
        for clip in values["clips"]:
            clip["steps"] = [
                {"name": "synthesize", "parameters": {"synthetic": settings}, "fingerprint": "0"}
            ]

    return record(change)


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


def one_seed(files):
    """Seed 0 alone."""
    files = rows(lambda t: t[t["seed"] == 0])(record(lambda r: r["configuration"].update(seeds=[0]))(files))
    return {name: content for name, content in files.items() if "/seed-1/" not in name}


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
        changes = {"name": name, "trivial": False}
        files = record(lambda r: next(m for m in r["methods"] if m["name"] == old).update(changes))(files)
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
    "another unit": (
        together(without_renders, metric("psnr", unit="bit")),
        "psnr, unit: expected dB, found bit",
    ),
    "another label": (
        together(without_renders, metric("psnr", label="SSIM")),
        "psnr, label: expected PSNR, found SSIM",
    ),
    "another kind": (
        together(without_renders, metric("psnr", kind="avatar")),
        "psnr, kind: expected .*, found avatar",
    ),
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
    "a baseline called a method": (
        together(without_renders, method(trivial=False)),
        "mean-image, trivial: expected True, found False",
    ),
    "another program under a known name": (
        together(without_renders, method(implementation="m:M")),
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


ALIKE = {
    "a copied seed": (together(renamed("mine"), copied_seed), ("mine seed 0", "mine seed 1")),
    "a copied seed, compressed again": (
        together(renamed("mine"), copied_seed, recompressed, listed_again),
        ("mine seed 0", "mine seed 1"),
    ),
    "copied under another name": (copied_under_another_name, ("mean-image seed 0", "nearest-camera seed 0")),
}
"""Copies of renders, and what is said to be equal."""


SEEDED = {"a failure", *ALIKE}
"""Forgeries that take two seeds."""


@pytest.fixture(scope="module")
def verdicts(honest, capture, tmp_path_factory):
    """What `verify` says of all forged bundles at once: the text of each and the lines on equal renders."""
    folder = tmp_path_factory.mktemp("verdicts")
    single = one_seed(honest)
    forged = {name: forge for name, (forge, _) in {**CONTRADICTED, **UNVERIFIED, **ALIKE}.items()}
    paths = {
        name: write(folder / f"{index}.zip", forge(honest if name in SEEDED else single))
        for index, (name, forge) in enumerate(forged.items())
    }
    options = VerifySettings(tuple(map(str, paths.values())), data=str(capture))
    result = verify_run(options)
    texts = dict(
        zip(forged, re.split(r"^(?=\S*/\d+\.zip: )", result.text, flags=re.MULTILINE)[1:], strict=False)
    )
    return texts, dict(zip(forged, result.data["runs"], strict=True)), result.data["equal_renders"], paths


@pytest.mark.parametrize("forgery", CONTRADICTED)
def test_a_contradicted_bundle_does_not_verify(verdicts, forgery):
    texts, runs, _, _ = verdicts
    assert "error" in runs[forgery] or runs[forgery]["mismatches"]
    assert re.search(CONTRADICTED[forgery][1], texts[forgery])


@pytest.mark.parametrize("forgery", UNVERIFIED)
def test_what_cannot_be_verified_is_named(verdicts, forgery):
    texts, runs, _, _ = verdicts
    assert runs[forgery]["mismatches"] == []
    assert re.search(UNVERIFIED[forgery][1], texts[forgery])


@pytest.mark.parametrize("forgery", ALIKE)
def test_equal_renders_are_pointed_out(verdicts, forgery):
    _, _, equal, paths = verdicts
    names = [f"{paths[forgery]}: {name}" for name in ALIKE[forgery][1]]
    assert any(all(name in text for name in names) for text in equal)


def test_equal_renders_of_two_bundles_are_pointed_out(verdicts):
    _, _, equal, paths = verdicts
    names = [f"{paths[name]}: mean-image seed 0" for name in ("storage", "speed")]
    assert any(all(name in text for name in names) for text in equal)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"size": None, "timesteps": 10**9}, "at most .* pixels in all"),
        ({"timesteps": 10**9}, "at most .* pixels in all"),
        ({"seed": -1}, "--seed: expected a whole number from 0"),
        ({"samples_per_pixel": 10**9}, "--samples: expected"),
        ({"head": "procedural/../../x"}, "--head"),
        ({"edition": None}, f"edition: expected {EDITION}, .* found 1"),
    ],
)
def test_a_capture_is_made_again_within_limits(honest, tmp_path, changes, expected):
    path = write(tmp_path / "b.zip", synthetic(**changes)(honest))
    result = verify_run(VerifySettings((str(path),)))
    assert result.code == ExitCode.NO_VERDICT
    assert re.search(expected, result.text)


def test_an_unexpected_error_of_one_bundle_is_its_own(honest, make_board, monkeypatch):
    own = submissions.verify

    def verify(folder, bundle, *others):
        return 1 / 0 if bundle.by == "Stranger" else own(folder, bundle, *others)

    monkeypatch.setattr(submissions, "verify", verify)
    _, bundles, _ = make_board(x=OURS(honest))
    assert [bundles[f"{name}.zip"]["state"] for name in ("lab", "x")] == ["verified", "claimed"]
    assert "Not verified: ZeroDivisionError" in bundles["x.zip"]["remarks"][0]


def only(name):
    """One method of a bundle alone."""

    def forge(files):
        files = record(lambda r: r.update(methods=[m for m in r["methods"] if m["name"] == name]))(files)
        files = record(lambda r: r["configuration"].update(methods=[name]))(files)
        files = rows(lambda t: t[t["method"] == name])(files)
        return {path: c for path, c in files.items() if path.count("/") < 2 or f"/{name}/" in path}

    return forge


def another_seed(table):
    return table[table["seed"] == 0].assign(seed=7, value=1.0)


def a_frame_more(table):
    """A frame that no other bundle has, so that theirs look incomplete."""
    return pd.concat([table, table[table["task"] != ""].iloc[:1].assign(timestep=999)])


def a_subject_more(table):
    return pd.concat([table, table[table["task"] == ""].iloc[:1].assign(subject="nobody")])


OURS = together(only("nearest-camera"), renamed("mine"))
SEED_7 = together(without_renders, rows(another_seed), record(lambda r: r["configuration"].update(seeds=[7])))
NOT_RANKED = {
    "values of 99 dB": (together(without_renders, setting("value", 99.0)), "Claimed, not verified"),
    "another seed of a method": (SEED_7, "Claimed, not verified"),
    "a name like that of a variant": (together(SEED_7, renamed("mine (a)", "mine")), "Claimed, not verified"),
    "the best frame alone": (together(without_renders, rows(best_frame)), "Incomplete"),
    "another direction": (together(metric("psnr", higher_is_better=False), without_renders), "Contradicted"),
    "values raised": (setting("value", lambda v: v + 1), "Contradicted"),
}
"""Changes to the only method of a second bundle, and the group of the table that shows it."""
REFUSED = {
    "fewer frames under the same hash": (together(without_renders, fewer_frames), "protocols"),
    "a frame more": (
        together(without_renders, rows(a_frame_more)),
        "frames of .*: expected those of its protocol",
    ),
    "a subject more": (together(without_renders, rows(a_subject_more)), "subject: expected those of the run"),
    "values whose sum is infinite": (
        together(without_renders, setting("value", 1e308)),
        "a finite value of at most",
    ),
    "a seed more": (together(without_renders, rows(another_seed)), "seed: expected those of the run"),
}
"""Changes that keep a second bundle out of every table, and the reason."""


@pytest.fixture(scope="module")
def make_board(honest, capture, tmp_path_factory):
    """A function that makes a page of the honest bundle and others by name; it returns tables, bundles by file and page."""

    def make(words=(), **others):
        folder = tmp_path_factory.mktemp("board")
        (folder / "bundles").mkdir()
        write(folder / "bundles" / "lab.zip", OURS(honest))
        for name, files in others.items():
            write(folder / "bundles" / f"{name}.zip", files, by="Stranger")
        (folder / "page").mkdir()
        settings = LeaderboardSettings(
            str(folder / "bundles"), str(folder / "page"), data=str(capture), recompute=tuple(words)
        )
        found = build(settings).data
        page = (folder / "page" / "leaderboard.md").read_text()
        return found["tables"], {each["file"]: each for each in found["bundles"]}, page

    return make


@pytest.fixture(scope="module")
def alone(make_board):
    """The table of the honest bundle on a page of its own."""
    ((table,), _, _) = make_board()
    return table


@pytest.fixture(scope="module")
def board(honest, make_board):
    """A page of the honest bundle and all forgeries."""
    forged = {name: forge(OURS(honest)) for name, (forge, _) in {**NOT_RANKED, **REFUSED}.items()}
    return make_board(**forged)


def cells(table, label):
    """The group of a method in a table, and its cells by metric in the first task."""
    for title, members in table["groups"]:
        for row in members:
            if row["method"] == label:
                columns = [column["metric"] for column in table["columns"]]
                return title, dict(reversed(list(zip(columns, row["cells"], strict=True))))
    raise AssertionError(f"no row {label}")


HONEST = "mine [Honest lab/lab]"


@pytest.mark.parametrize("forgery", NOT_RANKED)
def test_a_forged_bundle_is_not_ranked(board, forgery):
    (table,), _, _ = board
    name = "mine (a)" if "name" in forgery else "mine"
    title, forged = cells(table, f"{name} [Stranger/{forgery}]")
    assert title.startswith(NOT_RANKED[forgery][1])
    assert all(cell["rank"] is None for cell in forged.values())


def test_forged_bundles_change_no_other_row(board, alone):
    (table,), _, _ = board
    (title, found), (_, expected) = cells(table, HONEST), cells(alone, HONEST)
    assert title == "Verified from renders"
    assert found["psnr"]["status"] == "ok"
    assert [cell["text"] for cell in found.values()] == [cell["text"] for cell in expected.values()]


@pytest.mark.parametrize("forgery", REFUSED)
def test_a_bundle_that_would_change_other_rows_is_refused(board, forgery):
    (table,), bundles, page = board
    assert f"{forgery}.zip" not in bundles
    assert re.search(rf"In no table\n(.|\n)*{forgery}.zip: .*{REFUSED[forgery][1]}", page)
    assert not [row for _, members in table["groups"] for row in members if forgery in row["method"]]


def test_suspect_values_are_found_without_their_mark(board):
    (table,), _, _ = board
    _, forged = cells(table, "mine [Stranger/values of 99 dB]")
    assert "are above 50" in table["notes"][forged["psnr"]["note"]]


def test_unverified_values_of_a_verified_bundle_are_not_ranked(honest, make_board):
    (table,), bundles, page = make_board(small=setting("value", 1e-9, of("storage"))(OURS(honest)))
    for label in (HONEST, "mine [Stranger/small]"):
        title, own = cells(table, label)
        assert title == "Verified from renders"
        found = {name: (cell["status"], cell["rank"]) for name, cell in own.items()}
        assert found == {
            "psnr": ("ok", 1),
            "ssim": ("ok", 1),
            "storage": ("claimed", None),
            "fps": ("claimed", None),
        }
    assert "frames are equal in lab.zip: mine seed 0, lab.zip: mine seed 1, small.zip: mine seed 0" in page
    for name in ("storage", "fps", "processor time", "budget", "settings", "versions"):
        assert all(name in " ".join(bundle["remarks"]) for bundle in bundles.values())


def test_a_training_is_repeated_and_compared(honest, make_board):
    baseline = together(only("nearest-camera"), one_seed, without_renders)(honest)
    others = {
        "same": baseline,
        "raised": setting("value", 24.0)(baseline),
        "slower": setting("value", 9e9, of("fps"))(baseline),
        "nearly": setting("value", lambda v: v + 0.2)(baseline),
    }
    (table,), bundles, _ = make_board(words=[f"{name}.zip" for name in others], **others)
    states = {name: bundles[f"{name}.zip"]["state"] for name in others}
    assert states == {
        "same": "recomputed",
        "raised": "contradicted",
        "slower": "recomputed",
        "nearly": "recomputed",
    }
    same, forged = (cells(table, f"nearest-camera [Stranger/{name}]")[1] for name in ("same", "nearly"))
    assert forged["psnr"]["text"] == same["psnr"]["text"]  # what was trained here, not what is claimed
    remarks = {name: " ".join(bundles[f"{name}.zip"]["remarks"]) for name in others}
    assert "psnr: a single value differs by at most 0, a mean by 0 (tolerance 0.25)" in remarks["same"]
    assert "which is more" in remarks["raised"]
    assert "fps" in remarks["slower"].partition("Not verified")[2]


def of_another_capture(files):
    """Protocols and rows that name another capture, with hashes to match."""
    forged, hashes = {}, {}
    for name, content in files.items():
        if name.startswith("protocols/"):
            values = json.loads(content)
            values["clips"] = [(subject, "0" * 32) for subject, _ in values["clips"]]
            own = {key: value for key, value in values.items() if key not in ("id", "hash")}
            own = {k: tuple(v) if isinstance(v, list) else v for k, v in own.items()}
            hashes[values["hash"]] = values["hash"] = Protocol(**own).hash
            name, content = f"protocols/{values['hash']}.json", json.dumps(values).encode()
        forged[name] = content
    change = record(lambda r: r.update(protocols={t: hashes[h] for t, h in r["protocols"].items()}))
    return rows(lambda t: t.assign(protocol=t["protocol"].replace(hashes)))(change(forged))


def test_a_training_that_differs_supports_nothing(honest, make_board):
    baseline = together(only("nearest-camera"), one_seed, without_renders)(honest)
    forged = {
        "protocol of": of_another_capture(baseline),
        "nearest-camera.budget": record(lambda r: r["methods"][0]["budget"].update(iterations=1_000_000))(
            baseline
        ),
    }
    files = {f"f{index}": files for index, files in enumerate(forged.values())}
    _, bundles, _ = make_board(words=[f"{name}.zip" for name in files], **files)
    for name, said in zip(files, forged, strict=True):
        assert bundles[f"{name}.zip"]["state"] == "claimed"
        assert re.search(f"Not trained again: .*{said}", " ".join(bundles[f"{name}.zip"]["remarks"]))


def without_metric(name):
    """A run that did not ask for a metric."""

    def change(values):
        values["metrics"] = [each for each in values["metrics"] if each["name"] != name]
        asked = values["configuration"]["metrics"]
        values["configuration"]["metrics"] = [each for each in asked if each != name]

    return together(record(change), rows(lambda t: t[t["metric"] != name]))


def test_a_bundle_without_the_metric_that_marks_suspects(honest, make_board):
    (table,), bundles, _ = make_board(x=without_metric("psnr")(OURS(honest)))
    title, forged = cells(table, "mine [Stranger/x]")
    assert title.startswith("Incomplete")
    assert all(cell["rank"] is None for cell in forged.values())
    assert "psnr: expected values" in bundles["x.zip"]["remarks"][0]


STRANGER = record(lambda r: r["configuration"].update(methods=["stranger:METHOD"]))
PROGRAM = together(
    renamed("ga-official"),
    record(lambda r: r["configuration"].update(methods=["ga-official"])),
    record(
        lambda r: r["configuration"].update(
            settings={"ga-official": {"checkout": "/", "python": "/bin/true"}}
        )
    ),
)


@pytest.mark.parametrize(
    ("forge", "words"),
    [
        (STRANGER, "'stranger:METHOD'.*--trust"),
        (PROGRAM, "methods that run no program which the bundle names"),
    ],
)
def test_a_bundle_has_nothing_imported_or_run(honest, make_board, tmp_path, monkeypatch, forge, words):
    (tmp_path / "stranger.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    files = together(only("nearest-camera"), forge)(honest)
    _, bundles, _ = make_board(words=["s.zip"], s=files)
    assert re.search(f"Not trained again: .*{words}", " ".join(bundles["s.zip"]["remarks"]))
    assert bundles["s.zip"]["state"] != "recomputed"
