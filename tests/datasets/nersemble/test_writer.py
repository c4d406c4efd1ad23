"""Synthetic recordings: their keys, their marker, their videos."""

import json

import cv2
import numpy as np
import pytest

from headbench.bench.errors import InputError
from headbench.bench.io.video import video_codec, write_video
from headbench.datasets.nersemble.re_record import RecordingWriter, write_tracked

from ..head.toy import toy_head
from .recordings import HEIGHT, SUBJECT, WIDTH, tracked_arrays, world_cameras


def test_the_calibration_has_the_real_keys_and_order(tmp_path):
    cameras = world_cameras()
    writer = RecordingWriter(tmp_path, SUBJECT, cameras)
    writer.write_calibration()
    value = json.loads(writer.calibration_file.read_text())
    assert [*value] == ["world_2_cam", "intrinsics", "height", "width"]
    assert [*value["world_2_cam"]] == [camera.id for camera in cameras]
    assert np.shape(value["intrinsics"]) == (3, 3)
    assert (value["height"], value["width"]) == (HEIGHT, WIDTH)
    assert "No person" in (tmp_path / "SYNTHETIC.txt").read_text()


def test_full_frames_need_no_size_and_intrinsics_may_differ(tmp_path):
    cameras = world_cameras(2200, 3208)
    RecordingWriter(tmp_path / "a", SUBJECT, cameras).write_calibration()
    value = json.loads((tmp_path / "a" / SUBJECT / "calibration" / "camera_params.json").read_text())
    assert [*value] == ["world_2_cam", "intrinsics"]
    cameras[1].K[0, 0] += 1
    cameras[1] = type(cameras[1])(cameras[1].id, 2200, 3208, cameras[1].K.copy(), cameras[1].world_to_camera)
    RecordingWriter(tmp_path / "b", SUBJECT, cameras).write_calibration()
    value = json.loads((tmp_path / "b" / SUBJECT / "calibration" / "camera_params.json").read_text())
    assert [*value["intrinsics"]] == [camera.id for camera in cameras]


@pytest.mark.parametrize("subject", ["074", "9", "90a"])
def test_synthetic_people_cannot_take_real_numbers(subject, tmp_path):
    with pytest.raises(InputError):
        RecordingWriter(tmp_path, subject, world_cameras())


def test_videos_run_at_73_frames_per_second(tmp_path):
    path = tmp_path / "cam_1.mp4"
    codec = write_video(path, (np.full((32, 48, 3), 20 * n, np.uint8) for n in range(7)), 73.0)
    assert codec == video_codec()
    assert codec in ("avc1", "mp4v")
    capture = cv2.VideoCapture(str(path))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(73)
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 7
    capture.release()
    assert [entry.name for entry in tmp_path.iterdir()] == ["cam_1.mp4"]


def test_videos_of_odd_sizes_or_without_frames_are_refused(tmp_path):
    with pytest.raises(InputError, match="even"):
        write_video(tmp_path / "a.mp4", [np.zeros((33, 48, 3), np.uint8)], 25.0)
    with pytest.raises(InputError, match="none"):
        write_video(tmp_path / "a.mp4", [], 25.0)
    assert [*tmp_path.iterdir()] == []


def test_tracked_parameters_have_vhaps_keys(tmp_path):
    head = toy_head(16)
    write_tracked(tmp_path / "t.npz", tracked_arrays(head, 4), range(4))
    with np.load(tmp_path / "t.npz", allow_pickle=False) as archive:
        vhap = {"rotation", "translation", "neck_pose", "jaw_pose", "eyes_pose", "shape", "expr"}
        assert set(archive.files) == vhap | {"static_offset", "timestep_id", "n_processed_frames"}
        assert archive["rotation"].dtype == np.float32
        assert archive["timestep_id"].tolist() == ["000000", "000001", "000002", "000003"]
