"""``headbench run parity`` around a stand-in for the authors' repository."""

import math
import re
from dataclasses import replace

import pytest
from scipy import stats

from headbench.bench import cli
from headbench.bench.configuration import build
from headbench.bench.engine import run as runner
from headbench.bench.engine.config import resolve_cells
from headbench.bench.io.documents import read_json
from headbench.bench.rows import Row, Rows
from headbench.methods.flashavatar.spec import FlashAvatarConfig
from headbench.methods.gbs.spec import GBSConfig
from headbench.methods.official.parity.parity import ParitySettings, as_theirs, differences_of, run_config
from headbench.methods.rgbavatar.spec import RGBAvatarConfig
from headbench.methods.shared.config import PAPER_ITERATIONS, SplatTraining
from headbench.methods.shared.schedule import DensifySchedule, Timeline

from ...datasets.head.toy import toy_head
from ...datasets.tiny_capture import make_plan, rig, write_tiny_capture
from .repository import make_interpreter, make_repository

OFFICIAL = "ga-official (cpu-shim)"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A directory with a capture, a repository and an interpreter."""
    lengths = {"FREE": 2, "EMO-1-shout+laugh": 2, "SEN-01-cramp_small_danger": 1}
    head = toy_head(16, version="procedural2020")
    plan = make_plan(lengths=lengths, cameras=rig(24, 32, 12.3, 15.1)[:2], head=head)
    write_tiny_capture(tmp_path / "capture", plan)
    make_repository(tmp_path / "repository", toy_head(16))
    make_interpreter(tmp_path / "python")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "write_reports", lambda out: [])  # nothing here reads them
    return tmp_path


def parity(*words):
    line = "run parity ga --checkout repository --python ./python --commit= --device cpu-shim --data capture --out out"
    return cli.main([*line.split(), *words])


@pytest.mark.commands
def test_both_are_trained_and_their_difference_tabled(folder, capsys):
    words = ("--iterations", "5", "--orders", "1", "--tolerance", "200")
    assert parity(*words) == 0
    text = (folder / "out" / "parity.md").read_text()
    assert not re.search(r"[|#]|\*\*", capsys.readouterr().out)
    assert re.search(r"\| novel view \| PSNR \| all \| all \| .*\*\*[+-][\d.]+\*\*", text)
    assert OFFICIAL in text
    assert "not the original" in text
    found = read_json(folder / "out" / "parity.json")
    assert {entry["task"] for entry in found["differences"]} == {"novel_view", "self_reenactment"}
    rows = Rows.read(folder / "out" / "run" / "rows.parquet")
    assert rows.methods == {"ga", OFFICIAL}
    avatar = folder / "out" / "run" / "901" / OFFICIAL / "seed-0" / "avatar"
    record = read_json(avatar / "training.json")
    assert record["official"]["device"] == "cpu-shim"
    assert any("order in which the native method" in line for line in record["differences"])
    # Again: nothing is trained anew, and another tolerance has another verdict.
    log = (avatar / "training.log").read_bytes()
    assert parity(*words[:-1], "0.001") == 1
    assert (avatar / "training.log").read_bytes() == log


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("ga --checkout nowhere", "--checkout"),
        ("ga --checkout repository --python ./python --commit= --data nowhere", "nowhere"),
        ("flashavatar --checkout repository --iterations 15001", "at most 15000 with flashavatar"),
    ],
)
def test_bad_input_is_told_before_any_work(folder, capsys, words, expected):
    assert cli.main(["run", "parity", *words.split(), "--device", "cpu-shim", "--out", "out"]) == 2
    assert expected in capsys.readouterr().err
    assert not list(folder.glob("out/run/901"))


def test_settings_do_what_the_program_is_told(tmp_path):
    for iterations in (600, 2_000, 40_000, PAPER_ITERATIONS):
        changes = as_theirs("ga", iterations, 0)["splats"]
        timeline = Timeline(iterations, PAPER_ITERATIONS)
        schedule = DensifySchedule.of(SplatTraining(**changes), timeline, white=True)
        # Their program removes large splats after the iteration of its first regular reset.
        assert schedule.prune_extent_from == schedule.reset_every
    config = run_config(ParitySettings("ours", checkout="x", out="y"), tmp_path)
    assert config.methods == ("ours", "tga-official")
    assert config.settings["ours"]["sampling"] == {"balanced": False}
    config = run_config(ParitySettings("gbs", checkout="x", out="y", samples=300), tmp_path)
    assert config.settings["gbs-official"]["arguments"] == ("--init_face_point_number", "300")
    native = build(GBSConfig, {k: v for k, v in config.settings["gbs"].items() if k != "budget"}, "gbs")
    assert (native.samples, native.teeth_samples, native.min_sh_every) == (300, 30, 1_000)


def test_rgbavatar_is_compared_on_a_chart_with_its_axes(tmp_path):
    config = run_config(ParitySettings("rgbavatar", checkout="x", out="y", samples=300), tmp_path)
    assert config.methods == ("rgbavatar", "rgbavatar-official")
    assert config.clip.name == "rigid-head"
    assert [(c.as_tracked, c.clip.name) for c in config.conditions] == [(True, "packed-chart")]
    assert [method.spec.monocular for method, _ in resolve_cells(config)] == [False, False]
    native, official = (config.settings[name] for name in config.methods)
    settings = build(RGBAvatarConfig, {k: v for k, v in native.items() if k != "budget"}, "rgbavatar")
    assert (settings.frame_variant, settings.color_init_variant) == ("official", "official")
    assert (settings.inputs, settings.random_background, settings.samples) == (("expression",), False, 300)
    assert (official["samples"], official["motion"], official["order"]) == (300, "root", "native")
    assert {"use_pose_weight=False", "random_bg_color=False"} < set(official["values"])


def test_flashavatar_is_compared_as_tracked_without_a_neck(tmp_path):
    config = run_config(ParitySettings("flashavatar", checkout="x", out="y", device="cpu-shim"), tmp_path)
    assert config.methods == ("flashavatar", "flashavatar-official")
    assert config.clip.name == "rigid-head"
    assert [(c.name, c.as_tracked) for c in config.conditions] == [("as-tracked", True)]
    found = [(method.spec.head_models, method.spec.monocular) for method, _ in resolve_cells(config)]
    assert found == [((), False)] * 2
    native, official = (config.settings[name] for name in config.methods)
    assert (native["samples"], official["samples"]) == (13_500, 13_500)
    assert [official[name] for name in ("order", "masks", "start")] == 3 * ["native"]
    iterations = Timeline(native["budget"]["iterations"], 150_000)
    settings = build(FlashAvatarConfig, {k: v for k, v in native.items() if k != "budget"}, "flashavatar")
    assert iterations.every(settings.sh_every, settings.min_sh_every) == 500
    config = run_config(ParitySettings("flashavatar", checkout="x", out="y", samples=300), tmp_path)
    assert {config.settings[name]["samples"] for name in config.methods} == {300}


def test_differences_are_paired_by_subject_and_order():
    values = {"ga": (20.0, 22.0, 24.0), "official": (21.0, 22.0, 26.0)}
    rows = [
        Row(name, "1", order, "novel_view", "s", sequence, 0, "c", "full", "psnr", value + shift, "hash")
        for name, of in values.items()
        for order, value in enumerate(of)
        for sequence, shift in (("one", -1.0), ("two", 1.0))
    ]
    (found,) = differences_of(Rows.of(rows), "ga", "official", range(3))
    assert found.native == pytest.approx(values["ga"])
    assert found.difference == pytest.approx(1.0)
    # Student's t with two degrees of freedom, 97.5 %: 4.3027; the differences 1, 0, 2 have a deviation of 1.
    assert found.half_width == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
    expected = stats.ttest_1samp([1, 0, 2], 1.5, alternative="less").pvalue
    assert found.equivalence_p(1.5) == pytest.approx(expected)
    assert found.equivalence_p(0.5) > 0.5
    (single,) = differences_of(Rows.of(rows), "ga", "official", [0])
    assert single.half_width is single.equivalence_p(9.0) is None
    kept = [row for row in rows if (row.method, row.seed) != ("official", 0)]
    (found,) = differences_of(Rows.of(kept), "ga", "official", range(3))
    assert (found.pairs, found.native) == ((("s", 1), ("s", 2)), pytest.approx(values["ga"][1:]))
    both = [*rows, *(replace(row, subject="t", value=row.value + 10) for row in rows)]
    (found,) = differences_of(Rows.of(both), "ga", "official", range(3))
    assert found.pairs == tuple((subject, order) for subject in "st" for order in range(3))
    assert found.difference == pytest.approx(1.0)
