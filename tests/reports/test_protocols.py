"""Rows under named protocols."""

import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from headbench.bench.errors import InputError
from headbench.bench.protocol import NamedProtocol, TaskFrames, named_protocols
from headbench.bench.rows import Rows
from headbench.reports.aggregate import summarise
from headbench.reports.protocols import USUAL, ProtocolsSettings, choices, protocols_command, under
from headbench.reports.runs import RunSet
from headbench.reports.table_report import table_text

from .made_rows import row
from .test_table_report import GALLERY

BOTH = {"novel_view": TaskFrames(), "self_reenactment": TaskFrames()}


@pytest.fixture(scope="module")
def runs():
    return RunSet.read([GALLERY])


@pytest.fixture(scope="module")
def rows():
    rows = pd.read_parquet(GALLERY / "rows.parquet")
    return rows[(rows.method == "ga") & (rows.metric == "psnr") & (rows.condition == "")]


def mean(runs, protocol, task, metric="psnr"):
    return summarise(under(runs, "p", protocol).rows, "ga", metric, task).value


def test_means_over_frames_cameras_and_regions(runs, rows):
    held_out = rows[rows.task == "novel_view"].camera.iloc[0]
    own = rows[(rows.task == "self_reenactment") & (rows.region == "full")]
    face = rows[(rows.task == "novel_view") & (rows.region == "face")]
    ends = own[own.timestep.isin(sorted(own.timestep.unique())[-2:])]
    usual = NamedProtocol("x", "", dict(BOTH))
    cases = [
        (usual, "self_reenactment", own),
        (TaskFrames("unseen"), "self_reenactment", own[own.camera == held_out]),
        (TaskFrames("seen"), "self_reenactment", own[own.camera != held_out]),
        (TaskFrames(last=2), "self_reenactment", ends),
        (replace(usual, region="face"), "novel_view", face),
    ]
    for case, task, expected in cases:
        protocol = replace(usual, tasks={task: case}) if isinstance(case, TaskFrames) else case
        assert mean(runs, protocol, task) == pytest.approx(expected.value.mean(), abs=1e-6)


def test_pooled_psnr_is_that_of_the_mean_squared_error():
    errors = [1e-3, 3e-3, 4e-4, 2e-2, 5e-3]
    given = [row("a", "psnr", -10 * math.log10(e), timestep=t) for t, e in enumerate(errors)]
    given += [row("a", "lpips", e, timestep=t) for t, e in enumerate(errors)]
    rows = Rows.of(given).pooled(2, {"psnr"})
    batches = [np.mean(errors[:2]), np.mean(errors[2:4]), errors[4]]
    found = summarise(rows, "a", "psnr", "novel_view").value
    assert found == pytest.approx(np.mean([-10 * math.log10(e) for e in batches]))
    assert summarise(rows, "a", "lpips", "novel_view").value == pytest.approx(np.mean(batches))


def test_sequences_have_the_same_weight_or_frames_have():
    given = [row("a", "psnr", 30.0, sequence="x", timestep=t) for t in range(3)]
    rows = Rows.of([*given, row("a", "psnr", 20.0, sequence="y")])
    assert summarise(rows, "a", "psnr", "novel_view").value == 25.0
    one = rows.as_one_sequence()
    assert summarise(one, "a", "psnr", "novel_view").value == 27.5
    one.check()  # frames of two sequences with the same timestep stay apart


def test_a_profile_gives_its_values_the_usual_names(runs, tmp_path, change_manifest):
    folder = tmp_path / "run"
    shutil.copytree(GALLERY, folder)
    rows = pd.read_parquet(GALLERY / "rows.parquet")
    rows["metric"] = rows["metric"].replace({"psnr": "psnr@ga-training"})
    Rows(rows).write(folder / "rows.parquet")

    def rename(manifest):
        for spec in manifest["metrics"]:
            if spec["name"] == "psnr":
                label = f"{spec['label']} (ga-training)"
                spec.update(
                    name="psnr@ga-training", label=label, profile="ga-training", tables=["ga-training"]
                )

    change_manifest(folder, rename)
    protocol = named_protocols()["gaussianavatars-2024"]
    own = under(RunSet.read([folder]), "p", protocol)
    assert [spec.label for spec in own.metrics if spec.per_frame] == ["PSNR"]
    same = under(runs, "p", replace(protocol, profile="canonical"))
    for task in BOTH:
        assert summarise(own.rows, "ga", "psnr", task) == summarise(same.rows, "ga", "psnr", task)
    text = table_text([folder], "md", protocol="gaussianavatars-2024")
    assert "Protocol gaussianavatars-2024: GaussianAvatars, CVPR 2024" in text


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cro-2026", "regions: expected foreground, by protocol cro-2026, found .*headbench run --protocol"),
        ("gaussianavatars-2024", "metrics: expected metrics of profile ga-training"),
    ],
)
def test_what_the_rows_lack_is_refused_by_name(runs, name, message):
    with pytest.raises(InputError, match=message):
        under(runs, name, named_protocols()[name])


def test_missing_sequences_and_tasks_are_refused(runs):
    some = NamedProtocol("x", "", {"self_reenactment": TaskFrames(sequences=("EMO",))})
    with pytest.raises(InputError, match="sequences: expected EMO, held out, by protocol p, found FREE"):
        under(runs, "p", some)
    with pytest.raises(InputError, match="tasks: expected novel_view, by protocol p"):
        under(replace(runs, tasks=("self_reenactment",)), "p", NamedProtocol("x", "", {"novel_view": {}}))
    with pytest.raises(InputError, match="--protocol: expected no --region or --sequences"):
        table_text([GALLERY], "md", protocol="suite", region="face")


def test_differences_from_the_published_conditions_are_said(runs):
    text = table_text([GALLERY], "md", protocol="suite")
    assert "Pixels: 120x174; in the protocol: 144x208." in text
    assert "Mean over frames, then sequences, then subjects" in text
    assert "Mean over frames, then subjects" in table_text([GALLERY], "md", protocol="mogaface-2026")
    assert "fitted to" not in text
    text = table_text([GALLERY], "md", protocol="fate-2025-imavatar")
    assert "Scored frames: as tracked; in the protocol: fitted to their own pictures" in text


@pytest.mark.commands
def test_every_choice_is_tabled_as_a_difference(runs, tmp_path):
    result = protocols_command(ProtocolsSettings((str(GALLERY),), methods=("ga", "ours")), None)
    values = result.data["values"]
    assert {USUAL, "pixels: face", "cameras: unseen", "pooled: 16 frames"} <= {*values}
    assert {*values} | {*result.data["refused"]} == {*choices(runs)}
    key = "ga self_reenactment psnr"
    change = values["cameras: unseen"][key] - values[USUAL][key]
    assert re.search(rf"cameras: unseen +{re.escape(f'{change:+.2f}')} ", result.text)
    protocols_command(ProtocolsSettings((str(GALLERY),), ("ga",), out=str(tmp_path / "effects.md")), None)
    assert "| cameras: unseen | " in (tmp_path / "effects.md").read_text()
    with pytest.raises(InputError, match="--methods: expected some of"):
        protocols_command(ProtocolsSettings((str(GALLERY),), methods=("gaa",)), None)
