"""Times, gaps and lost faces: in every format the jaw opens at a constant rate, which the poses keep to."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.drive.formats import read_signal
from headbench.datasets.drive.signal import JAW_OPEN, SignalRequest
from headbench.datasets.drive.timing import Timing
from headbench.datasets.drive.transfer import resampled
from headbench.datasets.head.model import resting
from headbench.datasets.head.procedural.model import procedural_head

from ..head.toy import toy_head

HEAD = procedural_head("2023")
TOY = toy_head(24, version="flame2020")
SPEED = 0.1
"""Of jawOpen or the jaw's radians, per second."""


def csv(header, rows):
    return "a.csv", "\n".join([header, *rows]) + "\n"


def timecodes(frames, rate=60, lost=(), start=0):
    """Rows of Live Link Face at frames of its timecode; ``lost`` are numbers of rows without a face."""
    rows = []
    for number, frame in enumerate(frames):
        second, rest = divmod(frame + start, rate)
        hour, minute = divmod(int(second) // 60, 60)
        stamp = f"{hour % 24:02d}:{minute:02d}:{int(second) % 60:02d}:{rest:06.3f}"
        values = "" if number in lost else f",{SPEED * (frame - frames[0]) / rate:.9f},0.1"
        rows.append(f"{stamp},{0 if number in lost else 61}{values}")
    return csv("Timecode,BlendShapeCount,JawOpen,HeadYaw", rows)


def stamps(name, unit, seconds):
    return csv(f"{name},jawOpen", [f"{round(s / unit)},{SPEED * s}" for s in seconds])


def lines(frames):
    return "a.jsonl", "".join(json.dumps(frame) + "\n" for frame in frames)


def javascript(t, fps=30, lost=()):
    names = {"_neutral": 0.0, "jawOpen": SPEED * t / fps}
    scores = [{"index": 0, "score": v, "categoryName": n, "displayName": ""} for n, v in names.items()]
    faces = [] if t in lost else [{"categories": scores, "headIndex": -1, "headName": ""}]
    return {"faceLandmarks": [[{"x": 0.5}]], "faceBlendshapes": faces}


def python(t, fps=30):
    return {"face_blendshapes": [[{"category_name": "jawOpen", "score": SPEED * t / fps}]]}


def neurosync():
    """Frame numbers and milliseconds of the second, both rounded down."""
    rows = []
    for frame in range(150):
        part = frame / 60 % 1 * 1000
        rows.append(
            f"00:00:{frame // 60:02d}:{int(part / (1000 / 60)):02d}.{int(part):03d},{SPEED * frame / 60}"
        )
    return csv("Timecode,JawOpen", rows)


WEIGHTS = [[0.0, SPEED * t / 60] for t in range(9)]
NAMES = ["browInnerUp", "jawOpen"]
LAM = [{"weights": row, "time": t / 60, "rotation": []} for t, row in enumerate(WEIGHTS)]
SCREEN = 0.04 * np.arange(101) + 0.012 * (np.arange(101) % 2)
CLOCKS = [f"00:00:00.{40 * t:03d},{SPEED * t / 25}" for t in range(9)]
DATES = [
    f"2024-05-0{1 + t // 6}T{'00:00:00' if t > 5 else '23:59:59'}.{(760 + 40 * t) % 1000:03d}Z,{SPEED * t / 25}"
    for t in range(9)
]


def listed(lost=None, **keys):
    """An object of lists, in which frame 4 has ``lost`` if it is given, with more keys."""
    step = SPEED / next((float(np.ravel(v)[0]) for v in keys.values() if not isinstance(v, dict)), 60)
    jaw = [t * step if lost is None or t != 4 else lost for t in range(9)]
    return "a.json", json.dumps({"jawOpen": jaw, **keys})


FILES = {
    "Live Link Face, three rows without a face": (
        timecodes(range(0, 80, 2), lost=(12, 13, 14)),
        30,
        40,
        [(12, 14)],
    ),
    "Live Link Face, its ends without a face": (timecodes(range(70), lost=(68, 69)), 60, 70, [(68, 69)]),
    "a second missing": (timecodes([*range(0, 60, 2), *range(120, 180, 2)]), 30, 90, [(30, 59)]),
    "timecode at 25 in fractions": (timecodes(np.arange(40) + 0.652, 25), 25, 40, []),
    "timecode at 24": (timecodes(range(30), 24), 24, 30, []),
    "over midnight": (timecodes(range(90), 30, start=24 * 3600 * 30 - 40), 30, 90, []),
    "NeuroSync's rounded timecode": (neurosync(), 60, 150, []),
    "milliseconds": (stamps("timestampMs", 1e-3, np.arange(20) / 60), 60, 20, []),
    "microseconds": (stamps("timestamp", 1e-6, np.arange(20) / 30), 30, 20, []),
    "seconds": (csv("Time (s),jawOpen", [f"{t / 4},{SPEED * t / 4}" for t in range(9)]), 4, 9, []),
    "clock times": (csv("time,jawOpen", CLOCKS), 25, 9, []),
    "minutes and seconds": (csv("time,jawOpen", [row[3:] for row in CLOCKS]), 25, 9, []),
    "dates over midnight": (csv("time,jawOpen", DATES), 25, 9, []),
    "a time missing with the face": (
        csv("time,jawOpen", [*CLOCKS[:4], "nan,", *CLOCKS[5:]]),
        25,
        9,
        [(4, 4)],
    ),
    "the last time missing": (csv("time,jawOpen", [*CLOCKS[:8], "nan,"]), 25, 9, [(8, 8)]),
    "rate as text": (listed(frameRate="29.97"), 29.97, 9, []),
    "rate in meta": (listed(meta={"fps": 60}), 60, 9, []),
    "rate in capitals": (listed(FPS=60), 60, 9, []),
    "rate in a list": (listed(fps=[30]), 30, 9, []),
    "NaN": (listed(lost=math.nan, fps=50), 50, 9, [(4, 4)]),
    "frames that are null": (
        ("a.json", json.dumps([python(t, 25) if t != 3 else None for t in range(6)])),
        None,
        6,
        [(3, 3)],
    ),
    "lines that are null": (lines([python(t, 25) if t != 3 else None for t in range(6)]), None, 6, [(3, 3)]),
    "success in lower case": (
        csv(
            "success,jawOpen", [f"{str(t != 2).lower()},{SPEED * t / 25 if t != 2 else 9}" for t in range(6)]
        ),
        None,
        6,
        [(2, 2)],
    ),
    "pandas' index and a column index": (
        csv(",index,jawOpen", [f"{t},{t},{SPEED * t / 25}" for t in range(4)]),
        None,
        4,
        [],
    ),
    "irregular times": (stamps("time_ms", 1e-3, SCREEN), 25, 101, []),
    "frame numbers": (stamps("frame", 0.04, np.delete(np.arange(9) / 25, [4])), None, 9, [(4, 4)]),
    "every fifth frame": (stamps("frame_id", 0.008, np.arange(9) / 25), None, 9, []),
    "MediaPipe in JavaScript": (lines([javascript(t, 25, lost=(3,)) for t in range(8)]), None, 8, [(3, 3)]),
    "MediaPipe wrapped": (
        lines([{"faceLandmarkerResult": javascript(t, 25)} for t in range(4)]),
        None,
        4,
        [],
    ),
    "MediaPipe, an array": (("a.json", json.dumps([python(t, 25) for t in range(4)])), None, 4, []),
    "MediaPipe with its rate": (
        ("a.json", json.dumps({"fps": 30, "frames": [python(t) for t in range(4)]})),
        30,
        4,
        [],
    ),
    "an object of blendshapes": (
        lines(
            [{"time": t / 60, "blendshapes": {"jawOpen": SPEED * t / 60} if t != 3 else {}} for t in range(9)]
        ),
        60,
        9,
        [(3, 3)],
    ),
    "Audio2Face": (
        ("a.json", json.dumps({"exportFps": 60.0, "facsNames": NAMES, "weightMat": WEIGHTS})),
        60,
        9,
        [],
    ),
    "LAM": (("a.json", json.dumps({"names": NAMES, "frames": LAM})), 60, 9, []),
    "Audio2Face-3D": (
        csv(",timeCode,blendShapes.JawOpen", [f"{t},{t / 30},{SPEED * t / 30}" for t in range(9)]),
        30,
        9,
        [],
    ),
    "names of Face Cap": (csv("jawOpen,eyeBlink_L", [f"{SPEED * t / 25},0" for t in range(4)]), None, 4, []),
}


def read(tmp_path, file, target=HEAD, fps=None, **options):
    path = tmp_path / file[0]
    path.write_text(file[1])
    signal = read_signal(SignalRequest(path, target, **options))
    return signal, *resampled(path, signal.poses, signal.timing, fps or signal.timing.fps or 25)


@pytest.mark.parametrize("name", FILES)
def test_the_jaw_opens_at_the_rate_of_the_file(tmp_path, name):
    file, fps, count, lost = FILES[name]
    signal, poses, filled = read(tmp_path, file)
    assert (signal.timing.fps, len(poses)) == (fps, count)
    assert filled == lost
    ends = signal.timing.positions[-1]  # held from the last frame with a face
    wanted = JAW_OPEN * SPEED * np.minimum(np.arange(count), ends) / (fps or 25)
    np.testing.assert_allclose([pose.jaw[0] for pose in poses], wanted, atol=2e-4)


@pytest.mark.parametrize(("fps", "count"), [(25, 50), (60, 119), (90, 178)])
def test_a_signal_is_resampled_to_another_rate(tmp_path, fps, count):
    _, poses, filled = read(tmp_path, timecodes(range(0, 120, 2)), fps=fps)
    assert (len(poses), filled) == (count, [])
    wanted = JAW_OPEN * SPEED * np.arange(count) / fps
    np.testing.assert_allclose([pose.jaw[0] for pose in poses], wanted, atol=1e-6)


def folder_of(tmp_path, kind, names):
    """Folders of EMOCA or INFERNO, files of the same coefficients, or parameters of VHAP; the jaw follows the number."""
    for name in names:
        angle = np.array([SPEED * int(name.split("_")[0]) / 25, 0, 0])
        exp, still = np.zeros(4), np.zeros(3)
        if kind in ("emoca", "inferno"):
            poses = (
                {"jawpose": angle, "globalpose": still}
                if kind == "inferno"
                else {"pose": np.r_[still, angle]}
            )
            (tmp_path / name).mkdir(parents=True)
            for key, values in {"exp": exp, "shape": np.zeros(9), **poses}.items():
                np.save(tmp_path / name / f"{key}.npy", values)
        elif kind == "json":
            (tmp_path / f"{name}.json").write_text(json.dumps({"exp": exp.tolist(), "jaw": angle.tolist()}))
        else:
            parts = {"translation": still, "rotation": still, "neck_pose": still, "eyes_pose": np.zeros(6)}
            np.savez(tmp_path / f"{name}.npz", **parts, jaw_pose=angle, expr=exp, shape=np.zeros(6))
    return tmp_path


@pytest.mark.parametrize("kind", ["emoca", "inferno", "json", "vhap"])
def test_names_give_the_frame_and_the_face(tmp_path, kind):
    request = SignalRequest(tmp_path, TOY, signal_head="avatar")
    names = ["000000_000", "000001_000", "000002_001", "000005_000", "000010_000", "000011_000", "000012_000"]
    folder_of(tmp_path, kind, names)
    signal = read_signal(request)
    poses, filled = resampled(tmp_path, signal.poses, signal.timing, 25)
    assert filled == [(3, 4), (6, 9)]
    np.testing.assert_allclose([pose.jaw[0] for pose in poses], SPEED * np.arange(13) / 25, atol=1e-6)
    folder_of(tmp_path, kind, ["000005_001"])
    with pytest.raises(InputError, match="000005_000.* and 000005_001.* one face"):
        read_signal(request)


@pytest.mark.parametrize("extra", ["000002_1", "000002 (1)"])
def test_a_copy_of_a_frame_is_a_second_face(tmp_path, extra):
    folder_of(tmp_path, "json", ["000000", "000001", "000002"])
    (tmp_path / f"{extra}.json").write_text((tmp_path / "000002.json").read_text())
    with pytest.raises(InputError, match="000002.*json and 000002.*json; more than one of frames 2"):
        read_signal(SignalRequest(tmp_path, TOY, signal_head="avatar"))


def test_a_given_rate_replaces_times_that_give_none(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,frame,jawOpen\nnow,1,0\nthen,2,0\nlater,4,0\n")
    timing = read_signal(SignalRequest(path, HEAD, fps=60)).timing
    assert (timing.fps, timing.positions.tolist()) == (None, [0, 1, 3])


def test_frames_without_a_face_in_other_tables(tmp_path):
    """NaN in arrays, and OpenFace's column ``success``, whose rows have values."""
    jaw = np.zeros((5, 3))
    jaw[3] = np.nan
    expression = np.where(np.isnan(jaw[:, :1]), np.nan, np.ones((5, 4)))
    np.savez(tmp_path / "a.npz", expression=expression, jaw=jaw, fps=50)
    signal = read_signal(SignalRequest(tmp_path / "a.npz", TOY))
    assert (signal.timing.positions.tolist(), signal.timing.fps) == ([0, 1, 2, 4], 50)
    rows = [f"{t + 1}, 0, {t / 30:.3f}, {int(t != 2)}, {0 if t == 2 else SPEED * t / 30}" for t in range(5)]
    (tmp_path / "map.yaml").write_text("AU26_r: {jaw.0: 1}")
    table = csv("frame, face_id, timestamp, success, AU26_r", rows)
    _, poses, filled = read(tmp_path, table, TOY, map=str(tmp_path / "map.yaml"))
    assert filled == [(2, 2)]
    np.testing.assert_allclose([pose.jaw[0] for pose in poses], SPEED * np.arange(5) / 30, atol=1e-4)


REFUSED = {
    "mostly lost": (timecodes(range(40), lost=range(5, 30), start=30), "a face in half of its 40 frames"),
    "hours missing": (timecodes([*range(90), 1000]), "91; longest gap: 910 frames from frame 90"),
    "two faces of MediaPipe": (
        lines([{"face_blendshapes": 2 * python(1)["face_blendshapes"]}]),
        "one face a frame",
    ),
    "two rows of one frame": (
        csv("frame,face_id,jawOpen", ["1,0,0", "1,1,0", "2,0,0"]),
        "keep those of one face",
    ),
    "times that go back": (
        stamps("time", 1e-3, [0, 0.04, 0.08, 0.02, 0.06]),
        "time, line 5: expected a later",
    ),
    "once a second": (stamps("time", 1.0, range(9)), "time: expected times at 2 to 240 frames a second"),
    "words as times": (
        csv("time,jawOpen", ["now,0", "then,0"]),
        "found now, then. State the frame rate with --fps",
    ),
    "short timecode": (timecodes(range(9)), "timecodes of more than a second"),
    "true as rate": (listed(fps=True), "fps: expected frames per second, from 1 to 1000"),
    "a rate too high": (listed(fps=30000), "found 30000"),
    "semicolons": (
        csv("jawOpen;jawLeft", ["0;0"]),
        "header: expected distinct names of columns, separated by commas",
    ),
    "tabs": (csv("jawOpen\tjawLeft", ["0\t0"]), "separated by commas"),
    "a comma at the end": (csv("jawOpen,", ["0,"]), "separated by commas, found column 2 without a name"),
    "Excel's separator": (csv("sep=,", ["jawOpen,jawLeft", "0,0"]), "separated by commas, found 'sep='"),
    "pandas' JSON by column": (("a.json", '{"jawOpen": {"0": 0, "1": 0}}'), 'to_json(orient="records")'),
    "a name more than Audio2Face's weights": (
        ("a.json", json.dumps({"facsNames": [*NAMES, "jawLeft"], "weightMat": WEIGHTS})),
        "weightMat[0]: expected 3 values a row, as there are names, found 2",
    ),
    "a name more than LAM's weights": (
        ("a.json", json.dumps({"names": [*NAMES, "jawLeft"], "frames": LAM})),
        "frames[0], weights: expected 3 values a row, as there are names, found 2",
    ),
    "a list of lists": (("a.json", "[[1]]"), "a.json, [0]: expected an object"),
    "coefficients in a pickle": (("a.pkl", ""), "found a file in .pkl. Save the signal as npz or CSV."),
    "half a face": (csv("jawOpen,jawLeft", ["0,0", "0,"]), "jawLeft, line 3: expected a number"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_signals_without_one_performance_are_refused(tmp_path, name):
    file, said = REFUSED[name]
    with pytest.raises(InputError) as caught:
        read(tmp_path, file)
    assert said in str(caught.value)


def test_head_rotations_take_the_shortest_path(tmp_path):
    """Across 180 degrees, where rotation vectors change their sign."""
    angles = np.array([3.0, 2 * np.pi - 3.0])
    poses = [replace(resting(TOY), rotation=np.array([a, 0, 0])) for a in (angles[0], angles[1] - 2 * np.pi)]
    found, _ = resampled(tmp_path, poses, Timing.regular(2, 25.0), 75)
    turned = np.mod([pose.rotation[0] for pose in found], 2 * np.pi)
    np.testing.assert_allclose(turned, np.linspace(*angles, 4), atol=1e-9)
