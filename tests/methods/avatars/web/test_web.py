"""Avatars baked for a page: against the avatars' own splats, and what the bytes keep of them."""

import base64
import hashlib
import re
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.experiments.viewpoints import head_center
from headbench.bench.specs import ResolutionRule
from headbench.datasets.open import open_clip
from headbench.methods.avatars.web.export import decode, encode, training_images

CENTER = np.array([0.0, 0.0, 1.0])


def values_of(baked, **wanted):
    names = [slider.name.replace(" ", "_") for slider in baked.sliders]
    assert {*wanted} <= {*names}
    return np.array([wanted.get(slider.name.replace(" ", "_"), 0.0) for slider in baked.sliders])


def test_splats_at_the_step_of_a_slider_are_the_avatars(exported):
    source, baked = exported.source, exported.baked
    for number, slider in enumerate(baked.sliders):
        values = np.zeros(len(baked.sliders))
        values[number] = slider.step
        theirs = source.seen(source.pose(baked.sliders, values))
        moved = baked.moved(values, CENTER)
        # Both ways are averaged, so that what bends shows a little.
        assert np.abs(moved.means - theirs.means).max() < (1e-6 if slider.low >= 0 else 2e-3), slider.name
        covariances = moved.axes @ moved.axes.transpose(0, 2, 1)
        axes = theirs.rotations * np.exp(theirs.log_scales)[:, None, :]
        assert np.abs(covariances - axes @ axes.transpose(0, 2, 1)).max() < 0.1 * covariances.max(), (
            slider.name
        )


def test_sliders_moved_together_stay_near_the_avatar(exported):
    source, baked = exported.source, exported.baked
    moved = {baked.sliders[0].name.replace(" ", "_"): 0.1}
    values = values_of(baked, jaw_open=0.2, neck_turn=0.3, neck_nod=-0.1, eyes_sideways=0.2, **moved)
    moved = baked.moved(values, CENTER).means
    theirs = source.seen(source.pose(baked.sliders, values)).means
    travelled = np.linalg.norm(theirs - baked.means, axis=1)
    assert travelled.max() > 0.02
    assert np.abs(moved - theirs).max() < 0.15 * travelled.max()


def test_the_bytes_keep_what_can_be_seen(exported):
    baked = exported.baked
    kept = decode(encode(baked, exported.view))
    assert kept.sliders == baked.sliders
    assert kept.turned == baked.turned
    assert np.abs(kept.means - baked.means).max() < 1e-5
    assert np.abs(kept.rotations - baked.rotations).max() < 0.05
    assert np.abs(kept.weights - baked.weights).max() < 0.5 / 255 + 1e-9
    assert np.abs(kept.d_means - baked.d_means).max() < 1e-4
    still = np.abs(baked.d_means).max(axis=2) == 0
    assert (kept.d_means[still] == 0).all()


def test_what_the_page_loses_is_told(exported):
    findings = exported.findings
    assert findings.data["bytes"] == exported.page.stat().st_size
    groups = {"rest", "expressions", "jaw", "neck", "eyes", "together"}
    assert findings.data["psnr"].keys() - {"recorded"} == groups
    # Colours of the planes change with the direction more than the page's harmonics can.
    assert min(findings.data["psnr"].values()) > 34
    assert "dB" in findings.text


def test_the_page_allows_its_own_script_alone(exported):
    text = exported.page.read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1].replace("&#39;", "'")
    script = text.rpartition("<script>")[2].rpartition("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    style = re.search(r"<style>(.*?)</style>", text, re.DOTALL)[1]
    of_style = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert policy.split("; ") == [
        *("default-src 'none'", "img-src data:", f"script-src 'sha256-{digest}'"),
        *(f"style-src 'sha256-{of_style}'", "base-uri 'none'", "form-action 'none'"),
    ]
    assert "<title>&lt;script&gt;x&lt;/script&gt;</title>" in text
    assert "digitalsourcetype/trainedAlgorithmicMedia" in text
    assert not re.search(r"https?://(?!cv\.iptc\.org)", text)


def test_sequences_replay_what_was_recorded(exported, run):
    """The splats of a recorded pose against those of the page at the values of its moment."""
    source, baked, sequences = exported.source, exported.baked, exported.more["sequences"]
    if not sequences:  # tracked with another head model
        assert "no sequences" in exported.findings.text
        return
    clip = open_clip(str(run.read_manifest().configuration.data))
    keys = sorted(clip.splits["self_reenactment"])
    (held_out,) = [sequence for sequence in sequences if sequence["note"] == "held out"]
    assert held_out["name"] == keys[0].sequence
    poses = [clip.poses[timestep] for timestep in sorted({key.timestep for key in keys})]
    assert len(held_out["values"]) == len(poses)
    for pose, row in zip(poses, held_out["values"]):
        values = np.array(row) * [slider.step for slider in baked.sliders]
        there = replace(
            pose, rotation=source.rest.rotation, translation=source.rest.translation, timestep=None
        )
        theirs = source.seen(there).means
        moved = baked.moved(values, CENTER).means
        assert np.abs(moved - theirs).max() < 0.25 * np.abs(theirs - baked.means).max() + 5e-4


def test_pixels_of_the_training_follow_the_rule(run):
    clip = open_clip(str(run.read_manifest().configuration.data))
    camera = next(iter(clip.cameras.values()))
    plain, halved = (training_images(clip, ResolutionRule(divide=divide)) for divide in (1, 2))
    assert plain["size"] == [camera.width, camera.height]
    assert halved["pixel"] == pytest.approx(2 * plain["pixel"], rel=1e-3)
    near = plain["pixel"] * camera.K[1, 1]
    assert near == pytest.approx(np.linalg.norm(camera.center - head_center(clip)), rel=0.2)
