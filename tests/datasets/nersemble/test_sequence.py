"""A sequence's frames: which are chosen, how they stream, and every fault found before or while decoding."""

import struct

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.datasets.nersemble import sequence as sequence_module
from headbench.datasets.nersemble.prepare import read_frames
from headbench.datasets.nersemble.recording import participant, read_calibration
from headbench.datasets.nersemble.sequence import check_boxes, probe_video, read_sequence

from .recordings import (
    HEIGHT,
    SEQUENCES,
    SUBJECT,
    WIDTH,
    colour_of,
    mask,
    world_cameras,
    write_recording,
    write_video,
)

SERIALS = [camera.id for camera in world_cameras()]


def look(recording, name="FREE", **settings):
    one = participant(recording.root, SUBJECT)
    return read_sequence(one, read_calibration(one.calibration_file), name, **settings)


def fault(recording, **settings) -> InputError:
    with pytest.raises(InputError) as error:
        look(recording, **settings)
    return error.value


def check_streams(sequence, *, tolerance=4):
    """Every frame shows the colour of its camera and its number."""
    for index, serial in enumerate(sequence.views):
        frames = [*read_frames(sequence.views[serial], sequence.numbers)]
        assert [frame.number for frame in frames] == [*sequence.numbers]
        for frame in frames:
            middle = frame.bgr[HEIGHT // 2, WIDTH // 2, ::-1].astype(int)
            assert np.abs(middle - colour_of(index, frame.number)).max() <= tolerance


@pytest.mark.parametrize(
    ("release", "images"), [("v2", True), ("v1", True), ("paper2023", True), ("v2", False), ("v1", False)]
)
def test_frames_are_those_asked_for(release, images, tmp_path):
    recording = write_recording(tmp_path, release=release, images=images)
    for every in (1, 2, 3):
        sequence = look(recording, every=every)
        assert sequence.numbers == tuple(range(0, SEQUENCES["FREE"], every))
        assert sequence.has_masks == images
        check_streams(sequence, tolerance=4 if images else 6)
    if images:
        frame = next(iter(read_frames(sequence.views[SERIALS[0]], [0])))
        assert np.abs(frame.mask.astype(int) - mask()).max() <= 3


def test_by_default_videos_give_every_third_frame_and_images_all(pristine_videos, pristine_recording):
    assert look(pristine_videos).numbers == (0, 3)
    assert look(pristine_recording).numbers == tuple(range(6))


def test_images_with_masks_go_before_videos(recording):
    for index, serial in enumerate(SERIALS):
        frames = (np.full((HEIGHT, WIDTH, 3), colour_of(index, n), np.uint8) for n in range(12))
        recording.write_video("FREE", serial, frames)
    assert look(recording).views[SERIALS[0]].video is None
    assert look(recording, source="video", every=1).numbers == tuple(range(12))
    for path in recording.root.rglob("alpha_maps/*"):
        path.unlink()
    assert look(recording).views[SERIALS[0]].video is not None
    assert look(recording, source="images").views[SERIALS[0]].video is None


def test_a_lone_camera_has_no_serial_in_its_files(recording):
    folder = recording.sequence_folder("FREE")
    for kind in ("images", "alpha_maps"):
        for path in (folder / kind).iterdir():
            _, serial, number = path.stem.split("_")
            path.rename(path.with_name(f"{number}.jpg")) if serial == SERIALS[1] else path.unlink()
    assert [*look(recording, cameras=[SERIALS[1]]).views] == [SERIALS[1]]
    with pytest.raises(InputError, match="Name the camera"):
        look(recording)


def test_missing_and_unknown_cameras_are_named(videos):
    with pytest.raises(InputError, match="camera 123"):
        look(videos, cameras=["123"])
    path = videos.sequence_folder("FREE") / "images" / f"cam_{SERIALS[2]}.mp4"
    path.rename(path.with_name("cam_123.mp4"))
    assert fault(videos).key == "123"
    path.with_name("cam_123.mp4").unlink()
    assert fault(videos).key == f"camera {SERIALS[2]}"
    assert [*look(videos, cameras=SERIALS[:2]).views] == SERIALS[:2]


def test_frame_counts_that_differ_are_an_error_or_cut(videos):
    frames = (np.zeros((HEIGHT, WIDTH, 3), np.uint8) for _ in range(4))
    videos.write_video("FREE", SERIALS[1], frames)
    error = fault(videos)
    assert (error.key, error.found) == ("frames", f"camera {SERIALS[1]} without 4-5")
    assert look(videos, cut=True, every=1).numbers == (0, 1, 2, 3)


def test_cameras_that_lack_other_frames_are_told_by_their_frames(recording):
    folder = recording.sequence_folder("FREE") / "images"
    for serial, number in zip(SERIALS, (2, 4, 4), strict=True):
        (folder / f"cam_{serial}_{number:06d}.jpg").unlink()
    first, second, third = SERIALS
    assert fault(recording).found == f"camera {first} without 2; cameras {second}, {third} without 4"
    assert look(recording, cut=True).numbers == (0, 1, 3, 5)
    (folder / f"cam_{third}_000005.jpg").unlink()
    lacking = zip(SERIALS, ("2", "4", "4-5"), strict=True)
    assert fault(recording).found == "; ".join(f"camera {one} without {lacks}" for one, lacks in lacking)


def test_truncated_videos_are_found_before_decoding(videos, monkeypatch):
    path = videos.sequence_folder("FREE") / "images" / f"cam_{SERIALS[1]}.mp4"
    content = path.read_bytes()
    monkeypatch.setattr(sequence_module, "open_video", None)  # so that opening it would be seen
    for damaged in (content[:-40], b"<html>not found</html>"):
        path.write_bytes(damaged)
        with pytest.raises(InputError) as error:
            probe_video(path)
        assert error.value.file == str(path)


@pytest.mark.parametrize("kind", ["alpha_maps", "images"])
@pytest.mark.parametrize("number", [0, 3])
def test_the_one_file_at_fault_is_blamed(kind, number, recording):
    path = recording.sequence_folder("FREE") / kind / f"cam_{SERIALS[0]}_{number:06d}.jpg"
    path.write_bytes(path.read_bytes()[:100])
    assert fault(recording).file == str(path)
    cv2.imwrite(str(path), np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8))
    error = fault(recording)
    assert (error.file, error.found) == (str(path), f"{WIDTH // 2}x{HEIGHT // 2}")
    assert f"{WIDTH}x{HEIGHT}" in error.expected
    path.unlink()
    if kind == "alpha_maps":
        assert fault(recording).file == str(path.parents[1] / "images" / path.name)


def test_an_image_damaged_in_the_middle_is_found_when_decoding(recording):
    path = recording.sequence_folder("FREE") / "images" / f"cam_{SERIALS[0]}_000003.jpg"
    content = path.read_bytes()
    header = content[: content.index(b"\xff\xdb")]
    frame = content[content.index(b"\xff\xc0") : content.index(b"\xff\xc0") + 19]
    path.write_bytes(header + frame + b"\xff\xd9")
    view = look(recording).views[SERIALS[0]]
    with pytest.raises(InputError) as error:
        [*read_frames(view, [3])]
    assert error.value.file == str(path)


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


FTYP, MOOV, MDAT = box(b"ftyp", b"isom"), box(b"moov", bytes(40)), box(b"mdat", bytes(100))


def test_whole_files_pass(tmp_path):
    path = tmp_path / "video.mp4"
    for mdat in (
        MDAT,
        struct.pack(">I4sQ", 1, b"mdat", 25) + bytes(9),
        struct.pack(">I4s", 0, b"mdat") + b"x",
    ):
        path.write_bytes(FTYP + MOOV + mdat)
        check_boxes(path)


@pytest.mark.parametrize("order", [FTYP + MDAT + MOOV, FTYP + MOOV + MDAT])
def test_every_truncation_is_found(order, tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(order)
    check_boxes(path)
    for length in range(len(order)):
        path.write_bytes(order[:length])
        with pytest.raises(InputError):
            check_boxes(path)


def test_a_rotation_that_a_video_asks_for_is_ignored(tmp_path):
    frame = np.zeros((32, 64, 3), np.uint8)
    frame[:8] = 255
    path, turned = tmp_path / "a.mp4", tmp_path / "turned.mp4"
    write_video(path, [frame] * 3, 25.0)
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    for rotation in ((-1, 0, 0, -1), (0, 1, -1, 0)):
        a, b, c, d = (65536 * number for number in rotation)
        content[matrix : matrix + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 2**30)
        turned.write_bytes(content)
        assert probe_video(turned) == probe_video(path)
        shown = []
        for file in (path, turned):
            capture = sequence_module.open_video(file)
            shown.append(capture.read()[1])
            capture.release()
        assert np.array_equal(*shown)
