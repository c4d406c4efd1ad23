"""Frames of stored avatars: those of a run to the bit, named so that they can be scored; orbits; videos."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from headbench.bench.engine.adaptation import AdaptedClip
from headbench.bench.engine.store import RunFolder
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.io.files import digest_file
from headbench.bench.io.images import read_png
from headbench.reports.render import render as module
from headbench.reports.render.render import RenderSettings, render_avatar


@pytest.fixture
def cell(ball_run):
    return RunFolder(ball_run("BALL")).cell("ball-a", "ball", 0)


@pytest.fixture
def settings(cell, tmp_path):
    (tmp_path / "one" / "ball-a").mkdir(parents=True)
    return RenderSettings(
        str(cell.folder),
        capture=str(tmp_path / "one"),
        out=str(tmp_path / "out"),
        reader="ball_plugin:READER",
        method="ball_plugin:BALL",
    )


@pytest.mark.parametrize("split", ["novel_view", "self_reenactment"])
def test_frames_are_those_of_the_run(settings, cell, tmp_path, split):
    found = render_avatar(replace(settings, frames=split)).data["frames"]
    theirs = sorted((cell.folder / "renders" / split).iterdir())
    assert [path.name for path in found] == [path.name for path in theirs]
    assert all(np.array_equal(read_png(a), read_png(b)) for a, b in zip(found, theirs))


@pytest.mark.parametrize("beside", [False, True])
def test_cameras_and_timesteps_choose_what_videos_hold(settings, beside):
    chosen = replace(settings, cameras=("1", "3"), timesteps=(4, 5), video=True, fps=10.0, beside=beside)
    findings = render_avatar(chosen)
    assert len(findings.data["frames"]) == 4
    assert [path.name for path in findings.data["videos"]] == [
        "self_reenactment_FREE_1.webm",
        "self_reenactment_FREE_3.webm",
    ]
    for video, camera in zip(findings.data["videos"], "13"):
        stream = cv2.VideoCapture(str(video))
        assert stream.get(cv2.CAP_PROP_FPS) == 10
        for timestep in (4, 5):
            wanted = read_png(video.parent / f"self_reenactment/FREE_{timestep:05d}_{camera}.png")
            if beside:
                wanted = np.hstack([np.full_like(wanted, 40 * timestep), wanted])  # as the clip has them
            shown = stream.read()[1][..., ::-1].astype(float)
            assert shown.shape == wanted.shape
            assert np.abs(shown - wanted).mean() < 4
        assert not stream.read()[0]


def test_an_orbit_looks_at_the_head_from_all_sides(settings):
    frames = render_avatar(
        replace(settings, frames="orbit", views=5, beyond=100.0, timesteps=(0, 5), video=True)
    )
    for path in frames.data["frames"]:
        rows, columns = np.nonzero(read_png(path)[..., 0] < 200)
        assert abs(rows.mean() - 14.5) < 1  # the ball is where the cameras look, and its picture where K says
        assert abs(columns.mean() - 11.5) < 1
    assert [path.name for path in frames.data["videos"]] == ["orbit.webm"]


def test_a_capture_is_refitted_to_the_head_model_of_the_avatar(settings, cell, monkeypatch):
    asked = []
    monkeypatch.setattr(
        module, "adapt", lambda clip, needs, heads, folder: asked.append(heads) or AdaptedClip(clip)
    )
    render_avatar(settings)
    head = cell.avatar / "head_model.npz"
    head.touch()
    record = json.loads((cell.avatar / "avatar.json").read_text())
    record |= {"head_model": "flame2020", "head_digest": digest_file(head)}
    (cell.avatar / "avatar.json").write_text(json.dumps(record))
    render_avatar(settings)
    assert asked == [{}, {"flame2020": str(cell.avatar / "head_model.npz")}]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"cameras": ("9",)}, "--cameras: expected those of self_reenactment: 0, 1, 2, 3, 4, found 9"),
        ({"timesteps": (0,)}, "--timesteps: expected those of self_reenactment: 4, 5, found 0"),
        ({"frames": "orbit", "timesteps": (77,)}, "--timesteps"),
        ({"avatar": "nowhere"}, "no such folder"),
        ({"capture": "nowhere"}, "no such folder"),
        ({"method": ""}, "ball"),
    ],
)
def test_what_cannot_be_rendered_is_refused_before_work(settings, tmp_path, monkeypatch, change, match):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=match):
        render_avatar(replace(settings, **change))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("change", [{"views": 0}, {"beyond": 180.0}, {"fps": 0.0}])
def test_settings_without_meaning_are_refused(settings, change):
    with pytest.raises(ValueError, match="is"):
        replace(settings, **change)


def test_a_video_without_its_writer_is_refused_before_work(settings, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(UnavailableError, match="PyAV"):
        render_avatar(replace(settings, video=True))
    assert not Path(settings.out).exists()
