"""INSTA's adapter: the video that its program reads, where that may lie, renders on black read back by key."""

import cv2
import numpy as np

from headbench.bench.io.documents import read_json
from headbench.datasets.head.model import PosedSubject, pose_in_head_frame
from headbench.datasets.monocular.insta import read_vertices
from headbench.methods.official.insta.method import HAIR, MOUTH, SKIN

from .helpers import pixels_of

NAME = "insta"


def test_equal_meshes_are_written_once(exported):
    work, images = exported
    (last,) = read_json(work.input / "transforms_test.json")["frames"]
    assert cv2.imread(str(work.input / last["file_path"]), -1).tolist() == [[[0, 0, 0, 0]]]
    frames = read_json(work.input / "transforms_train.json")["frames"]
    assert last["mesh_path"] == frames[0]["mesh_path"]
    timesteps = {images[f"input/{frame['file_path']}"].timestep for frame in frames}
    meshes = {(work.input / frame["mesh_path"]).resolve() for frame in frames}
    assert len(meshes) == len(timesteps) < len(frames)


def test_projections_are_those_of_the_clip(exported, official_clip):
    work, images = exported
    subject = PosedSubject.of(official_clip)
    for frame in read_json(work.input / "transforms_train.json")["frames"]:
        key = images[f"input/{frame['file_path']}"]
        camera, pose = official_clip.cameras[key.camera], official_clip.poses[key.timestep]
        mesh = read_vertices(work.input / frame["mesh_path"], len(official_clip.head.template))
        still = subject.meshes([pose_in_head_frame(pose)])[0]
        assert np.abs(mesh - still).max() < 1e-7
        motion = subject.motions([pose])[0]
        pixels = pixels_of(still @ motion[:3, :3].T + motion[:3, 3], camera)
        there = np.linalg.inv(frame["transform_matrix"])
        seen = mesh @ there[:3, :3].T + there[:3, 3]
        focal, center = np.array([frame["fl_x"], frame["fl_y"]]), np.array([frame["cx"], frame["cy"]])
        assert np.abs(focal * seen[:, :2] / seen[:, 2:] + center - pixels).max() < 1e-3
        assert (frame["w"], frame["h"]) == (camera.width, camera.height)
        values = np.loadtxt(work.input / frame["exp_path"])
        assert np.abs(values[:8] - pose.expression).max() < 1e-7
        assert not values[8:].any()


def test_depth_and_classes_are_those_of_the_mesh(exported, official_clip):
    work, images = exported
    for frame in read_json(work.input / "transforms_train.json")["frames"]:
        mask = official_clip.masks[images[f"input/{frame['file_path']}"]]
        depth = cv2.imread(str(work.input / frame["depth_path"]), cv2.IMREAD_UNCHANGED)
        classes = cv2.imread(str(work.input / frame["seg_mask_path"]), cv2.IMREAD_UNCHANGED)[..., 2]
        assert depth.dtype == np.uint16
        assert not depth[mask == 0].any()
        assert not classes[mask == 0].any()
        assert set(np.unique(classes)) <= {0, SKIN, MOUTH, HAIR}
        mesh = read_vertices(work.input / frame["mesh_path"], len(official_clip.head.template))
        there = np.linalg.inv(frame["transform_matrix"])
        far = (mesh @ there[:3, :3].T + there[:3, 3])[:, 2]
        known = depth[depth > 0] / 1000
        assert len(known)
        assert far.min() - 1e-3 < known.min()
        assert known.max() < far.max() + 1e-3
        # A vertex that no other is in front of lies where the depth of its pixel says.
        focal, center = np.array([frame["fl_x"], frame["fl_y"]]), np.array([frame["cx"], frame["cy"]])
        nearest = (mesh @ there[:3, :3].T + there[:3, 3])[far.argmin()]
        column, row = (focal * nearest[:2] / nearest[2] + center).astype(int)
        if mask[row, column]:
            assert abs(depth[row, column] / 1000 - nearest[2]) < 0.01
