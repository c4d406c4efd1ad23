import base64
import json
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pandas as pd
import pytest

from headbench.bench.contracts import FrameKey
from headbench.bench.engine.captures import open_run_clips
from headbench.bench.engine.config import RunOptions
from headbench.bench.engine.store import FinishedRun, RunFolder
from headbench.bench.errors import InputError
from headbench.bench.rows import ALL, Rows
from headbench.reports.page import frames, sections
from headbench.reports.page.frames import Pictures, ShownFrame, choose_pictures, frame_values, opening, spread
from headbench.reports.page.report import PageSettings, write_page, write_report
from headbench.reports.page.sections import loss_curves, verdict
from headbench.reports.runs import RunData, RunSet
from headbench.reports.statistics.command import compare_methods
from headbench.reports.table_report import layouts, table_text


@pytest.fixture
def said(write_run):
    """The verdict of a run of some subjects; values of methods are shifted in each subject by a number."""

    def said(methods, shifts=(0.0,) * 4):
        run = RunData.read(write_run("run", methods))
        rows = run.rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
        one = rows[rows["subject"] == "a"]
        parts = []
        for number, shift in enumerate(shifts):
            wobble = one["method"].map({name: i * shift for i, name in enumerate(methods)})
            parts.append(Rows(one.assign(subject=f"s{number}", value=one["value"] + wobble)))
        Rows.joined(parts).write(run.folder.rows)
        runs = RunSet.read([run.folder.root])
        metrics = [spec for spec in runs.metrics if spec.per_frame]
        comparisons = compare_methods(runs).data["comparisons"] if len(runs.ranked) > 1 else []
        found = verdict(runs, metrics, comparisons)
        return found, re.sub(r"<.*?>", "", " ".join(found.sentences)).replace("\u00a0", " ")

    return said


def test_few_subjects_have_a_lead_and_no_significant_difference(said):
    found, text = said({"good": 30.0, "better": 31.25, "mean-image": 12.0})
    assert found.title == "good and better on 4 subjects"
    assert "better has the best PSNR in novel view, 31.2500, 1.2500 ahead of good" in text
    assert found.limit == "4 subjects cannot show which method is better: a test of 1 pair needs 6."
    assert "significant" not in text
    assert "mean-image" not in text
    assert "good is the smallest, 8.0000 (better 8.1250). better is the fastest, 131.2500" in text


@pytest.mark.parametrize(
    ("shifts", "outcome"),
    [
        ((0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.2, 0.1), ", significant"),
        ((1.0, -1.0, 1.2, -1.1, 1.3, -0.9, 1.1, -1.2), ", not significant"),
    ],
)
def test_enough_subjects_have_an_interval_and_a_test(said, shifts, outcome):
    found, text = said({"good": 30.0, "better": 30.05}, shifts)
    assert re.search(rf"ahead of good \(95 % interval [+−][0-9.]+ to \+[0-9.]+{outcome}\)", text)
    assert "Exact sign-flip test over 8 subjects" in found.limit


def test_names_are_escaped_and_one_method_is_compared_with_none(said):
    found, _ = said({"<i>": 30.0})
    assert found.title == "<i> on 4 subjects"
    assert found.sentences[0] == "<b>&lt;i&gt;</b> has the best PSNR in novel view, 30.0000."
    assert found.limit == ""


def frames_of(run):
    runs = RunSet.read([run])
    return runs, [ShownFrame(runs.tasks[0], key) for key in sorted(runs.keys[runs.tasks[0]])]


def test_it_opens_where_the_best_methods_differ_most(make_run):
    runs, frames = frames_of(make_run("run"))
    metrics = [spec for spec in runs.metrics if spec.per_frame]
    values = {(metrics[0].name, "toy", frame): 1.0 for frame in frames}
    pictures = Pictures(shown={frame: ["truth", "toy"] for frame in frames})
    assert opening(runs, ["toy"], metrics, values, pictures).methods == ("toy",)
    pictures.shown[frames[0]] = ["truth", None]
    assert opening(runs, ["toy"], metrics, values, pictures).frame == frames[1]
    assert opening(runs, ["toy"], metrics, {}, pictures).frame == frames[0]
    assert opening(runs, ["toy"], metrics, values, Pictures()).frame is None


def test_spread_of_the_shown_methods_decides(toy_run):
    runs, frames = frames_of(toy_run)
    metrics = [spec for spec in runs.metrics if spec.per_frame][:1]
    name = metrics[0].name
    values = {(name, "toy", frame): 1.0 for frame in frames}
    values |= {(name, "failing", frame): 2.0 + (frame == frames[1]) for frame in frames}
    pictures = Pictures(shown={frame: ["truth", "toy", "failing"] for frame in frames})
    found = opening(runs, ["failing", "toy"], metrics, values, pictures)
    assert found.methods == ("failing", "toy")
    assert found.frame == frames[1]
    assert frame_values(runs, metrics)


HOSTILE = "<img src=x onerror=alert(1)>'\"&" + "m" * 80


class Page(HTMLParser):
    """What a browser finds: tables as lists of rows, elements with their attributes, text of the data elements."""

    def __init__(self, path):
        super().__init__()
        self.tables, self.elements, self.texts, self.inside = [], [], {}, None
        self.feed(path.read_text())

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.elements.append((tag, attributes))
        self.inside = f"{tag}#{attributes['id']}" if "id" in attributes else tag
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th") and self.tables:
            self.tables[-1][-1].append([attributes.get("title"), ""])

    def handle_data(self, text):
        self.texts[self.inside] = self.texts.get(self.inside, "") + text
        if self.tables and self.tables[-1] and self.tables[-1][-1]:
            self.tables[-1][-1][-1][1] += text

    @property
    def data(self):
        return json.loads(self.texts["script#data"])

    @property
    def images(self):
        return json.loads(self.texts["script#images"])


@pytest.fixture
def page(toy_run, tmp_path):
    """Make the page of the toy run with changed settings, and read it."""

    def make(runs=(toy_run,), **changes):
        out = tmp_path / "page.html"
        settings = {"runs": tuple(map(str, runs)), "out": str(out), "trust": True, **changes}
        found = write_report(PageSettings(**settings))
        assert found.data["bytes"] == out.stat().st_size
        return Page(out)

    return make


@pytest.fixture(scope="module")
def pages():
    return {}


@pytest.fixture
def toy_page(page, pages):
    """The page of the toy run, which tests of this module share."""
    if not pages:
        pages["toy"] = page()
    return pages["toy"]


def numbers(table):
    """Method, then the full value and the text without marks of each cell, of a table of the page."""
    body = [row for row in table[2:] if len(row) > 1]
    return {row[0][1].strip(): [cell[0] for cell in row[1:]] for row in body}


def test_a_written_run_has_its_tables_front_and_names(page, write_run):
    """The numbers of `headbench table`, the methods that none beats, and a hostile name as text."""
    run = write_run("run", {HOSTILE: 30.0, "better": 31.0, "mean-image": 12.0})
    found = page([run])
    known = layouts(RunSet.read([run]))
    asked = [json.loads(table_text([run], "json", name)) for name in known]
    assert asked
    for table, expected in zip(found.tables, asked):
        rows = [row for _, group in expected["groups"] for row in group]
        wanted = {
            r["method"]: [None if c["value"] is None else str(c["value"]) for c in r["cells"]] for r in rows
        }
        assert numbers(table) == wanted
    plots = found.data["plots"]
    assert [plot["x"] for plot in plots] == ["Size (MB)", "Frame time (ms)"] * 2
    size, time = plots[:2]
    assert size["points"] == [[HOSTILE, 8.0, 30.0], ["better", pytest.approx(8.1), 31.0]]
    assert [point[1] for point in time["points"]] == pytest.approx([1000 / 130, 1000 / 131])
    assert (size["front"], time["front"]) == ([0, 1], [1])
    assert found.data["methods"] == [HOSTILE, "better", "mean-image"]
    assert [tag for tag, _ in found.elements].count("script") == 4
    assert not [a for tag, a in found.elements if tag == "img" and a["src"] == "x"]


def test_parts_are_the_regions_and_sequences_of_the_run(page, write_run):
    run = RunData.read(write_run("run", {"good": 30.0, "better": 31.0}))
    rows = run.rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    face = rows[rows["timestep"] >= 0].assign(region="face", value=rows["value"] + 1)
    Rows.joined([Rows(rows), Rows(face)]).write(run.folder.rows)
    found = page([run.folder.root])
    titles = [attributes["data-title"] for _, attributes in found.elements if "data-title" in attributes]
    assert titles == ["All frames", "Region: face"]
    expected = json.loads(table_text([run.folder.root], "json", region="face"))
    first = expected["groups"][0][1][0]
    assert numbers(found.tables[1])[first["method"]] == [str(c["value"]) for c in first["cells"]]


def test_tables_in_the_form_of_a_paper_have_its_rows(page, write_run):
    run = write_run("run", {"ours": 30.0, "ga": 31.25})
    found = page([run], papers=("tensorial-2025",))
    for number in ("3", "4"):
        expected = json.loads(table_text([run], "json", paper="tensorial-2025", number=number))
        wanted = {row["method"]: [cell["text"] for cell in row["cells"]] for row in expected["groups"][-1][1]}
        tables = [
            {row[0][1].strip(): [cell[1].partition("\n")[0] for cell in row[1:]] for row in table[2:]}
            for table in found.tables
        ]
        assert any(wanted.items() <= table.items() for table in tables), number
    with pytest.raises(InputError, match="tensorial-2025"):
        page([run], papers=("tensorial-2024",))


def test_pictures_are_the_pixels_of_renders_and_capture(toy_page, toy_run):
    found = toy_page
    run = RunData.read(toy_run)
    data = found.data
    for entry in data["frames"]:
        task, subject, sequence, camera, timestep = entry["at"]
        key = FrameKey(
            data["subjects"][subject], data["sequences"][sequence], timestep, data["cameras"][camera]
        )
        name = run.tasks[task]
        expected = [run.ground_truth(key), run.render("toy", name, key)]
        for place, image in zip(entry["p"], expected):
            raw = np.frombuffer(base64.b64decode(found.images[place]), np.uint8)
            shown = cv2.imdecode(raw, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
            assert np.abs(shown - image).max() <= (0 if entry["l"] else 12)
        value = run.value("error", "toy", name, key)
        assert entry["v"][0][0] == pytest.approx(value, abs=1e-3)
    assert {entry["l"] for entry in data["frames"]} == {0, 1}
    assert len(data["frames"]) == sum(map(len, RunSet.read([toy_run]).keys.values()))


def test_a_failed_method_stands_with_its_error(toy_page):
    found = toy_page
    reasons = {found.data["reasons"][-1 - entry["p"][2]] for entry in found.data["frames"]}
    assert reasons == {"RuntimeError: the training diverged"}
    (failed,) = [table for table in found.tables if table[0][-1][1].strip() == "Error"]
    assert {row[3][1].split("\n")[0] for row in failed[1:]} == {"RuntimeError: the training diverged"}


def test_without_the_capture_the_page_says_why(page, toy_run, tmp_path):
    (tmp_path / "data").rename(tmp_path / "gone")
    found = page()
    assert "found nothing there" in found.data["reasons"][0]
    assert str(tmp_path) not in " ".join(found.texts.values())
    assert all(entry["p"][0] == -1 and entry["p"][1] >= 0 for entry in found.data["frames"])
    assert "no ground truth on this page" in " ".join(found.texts.values())
    again = page(data=str(tmp_path / "gone"))
    assert all(entry["p"][0] >= 0 for entry in again.data["frames"])


def test_damaged_images_leave_the_others(page, toy_run, toy, monkeypatch):
    def damaged(clip, key):
        raise InputError("/somewhere/private/image.png", "", "an image", "none")

    (path,) = (toy_run / "subject1" / "toy").rglob("EMO_00001_b.png")  # tables look at the first of a camera
    path.write_bytes(b"no image")
    monkeypatch.setattr(toy.ToyClip, "image", damaged)
    reasons = page().data["reasons"]
    assert any(reason.startswith("image.png: expected an image") for reason in reasons)
    assert any(".png: " in reason and "PNG" in reason for reason in reasons)


def test_nothing_refers_to_another_place(toy_page, toy_run):
    found = toy_page
    for tag, attributes in found.elements:
        assert tag not in ("link", "iframe", "object", "base", "form")
        assert not [name for name in attributes if name.startswith("on") or name in ("style", "srcset")]
        assert attributes.get("src", "data:image/webp;base64,").startswith("data:image/webp;base64,")
        assert attributes.get("href", "#").startswith("#")
    (policy,) = [
        a["content"] for tag, a in found.elements if a.get("http-equiv") == "Content-Security-Policy"
    ]
    assert policy.startswith("default-src 'none'; img-src data:; script-src 'sha256-")
    assert "unsafe" not in policy
    assert "http" not in re.sub(r"http://www\.w3\.org/2000/svg", "", found.texts["script"])
    assert str(toy_run.parents[1]) not in " ".join(found.texts.values())


def test_an_error_cannot_end_the_script_it_stands_in(page, toy_run):
    run = RunData.read(toy_run)
    rows = run.rows.select(method=ALL, metric=ALL, task=ALL, region=ALL, seeds=ALL)
    reason = "</script><script>alert(1)</script>"
    Rows(rows.assign(reason=rows["reason"].where(rows["status"] != "failed", reason))).write(run.folder.rows)
    found = page()
    assert [tag for tag, _ in found.elements].count("script") == 4
    assert found.data["reasons"] == [reason]


def test_the_worst_frames_are_always_there(toy_run, monkeypatch):
    runs = RunSet.read([toy_run])
    every = [ShownFrame(task, key) for task in runs.tasks for key in sorted(runs.keys[task])]
    spec = next(s for s in runs.metrics if s.name == "error")
    values = {("error", "toy", frame): float(index) for index, frame in enumerate(every)}
    moments = {}
    for frame in reversed(every) if not spec.higher_is_better else every:
        moments.setdefault((frame.task, *frame.key[:3]), frame)
    worst = frames.worst_frames(values, runs, spec, count=1)
    expected = {}
    for frame in moments.values():
        expected.setdefault(frame.task, frame)
    assert set(worst) == set(expected.values())
    images = np.random.default_rng(0).integers(0, 256, (4, 4, 3), dtype=np.uint8)
    monkeypatch.setattr(frames._Source, "read", lambda *_: (["x" * 997, None], ["", images.shape]))
    limits = 1000 * len(worst)
    some = choose_pictures(runs, worst, 2 * limits + 999, RunOptions(trust=True), lambda *_: None)
    assert set(worst) <= set(some.shown)
    assert some.bytes == 2 * limits
    few = choose_pictures(runs, worst, limits, RunOptions(trust=True), lambda *_: None)
    assert set(few.shown) == set(worst)
    assert not few.lossless
    with pytest.raises(InputError, match="--max-mb"):
        choose_pictures(runs, worst, limits - 1, RunOptions(trust=True), lambda *_: None)


def test_frames_are_added_evenly_and_from_all_groups():
    every = [
        ShownFrame("t", FrameKey("s", "q", timestep, camera))
        for camera in "ab"
        for timestep in range(0, 90, 10)
    ]
    order = [*spread(every)]
    assert sorted(order) == sorted(every)
    assert [(f.key.camera, f.key.timestep) for f in order[:6]] == [
        *(("a", 0), ("b", 0), ("a", 80), ("b", 80), ("a", 40), ("b", 40))
    ]
    assert [f.key.timestep for f in order[6::2][:2]] == [20, 60]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"max_mb": 0.1}, r"--max-mb"),
        ({"max_mb": 0.01}, r"from 0.1 to 1000"),
        ({"out": "nowhere/page.html"}, r"in an existing folder, found no folder nowhere"),
        ({"runs": ("nothing",)}, r"no run.json"),
    ],
)
def test_faulty_input_is_refused_and_leaves_no_file(page, toy_run, tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    if "max_mb" in changes:
        monkeypatch.setattr(frames, "encode", lambda image, quality: "x" * 10**6)
    with pytest.raises((InputError, ValueError), match=message):
        page(**changes)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_run_half_done(page, toy_run, change_manifest):
    change_manifest(toy_run, lambda m: m.update(status="started"))
    assert "has not ended" in " ".join(page().texts.values())
    (toy_run / "rows.parquet").unlink()
    with pytest.raises(InputError, match="the rows of a finished run"):
        page()


def test_one_page_of_two_runs(page, toy_run, make_run):
    other = make_run("other", methods=("toy_plugin:METHOD",), seeds=(1,))
    found = page([make_run("first"), other])
    assert found.data["methods"] == ["toy"]
    assert all(entry["p"][1] >= 0 for entry in found.data["frames"])


def test_pictures_apart_are_those_of_one_file(toy_page, toy_run, tmp_path, monkeypatch):
    monkeypatch.setattr(sections, "FILE_BYTES", 300)
    single = toy_page
    folder = tmp_path / "folder"
    (folder / "pictures").mkdir(parents=True)
    (folder / "pictures" / "of-an-earlier-page.js").write_text("")
    found = write_report(PageSettings((str(toy_run),), str(folder), split=True, trust=True))
    assert found.data["bytes"] == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    apart = Page(folder / "index.html")
    assert apart.images == []
    texts = [(folder / name).read_text() for name, _ in apart.data["files"]]
    assert len(texts) > 3
    assert len([*(folder / "pictures").iterdir()]) == len(texts)
    loaded = []
    for index, text in enumerate(texts):
        number, pictures = json.loads(f"[{re.fullmatch(r'addPictures.(.*).;', text.strip())[1]}]")
        assert (number, len(pictures)) == (index, apart.data["files"][index][1])
        loaded += pictures
    assert loaded == single.images
    assert apart.data["frames"] == single.data["frames"]


def test_a_folder_with_other_files_is_not_written_to(toy_run, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with pytest.raises(InputError, match=r"earlier report alone, found thesis\.tex"):
        write_report(PageSettings((str(toy_run),), str(tmp_path / "mine"), split=True, trust=True))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ([[1, 2.0], [9, 1.0]], [[1, 4.0], [9, 1.0]], [[1, 1.0], [9, 0.375]]),
        ([[1, 2.0], [9, 1.0]], [[1, 4.0], [8, 1.0]], [[1, 1.0], [9, 0.5]]),
        ([[1, 2.0], [9, 1.0]], "damaged", [[1, 1.0], [9, 0.5]]),
        ([[1, 2.0], [9, -1.0]], None, None),
        (None, None, None),
    ],
)
def test_losses_are_means_of_subjects_with_equal_iterations(make_run, first, second, expected):
    run = make_run("run", methods=("toy_plugin:METHOD",))
    for subject, losses in (("subject1", first), ("subject2", second)):
        if losses is not None:
            path = run / subject / "toy" / "seed-0" / "avatar" / "training.json"
            path.write_text(json.dumps({"losses": losses}))
    curves = loss_curves(RunSet.read([run]))
    assert curves == ([] if expected is None else [{"method": 0, "points": [*map(tuple, expected)]}])


def test_a_run_writes_its_page_beside_the_tables(toy_run):
    folder = RunFolder(toy_run)
    clips = {clip.subject: clip for clip in open_run_clips(toy_run, RunOptions(trust=True))[1]}
    run = FinishedRun(folder, folder.read_manifest(), Rows.read(folder.rows), clips)
    assert write_page(run) == [folder.page]
    assert Page(folder.page).data["methods"] == ["toy", "failing"]


def test_a_card_has_the_citation_of_the_registered_method(page, write_run, change_manifest):
    from headbench.methods.ga.spec import GA

    run = write_run("run", {"ga": 30.0, "mine": 31.0})
    found = page([run])
    assert GA.bibtex not in " ".join(found.texts.values())  # another implementation of that name
    anchors = {a["href"][1:] for tag, a in found.elements if tag == "a" and "#method-" in a.get("href", "")}
    assert anchors == {"method-1", "method-2"} <= {a.get("id") for _, a in found.elements}
    change_manifest(run, lambda m: [r.update(implementation=GA.implementation) for r in m["methods"]])
    text = " ".join(page([run]).texts.values())
    assert text.count(GA.bibtex) == 1
    assert GA.source in text


def test_a_missing_metric_makes_no_difference_testable(page, write_run):
    run = write_run("run", {"good": 30.0, "better": 31.0})
    rows = pd.read_parquet(run / "rows.parquet")
    rows.loc[rows["metric"] == "lpips", ["status", "reason"]] = ["missing", "no weights"]
    rows.to_parquet(run / "rows.parquet", index=False)
    text = " ".join(page([run]).texts.values())
    assert "These subjects are too few to show" in text
    assert "applies to subjects of captures like these" not in text
