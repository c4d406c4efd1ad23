"""The command on a painted capture, and its file as a setting of the reader."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.protocol import make_protocol
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.writer import CapturePlan, CaptureWriter, SequencePlan
from headbench.datasets.steps.exclude import read_exclusions, write_exclusions
from headbench.datasets.steps.tongue.command import DECISIONS_FILE, TongueSettings, tongue
from headbench.datasets.steps.tongue.evidence import decide, find_evidence
from headbench.datasets.steps.tongue.mouth import facing_cameras, mouth_atlas, sample_clip
from headbench.datasets.synthetic.capture import synthesize

from .painted import TONGUE, Moment, geometry, painted_clip


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_synthetic_subject_is_decided_as_labelled(tmp_path):
    (union,) = synthesize(tmp_path, cameras=2, timesteps=40, size=(96, 136), seed=50, workers=1)
    clip = read_capture(union)
    labelled = {key.timestep for key in clip.excluded}
    atlas = mouth_atlas(clip)
    cameras = facing_cameras(clip, atlas, 4)
    colours = sample_clip(clip, atlas, cameras)
    evidence = find_evidence(colours, atlas)
    decided = decide(dict.fromkeys(colours.timesteps, ""), evidence, tuple(cameras), None, {})
    assert labelled
    assert set(decided.reasons()) == labelled


TALK = [Moment({"jaw_open": 0.12 * (t % 4), "head_turn": 0.03 * t}) for t in range(6)]
FREE = [
    Moment({"jaw_open": 0.4}, blob=TONGUE),
    Moment({"jaw_open": 0.8}),
    Moment({"jaw_open": 0.3}, blob=TONGUE),
]
OUT = {6, 8}  # timesteps of the union, in which training comes first


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    clip = painted_clip([*TALK, *FREE])
    poses = list(clip.poses.values())
    plan = CapturePlan(
        subject="900",
        head=geometry().head,
        shape=clip.shape,
        static_offset=clip.static_offset,
        cameras=list(clip.cameras.values()),
        sequences=[SequencePlan("EMO-1", poses[: len(TALK)]), SequencePlan("FREE", poses[len(TALK) :])],
        test_sequences=["FREE"],
        novel_view_cameras=["at1"],
        cy="top",
    )
    writer = CaptureWriter(tmp_path_factory.mktemp("painted"), plan)
    for key, image in clip.images.items():
        free = key.timestep >= len(TALK)
        start = len(TALK) if free else 0
        writer.write_frame("FREE" if free else "EMO-1", key.timestep - start, key.camera, image)
    return writer.write_metadata()


def look(capture, out, **changes):
    seen = []
    settings = replace(TongueSettings(str(capture), str(out)), **changes)
    findings = tongue(settings, lambda done, total, note="": seen.append((done, total)))
    assert seen
    return findings


@pytest.mark.commands
def test_decisions_overrides_and_exclusion(capture, tmp_path):
    findings = look(capture, tmp_path)
    path = tmp_path / DECISIONS_FILE
    assert set(read_exclusions(path)["900"].reasons()) == OUT
    assert set(findings.data["900"]["excluded"]) == {"6", "8"}
    assert "FREE: 6, 8" in findings.text
    assert findings.passed
    sheet = cv2.imread(str(tmp_path / "tongue_900.png"))
    assert sheet is not None
    # Two tiles have the border of frames left out, seven that of those kept.
    red = (sheet == [40, 40, 200]).all(axis=2).sum()
    green = (sheet == [80, 140, 60]).all(axis=2).sum()
    assert green == pytest.approx(3.5 * red, rel=0.2)

    decided = read_exclusions(path)
    edited = replace(decided["900"], overrides={8: "keep", 3: "blink"})
    write_exclusions(path, {"900": edited, "other": decided["900"]})
    look(capture, tmp_path)
    again = read_exclusions(path)
    assert again["900"].overrides == {8: "keep", 3: "blink"}
    assert again["other"].reasons() == decided["900"].reasons()

    clip = read_capture(capture, exclude=path)
    assert {key.timestep for key in clip.excluded} == {3, 6}
    assert {reason for key, reason in clip.excluded.items() if key.timestep == 3} == {"blink"}
    assert all(key.timestep not in (3, 6) for keys in clip.splits.values() for key in keys)
    assert clip.steps[-1].name == "exclude_timesteps"
    protocol = make_protocol("self_reenactment", [clip])
    assert {key.timestep: reason for key, reason in protocol.excluded}[6].startswith("tongue out")


@pytest.mark.commands
def test_given_threshold_is_used_and_bad_input_is_refused(capture, tmp_path):
    for name, value in (("threshold", -1.0), ("threshold", np.inf), ("cameras", 0), ("frames", 0)):
        with pytest.raises(InputError) as caught:
            look(capture, tmp_path, **{name: value})
        assert caught.value.file == f"--{name}"
    assert not any(tmp_path.iterdir())
    with pytest.raises(InputError):
        look(tmp_path, tmp_path / "out")
    path = tmp_path / DECISIONS_FILE
    look(capture, tmp_path, threshold=1e5)
    decided = read_exclusions(path)["900"]
    assert (decided.threshold, decided.basis, decided.reasons()) == (1e5, "given", {})
    write_exclusions(path, {"900": replace(decided, overrides={99: "keep"})})
    with pytest.raises(InputError, match="99"):
        look(capture, tmp_path)
