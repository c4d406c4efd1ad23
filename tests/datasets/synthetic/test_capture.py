import hashlib
import json
import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from headbench.bench.errors import HeadbenchError, InputError
from headbench.bench.executors.settings import Execution
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.synthetic.capture import synthesize
from headbench.datasets.synthetic.plan import EDITION, FRONTAL, RESIDUALS

from .conftest import SMALL


def images(out):
    return {path.relative_to(out): path.read_bytes() for path in sorted(out.rglob("*.png"))}


def test_reader_reads_what_was_planned(capture):
    _, union, calls = capture
    clip = read_capture(union)
    assert calls[0] == (0, 8)
    assert calls[-1] == (8, 8)
    assert {key.camera for key in clip.splits["train"]} == set(clip.cameras) - {FRONTAL}
    assert {key.camera for key in clip.splits["novel_view"]} == {FRONTAL}
    assert {key.sequence for key in clip.splits["self_reenactment"]} == {"FREE"}
    assert {key.sequence for key in clip.splits["train"]}.isdisjoint({"FREE"})
    assert clip.excluded
    assert all("tongue" in reason for reason in clip.excluded.values())
    key = clip.splits["train"][0]
    assert clip.image(key).shape == (46, 32, 3)
    assert len({tuple(pose.expression) for pose in clip.poses.values()}) == 4


def test_killed_run_continues_to_the_same_images(capture, tmp_path):
    out = shutil.copytree(capture[0], tmp_path / "capture")
    union = out / capture[1].relative_to(capture[0])
    before = images(out)
    chosen = sorted(before)[::3]
    (out / chosen[0]).unlink()
    (out / chosen[1]).write_bytes(before[chosen[1]][:100])  # as a kill without renaming would leave it
    untouched = {path: os.stat(out / path).st_mtime_ns for path in before if path.name != chosen[0].name}
    (union / "transforms_train.json").unlink()
    synthesize(out, **SMALL)
    assert images(out) == before
    assert (union / "transforms_train.json").exists()
    same = [path for path in untouched if path.name != chosen[1].name]
    assert all(os.stat(out / path).st_mtime_ns == untouched[path] for path in same)


def test_other_settings_are_refused(capture, tmp_path):
    for changes in ({"seed": 5}, {"performance": "still"}):
        with pytest.raises(InputError, match=next(iter(changes))):
            synthesize(capture[0], **{**SMALL, **changes})
    settings = json.loads((capture[0] / "synthesis.json").read_text())
    assert (settings["performance"], settings["tracker"], settings["edition"]) == ("full", "video", EDITION)
    with pytest.raises(InputError, match="seed"):
        synthesize(tmp_path / "seed", **SMALL, seed=5, pictures=capture[0])
    assert not (tmp_path / "seed").exists()
    half = tmp_path / "half"
    half.mkdir()
    (half / "synthesis.json").write_bytes((capture[0] / "synthesis.json").read_bytes())
    with pytest.raises(InputError, match="found none that is whole"):
        synthesize(tmp_path / "third", **SMALL, tracking_error=1.0, pictures=half)
    for name in ("thesis.txt", ".hidden"):
        foreign = tmp_path / f"of {name}"
        foreign.mkdir()
        (foreign / name).write_text("irreplaceable")
        with pytest.raises(InputError, match="other files"):
            synthesize(foreign, **SMALL)


def test_pictures_are_those_of_a_capture_tracked_otherwise(capture, tmp_path):
    (union,) = synthesize(tmp_path / "other", **SMALL, tracking_error=1.0, pictures=capture[0])
    assert images(tmp_path / "other") == images(capture[0])
    exact, other = read_capture(capture[1]), read_capture(union)
    assert exact.splits == other.splits
    assert not np.array_equal(exact.poses[0].expression, other.poses[0].expression)


@pytest.mark.slow
def test_by_tasks_the_files_are_the_same(tmp_path):
    pair = {**SMALL, "subjects": 2}
    outs = [tmp_path / name for name in ("one", "two")]
    synthesize(outs[0], **pair)
    synthesize(outs[1], **pair, execution=Execution("processes", workers=2, threads=1))
    found = [{p.relative_to(out): p.read_bytes() for p in out.rglob("*") if p.is_file()} for out in outs]
    assert found[0] == found[1]


@pytest.mark.slow
def test_a_subject_that_fails_is_named_with_its_log(tmp_path, monkeypatch):
    # Where the process that renders has another idea of what there is, the outcome is not believed.
    monkeypatch.setattr(
        "headbench.datasets.synthetic.capture._missing", lambda plan, sequence, timestep: ("0",)
    )
    once = Execution("processes", workers=1, threads=1, restarts=0)
    with pytest.raises(HeadbenchError, match="Subject 900 failed: .*missing.*job.log"):
        synthesize(tmp_path, **SMALL, execution=once)


@pytest.mark.parametrize("left", [[".tmp-headbench-a.json"], ["synthesis.json"], []])
def test_a_start_killed_before_the_first_image_is_resumed(capture, tmp_path, monkeypatch, left):
    class Planned(Exception):
        pass

    def plan(*_):
        raise Planned

    for name in left:
        there = capture[0] / name
        (tmp_path / name).write_bytes(there.read_bytes() if there.exists() else b"")
    monkeypatch.setattr("headbench.datasets.synthetic.capture.plan_subject", plan)
    with pytest.raises(Planned):
        synthesize(tmp_path, **SMALL)
    for name in ("README.txt", "synthesis.json"):
        assert (tmp_path / name).read_bytes() == (capture[0] / name).read_bytes()


@pytest.mark.parametrize(
    "change",
    [
        {"cameras": 1},
        {"cameras": 17},
        {"timesteps": 2},
        {"size": (8, 8)},
        {"tracking_noise": -0.1},
        {"subjects": 0},
        {"performance": "asleep"},
        {"dynamics": -0.5},
        {"dynamics": float("nan")},
        {"hair_lag": -0.1},
        {"camera_colour": 4.1},
        {"motion_blur": float("nan")},
        {"mask_error": float("inf")},
        {"correctives": -1.0},
        {"head": "no-such-file.npz"},
        {"edition": EDITION - 1},
    ],
)
def test_bad_settings_are_refused_before_anything_is_written(tmp_path, change):
    out = tmp_path / "capture"
    with pytest.raises(InputError):
        synthesize(out, **{**SMALL, **change})
    assert not out.exists()


def content(path):
    """What a file of a capture holds, whatever library packed it."""
    if path.suffix == ".png":
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED).tobytes()
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            return b"".join(
                f"{name} {arrays[name].dtype}".encode() + arrays[name].tobytes() for name in arrays.files
            )
    return path.read_bytes()


DIGESTS = {
    "plain": {
        ".json": "1b6a132015d7d892",
        ".npz": "99342d2810fb4ff3",
        ".png": "0fdbd8b5db20d443",
        ".txt": "786fab0254f7d5ea",
    },
    "with residuals": {
        ".json": "5c71f03630ca8cec",
        ".npz": "519ff796fa7fdbe3",
        ".png": "73606a35a76d44ac",
        ".txt": "786fab0254f7d5ea",
    },
}


@pytest.mark.parametrize("pictures", DIGESTS)
def test_a_small_capture_has_the_same_bytes_on_every_machine(capture, tmp_path, pictures):
    """A change of what captures show is a new `EDITION`, with new digests here. XMP states headbench's version."""
    out, found = capture[0], {}
    if pictures == "with residuals":
        out = tmp_path / "capture"
        synthesize(out, **SMALL, **dict.fromkeys(RESIDUALS, 2.0), tracking_error=1.0)
    assert "digitalsourcetype/algorithmicMedia<" in (out / "provenance.xmp").read_text()
    for path in sorted(path for path in out.rglob("*.*") if path.suffix != ".xmp"):
        kind = found.setdefault(path.suffix, hashlib.sha256())
        kind.update(path.relative_to(out).as_posix().encode() + content(path))
    assert {kind: digest.hexdigest()[:16] for kind, digest in found.items()} == DIGESTS[pictures]


_NUMPY = [name for name in np.show_config(mode="dicts")["SIMD Extensions"].get("found", []) if name]
_MACHINES = {
    "as this one": {},
    "one thread, SSE4": {
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_CORETYPE": "Nehalem",
        "ATEN_CPU_CAPABILITY": "default",
        "NPY_DISABLE_CPU_FEATURES": " ".join(_NUMPY),
        "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA",
    },
}
_MAKE = """
import sys
from headbench.datasets.synthetic import capture, plan

levels = dict.fromkeys(plan.RESIDUALS, 4.0) if sys.argv[2] == "with residuals" else {}
capture.synthesize(sys.argv[1], cameras=2, timesteps=4, size=(32, 46), samples_per_pixel=9,
                   tracking_noise=0.1, workers=1, **levels)
"""


@pytest.mark.slow
@pytest.mark.parametrize("pictures", ["rendered", "with residuals"])
def test_threads_and_instruction_sets_leave_all_bytes(tmp_path, pictures):
    outs = {tmp_path / name: settings for name, settings in _MACHINES.items()}
    runs = [
        subprocess.Popen([sys.executable, "-c", _MAKE, str(out), pictures], env={**os.environ, **settings})
        for out, settings in outs.items()
    ]
    assert [run.wait() for run in runs] == [0, 0]
    first, other = (
        {path.relative_to(out): path.read_bytes() for path in out.rglob("*") if path.is_file()}
        for out in outs
    )
    assert any(path.name == "head_model.npz" for path in first)
    assert [path for path in first if first[path] != other.get(path)] == []
    assert first.keys() == other.keys()
