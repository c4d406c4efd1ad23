"""``headbench track`` on a video file, with a network that knows the landmarks of every picture."""

import hashlib
import json
import shutil
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from headbench.bench.contracts import Camera
from headbench.bench.errors import InputError, UnavailableError
from headbench.bench.io.videos import video_frames
from headbench.bench.landmark_network import COUNT
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.ga.writer import CaptureWriter
from headbench.datasets.head.procedural.model import procedural_head
from headbench.datasets.images import write_image
from headbench.datasets.mesh_pictures import draw_mesh, rasterize_mesh
from headbench.datasets.tracking import command as tracking_command
from headbench.datasets.tracking import fit, focal, landmarks, track
from headbench.datasets.tracking.command import track_capture
from headbench.datasets.tracking.focal import FocalLength, estimate_focal
from headbench.datasets.tracking.landmarks import ImageLandmarks, spread_vertices
from headbench.datasets.tracking.settings import WORK, TrackSettings, make_work_folder
from headbench.datasets.video import clip as video_clip
from headbench.datasets.video import command, faces
from headbench.datasets.video.faces import Crop, FoundFaces, crop_around

from ..tiny_capture import look_at, make_plan, posed_vertices

pytestmark = pytest.mark.commands

HEIGHT, WIDTH, COUNTED = 96, 72, 12
FACELESS = 5


def digest(image):
    return hashlib.sha1(np.ascontiguousarray(image).tobytes()).hexdigest()


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A video of one camera, a capture of another subject, and the landmarks of all their pictures by their bytes."""
    root = tmp_path_factory.mktemp("filmed")
    head = procedural_head("2023")
    camera = look_at("0", np.array([0.0, 0.1, 1.0]), WIDTH, HEIGHT, WIDTH / 2, HEIGHT / 2)
    offset = np.zeros(head.template.shape, np.float32)
    lengths = {"FREE": 3, "EMO-1-shout+laugh": COUNTED}
    person, other = (
        make_plan(
            head=head,
            cameras=[camera],
            lengths=lengths,
            static_offset=offset,
            seed=seed,
            novel_view_cameras=(),
        )
        for seed in (0, 1)
    )
    places = 150 * np.asarray(head.template)
    colors = 0.5 + 0.4 * np.sin(places @ np.array([[1, 0.3, 0.5], [0.2, 1, 0.6], [0.4, 0.5, 1]]))
    marks = np.asarray(head.regions["face"])[
        spread_vertices(np.asarray(head.template)[head.regions["face"]], 200)
    ]
    marks = np.resize(marks, COUNT)
    known = {}

    def picture(plan, pose):
        mesh = posed_vertices(plan, pose)
        image = draw_mesh(mesh, head.faces, camera, colors, shading=0.0, background=(0.4, 0.5, 0.4))
        seen = (mesh[marks] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]) @ camera.K.T
        mask = np.where(rasterize_mesh(mesh, head.faces, camera).face >= 0, 255, 0).astype(np.uint8)
        return image, mask, seen[:, :2] / seen[:, 2:]

    writer = CaptureWriter(root / "other", other)
    for sequence in other.sequences:
        for timestep, pose in enumerate(sequence.poses):
            image, mask, found = picture(other, pose)
            writer.write_frame(sequence.name, timestep, camera.id, image, mask)
            known[digest(image)] = found
    writer.write_metadata()
    poses = person.sequences[1].poses
    with av.open(str(root / "me.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(25), options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv444p"
        for pose in poses:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(person, pose)[0], "rgb24")))
        container.mux(stream.encode())
    (root / "masks").mkdir()
    for (number, _, frame), pose in zip(video_frames(root / "me.mp4"), poses, strict=True):
        _, mask, found = picture(person, pose)
        shown = np.where(mask[..., None] > 0, frame, 255).astype(np.uint8)
        known[digest(frame)] = known[digest(shown)] = None if number == FACELESS else found
        name = f"{number:05d}.png" if number % 2 else f"{number:04d}.png"  # RobustVideoMatting's
        write_image(root / "masks" / name, mask)
    np.savez(root / "landmarks.npz")  # in place of the network's file
    return root, writer.union, known, camera, person


@pytest.fixture
def settings(filmed, monkeypatch, tmp_path):
    """Settings of the video, and a network that knows the landmarks."""
    root, other, known, camera, _ = filmed

    class Network:
        def __init__(self, path):
            self.network, self.digest = self, "digest"

        def find(self, image, near=None):
            return known[digest(image)]

        def follow(self, image, near):
            return self.find(image)

        def find_all(self, image):
            return [] if self.find(image) is None else [self.find(image)]

    monkeypatch.setattr(fit, "LEVELS", fit.LEVELS[:1])  # landmarks alone are exact here
    monkeypatch.setattr(fit, "COARSE", 0)
    monkeypatch.setattr(fit, "LAST", fit.LEVELS[0])
    monkeypatch.setattr(focal, "TRIED", focal.TRIED[1:6:2])
    monkeypatch.setattr(tracking_command, "interpreter_class", lambda: None)
    monkeypatch.setattr(command, "FaceFinder", Network)
    monkeypatch.setattr(video_clip, "crop_around", lambda faces, width, height: Crop(0, 0, width, height))
    given = {
        "head": "2023",
        "landmarks": str(root / "landmarks.npz"),
        "embedding": str(other),
        "focal": float(camera.K[0, 0]),
    }

    def make(**changes):
        out = tmp_path / "out"
        return TrackSettings(str(root / "me.mp4"), str(out), **(given | {"masks": "none"} | changes))

    return make


def test_a_video_becomes_a_capture_of_its_frames(settings, filmed, monkeypatch):
    monkeypatch.setattr(faces, "SAME", 0.0)  # any movement is another place
    found = track_capture(settings(masks=str(filmed[0] / "masks")))
    clip = read_capture(found.data["capture"])
    numbers = [number for number in range(COUNTED) if number != FACELESS]
    assert len(clip.files) == len(numbers)
    assert found.data["video"]["without_face"] == [FACELESS]
    assert found.data["video"]["frames_used"] == numbers
    again = found.data["video"]["found_again"]
    assert [one["number"] for one in again] == numbers[1:]
    assert all(0 <= one["jump"] < 0.5 for one in again)
    assert f"left out   1 frame ({FACELESS}), where the person's face is missing" in found.text
    assert f"found again at another place in {len(again)} frames ({numbers[1]}, " in found.text
    assert clip.splits["self_reenactment"]
    assert found.data["landmarks_px"] < 2.0
    out = Path(settings().out)
    assert not (out / WORK).exists()
    assert json.loads((out / "track.json").read_text())["video"]["focal"]["source"] == "given"
    mask = clip.mask(min(clip.files))
    assert (clip.image(min(clip.files))[mask == 0] == 255).all()
    assert 0.2 < (mask > 0).mean() < 0.8


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"masks": ""}, "fetch-networks"),
        ({"segmentation": "a.tflite"}, "found both"),
        ({"head": "2020"}, "head_model"),
        ({"masks": "nowhere"}, "nowhere"),
        ({"longest": 3}, "me.mp4, frames: expected at least 4 with a face, to hold out 1, found 3"),
        (
            {"held_out_frames": 11},
            "me.mp4, frames: expected at least 12 with a face, to hold out 11, found 11",
        ),
    ],
)
def test_what_is_missing_is_said(settings, changes, named):
    with pytest.raises(InputError, match=named):
        track_capture(settings(**changes))


def test_too_few_frames_are_refused_before_any_face(settings, monkeypatch):
    monkeypatch.setattr(command.FaceFinder, "find_all", None)
    make_work_folder(Path(settings().out, WORK))  # of an interrupted call
    with pytest.raises(InputError, match="me.mp4, frames: expected at least 1000 .* found 12"):
        track_capture(settings(held_out_frames=999))
    assert [*Path(settings().out, WORK).iterdir()]


def test_a_missing_package_is_said_before_the_video(settings, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    monkeypatch.setattr(command, "video_to_track", None)
    with pytest.raises(UnavailableError, match="ai-edge-litert"):
        track_capture(settings())


def test_a_face_unlike_the_head_model_is_refused(settings, monkeypatch):
    monkeypatch.setattr(landmarks, "MOST_MISFIT", 0.0)  # as for a drawn face
    with pytest.raises(InputError, match="fit the head model in at least 50%.*it in 0 of 11"):
        track_capture(settings(focal=None))


class Stopped(Exception):
    """In place of a kill."""


WORKING = {
    "follow": lambda: command.FaceFinder,
    "find_all": lambda: command.FaceFinder,
    "write_image": lambda: video_clip,
    "estimate_focal": lambda: command,
    "fit_colours": lambda: track.Fitter,
    "write_json": lambda: tracking_command,
}
"""What takes long, by its owner."""


def finished_calls(monkeypatch, given, stop="", after=0):
    """How often each function of `WORKING` returned, and the result; one of them is stopped after some calls."""
    counts = dict.fromkeys(WORKING, 0)

    def counted(name, function):
        def call(*given, **named):
            if (name, counts[name]) == (stop, after):
                raise Stopped
            result = function(*given, **named)
            counts[name] += 1
            return result

        return call

    with monkeypatch.context() as patch:
        for name, owner in WORKING.items():
            patch.setattr(owner(), name, counted(name, getattr(owner(), name)))
        try:
            result = track_capture(given).data
        except Stopped:
            result = None
    return np.array([*counts.values()]), result


def test_labels_are_read_before_the_fit(settings, monkeypatch):
    def fit_landmarks(*given, **named):
        raise Stopped

    monkeypatch.setattr(track.Fitter, "fit_landmarks", fit_landmarks)
    with pytest.raises(InputError, match="no-labels/00000.png"):
        track_capture(settings(parsing="no-labels"))


STOPS = [("follow", 4), ("write_image", 9), ("fit_colours", 2), ("write_json", 0)]


@pytest.mark.commands
def test_a_call_that_is_interrupted_repeatedly_is_continued(settings, filmed, monkeypatch, tmp_path):
    monkeypatch.setattr(track, "MOST_TIMESTEPS", 4)  # three parts
    changes = {"masks": str(filmed[0] / "masks"), "focal": None}
    wanted, whole = finished_calls(monkeypatch, replace(settings(**changes), out=str(tmp_path / "whole")))
    counts = np.zeros(len(WORKING), int)
    for stop in STOPS:
        done, stopped = finished_calls(monkeypatch, settings(**changes), *stop)
        assert stopped is None
        counts += done
    done, again = finished_calls(monkeypatch, settings(**changes))
    assert (counts + done).tolist() == wanted.tolist()
    for result in (whole, again):
        for key in ("seconds", "seconds_per_timestep", "capture"):
            del result[key]
    assert again == whole
    files = {
        path.relative_to(tmp_path / "whole") for path in (tmp_path / "whole").rglob("*") if path.is_file()
    }
    assert len(files) > 2 * COUNTED
    for file in files - {Path("track.json")}:
        assert (tmp_path / "out" / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    """The place for what a call leaves that is stopped before its last file, which the first test that needs it makes."""
    return tmp_path_factory.mktemp("left") / "out"


@pytest.mark.parametrize(("changed", "fitted"), [("focal", 3), ("code", 3), ("embedding", 0)])
def test_what_another_call_left_is_used_where_it_fits(settings, monkeypatch, left, changed, fitted):
    if not left.exists():
        assert finished_calls(monkeypatch, replace(settings(), out=str(left)), "write_json", 0)[1] is None
    shutil.copytree(left, settings().out)
    length = settings().focal * (1.01 if changed == "focal" else 1)
    if changed == "code":
        for module in (track, video_clip, command):
            monkeypatch.setattr(module, "TRACKER_VERSION", "another")
    if changed == "embedding":  # of vertices that there are not
        path = Path(settings().out) / WORK / "embedding.npz"
        content = dict(np.load(path))
        np.savez(path, **(content | {"corners": content["corners"] + 10**6}))
    done, result = finished_calls(monkeypatch, settings(focal=length))
    counts = dict(zip(WORKING, done.tolist()))
    assert counts["fit_colours"] == fitted
    assert (counts["write_image"] > 0) == (counts["follow"] > 0) == (changed == "code")
    (camera,) = read_capture(result["capture"]).cameras.values()
    assert camera.K[0, 0] == pytest.approx(length, rel=1e-5)


def test_a_crop_holds_every_face_and_moves_the_camera():
    pixels = np.full((3, COUNT, 2), np.nan)
    rng = np.random.default_rng(0)
    for row, middle in ((0, (200, 150)), (2, (230, 160))):
        pixels[row] = middle + 30 * rng.uniform(-1, 1, (COUNT, 2))
    crop = crop_around(FoundFaces(np.arange(3), pixels, np.zeros(3, int)), 640, 300)
    low, high = np.nanmin(pixels, axis=(0, 1)), np.nanmax(pixels, axis=(0, 1))
    assert crop.left <= low[0] - 40
    assert crop.top <= low[1] - 50
    assert crop.left + crop.width >= high[0] + 40
    assert crop.top + crop.height <= 300
    image = np.arange(640 * 300).reshape(300, 640)
    assert crop.of(image)[0, 0] == image[crop.top, crop.left]


@pytest.mark.parametrize(("clear", "source"), [(True, "estimated"), (False, "assumed")])
def test_a_focal_length_that_is_not_clear_is_said(settings, monkeypatch, clear, source):
    found = FocalLength(300.0, np.array([2.0, 1.0, 2.0] if clear else [1.0, 1.0, 1.0]))
    monkeypatch.setattr(command, "estimate_focal", lambda *given: found)
    result = track_capture(settings(focal=None))
    assert result.data["video"]["focal"]["pixels"] == 300.0
    assert f"300 pixels of the video, {source}" in result.text
    (camera,) = read_capture(result.data["capture"]).cameras.values()
    assert camera.K[0, 0] == pytest.approx(300.0, rel=1e-5)


def estimated_focal(plan, wanted, yaws, error_mm=0.0):
    """The estimate by landmarks of frames with these rotations, of which each is displaced by an error that stays."""
    K = np.array([[wanted, 0, WIDTH / 2], [0, wanted, HEIGHT / 2], [0, 0, 1.0]])
    distance = wanted * 0.3 / HEIGHT  # at which the head fills the picture
    motion = look_at("0", np.array([0.0, 0.05, distance]), WIDTH, HEIGHT, 0.0, 0.0).world_to_camera
    vertices = np.asarray(plan.head.regions["face"])
    vertices = vertices[spread_vertices(np.asarray(plan.head.template)[vertices], 80)]
    pixels = []
    error = error_mm * 1e-3 * wanted / distance * np.random.default_rng(3).standard_normal((len(vertices), 2))
    for pose, yaw in zip(plan.sequences[1].poses, yaws):
        pose = replace(pose, rotation=np.array([0.0, yaw, 0.0]))
        seen = (posed_vertices(plan, pose)[vertices] @ motion[:3, :3].T + motion[:3, 3]) @ K.T
        pixels.append(seen[:, :2] / seen[:, 2:] + error)
    corners = np.repeat(vertices[:, None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(vertices), 1))
    return estimate_focal(
        plan.head,
        Camera("0", WIDTH, HEIGHT, K * [[2, 1, 1], [1, 2, 1], [1, 1, 1]], motion),
        ImageLandmarks(corners, weights, np.stack(pixels)[:, None], np.zeros((0, 2), int)),
        HEIGHT,
    ).pixels


@pytest.mark.parametrize("ratio", [1.2, 2.6])
def test_the_focal_length_of_exact_landmarks_is_found(filmed, ratio):
    found = estimated_focal(filmed[-1], ratio * HEIGHT, np.linspace(-0.5, 0.5, 6))
    assert found == pytest.approx(ratio * HEIGHT, rel=0.15)


@pytest.mark.parametrize("ratio", [1.2, 5.0])
def test_the_prior_decides_where_landmarks_hardly_do(filmed, ratio):
    found = estimated_focal(filmed[-1], ratio * HEIGHT, np.linspace(-0.02, 0.02, 6), error_mm=5.0)
    assert 1.7 < found / HEIGHT < 3.6  # a standard deviation around its median


def test_landmarks_unlike_a_head_have_no_focal_length(filmed, monkeypatch):
    monkeypatch.setattr(fit, "MISTAKEN_MM", 1e-6)
    with pytest.raises(InputError, match="some that fit the head model, found none"):
        estimated_focal(filmed[-1], 2.0 * HEIGHT, np.linspace(-0.5, 0.5, 6), error_mm=5.0)
