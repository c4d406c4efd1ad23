"""Files of INSTA's and IMavatar's layouts, written from one camera of a capture by the formulae of their own scripts."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import Camera, HeadPose
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.arrays import HeadArrays, save_head
from headbench.datasets.head.model import PosedSubject

from ..tiny_capture import FRONTAL, make_plan, rig, write_tiny_capture

HEAD_FILE = "head_model.npz"


class Recording:
    """One camera of a clip, as a video: what a tracker of single videos would see and find.

    Parameters
    ----------
    clip : whose poses have no neck rotation, which these trackers do not know.
    camera : id.
    head : the model that meshes are made with; None takes the clip's.
    """

    def __init__(self, clip, camera: str, head: HeadArrays | None = None):
        self.clip, self.camera = clip, clip.cameras[camera]
        self.head = head or clip.head
        vertices = len(self.head.template)
        self.subject = PosedSubject(self.head, clip.shape, clip.static_offset[:vertices])
        self.keys = sorted((key for key in clip.files if key.camera == camera), key=lambda key: key.timestep)

    def pose(self, key) -> HeadPose:
        return self.clip.poses[key.timestep]

    def rgba(self, key) -> np.ndarray:
        """BGRA with straight alpha, as OpenCV writes it."""
        image, mask = self.clip.image(key)[..., ::-1], self.clip.mask(key)
        share = np.maximum(mask[..., None] / 255, 1e-6)
        straight = (image - (1 - share) * 255 * self.clip.background[::-1]) / share
        return np.dstack([np.clip(np.round(straight), 0, 255).astype(np.uint8), mask])


def recording_of(
    folder: Path,
    lengths: dict[str, int],
    *,
    neck: bool = False,
    cameras: Sequence[Camera] | None = None,
    **changes,
) -> Recording:
    """The frontal camera of a capture without excluded frames, whose necks rest unless they may turn."""
    plan = make_plan(cameras=[*(cameras or rig()[:2])], lengths=lengths, **changes)
    rest = {} if neck else {"neck": np.zeros(3, np.float32)}
    sequences = [
        replace(sequence, poses=[replace(pose, **rest) for pose in sequence.poses], excluded={})
        for sequence in plan.sequences
    ]
    still = replace(plan, sequences=sequences, static_offset=np.zeros_like(plan.static_offset))
    # The files' meshes have no teeth, which readers add to FLAME's.
    return Recording(read_capture(write_tiny_capture(folder, still).union), FRONTAL, plan.head)


def write_insta(
    recording: Recording, folder: Path, *, test: int = 0, parameters: Sequence[str] = ("exp", "eyes", "jaw")
) -> Path:
    """INSTA's folder as ``generate.sh`` leaves it, ``test`` frames in a JSON of their own; today's writes "exp" alone."""
    for name in ("images", "meshes", *(f"flame/{name}" for name in parameters)):
        (folder / name).mkdir(parents=True)
    head, subject, camera = recording.head, recording.subject, recording.camera
    save_head(folder / HEAD_FILE, head)
    rest = np.zeros(3)
    still = HeadPose(head.version, np.zeros(head.expression_basis.shape[2]), *[rest] * 3, np.zeros(6), rest)
    opened = replace(still, jaw=np.array([np.radians(12), 0, 0]))
    write_obj(folder / "canonical.obj", subject.meshes([opened])[0], head.faces[::2])
    frames = []
    for number, key in enumerate(recording.keys, start=1):
        name, pose = f"{number:05d}", recording.pose(key)
        assert not np.any(pose.neck)
        motion = subject.motions([pose])[0]
        local = replace(pose, rotation=rest, translation=rest)
        cv2.imwrite(str(folder / f"images/{name}.png"), recording.rgba(key))
        write_obj(folder / f"meshes/{name}.obj", subject.meshes([local])[0], head.faces[::2])
        values = {"exp": pose.expression, "jaw": six_numbers(pose.jaw), "eyes": six_numbers(pose.eyes)}
        for part in parameters:
            np.savetxt(folder / f"flame/{part}/{name}.txt", values[part], fmt="%.8f")
        frames.append(
            {
                "transform_matrix": np.linalg.inv(camera.world_to_camera @ motion).tolist(),
                "file_path": f"images/{name}.png",
                "mesh_path": f"meshes/{name}.obj",
                "exp_path": f"flame/exp/{name}.txt",
                "depth_path": f"depth/{name}.png",
                "seg_mask_path": f"seg_mask/{name}.png",
            }
        )
    width, height, K = camera.width, camera.height, camera.K
    angles = [2 * np.arctan(size / (2 * focal)) for size, focal in ((width, K[0, 0]), (height, K[1, 1]))]
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
    values = [float(width), float(height), K[0, 0], K[1, 1], *K[:2, 2], *angles, *np.degrees(angles)]
    document = dict(zip(names, values)) | {"integer_depth_scale": 0.001}
    parts = {"": frames}
    if test:
        parts |= {"_train": frames[:-test], "_test": frames[-test:], "_val": frames[-2:]}
    for part, shown in parts.items():
        text = json.dumps(document | {"frames": shown}, indent=4, sort_keys=True)
        (folder / f"transforms{part}.json").write_text(text)
    return folder


def write_imavatar(recording: Recording, folder: Path, videos: Sequence[str] = ("MVI_1810",)) -> Path:
    """A subject in IMavatar's layout, its frames shared out over ``videos`` in order."""
    (folder).mkdir(parents=True)
    save_head(folder / HEAD_FILE, recording.head)
    camera, flip = recording.camera, np.diag([1.0, -1.0, -1.0])
    room = np.random.default_rng(0).integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
    size = np.array([camera.width, camera.height] * 2)
    focal_and_centre = np.array([-camera.K[0, 0], camera.K[1, 1], *(camera.K[:2, 2] - 0.5)]) / size
    for video, keys in zip(videos, np.array_split(np.arange(len(recording.keys)), len(videos))):
        for name in ("image", "mask"):
            (folder / video / name).mkdir(parents=True)
        frames = []
        for number, key in enumerate((recording.keys[index] for index in keys), start=1):
            pose, rotation = recording.pose(key), camera.world_to_camera[:3, :3]
            shift = rotation @ pose.translation + camera.world_to_camera[:3, 3]
            rgba = recording.rgba(key)
            share = rgba[..., 3:] / 255
            shown = np.round(share * rgba[..., :3] + (1 - share) * room).astype(np.uint8)
            cv2.imwrite(str(folder / video / f"image/{number}.png"), shown)
            cv2.imwrite(str(folder / video / f"mask/{number}.png"), rgba[..., 3])
            turns = [pose.rotation, pose.neck, pose.jaw, pose.eyes]
            frames.append(
                {
                    "file_path": f"./image/{number}",
                    "world_mat": (flip @ np.column_stack([rotation, 4 * shift])).tolist(),
                    "expression": np.asarray(pose.expression, float).tolist(),
                    "pose": np.concatenate(turns).astype(float).tolist(),
                    "bbox": [-0.5, -0.5, 0.5, 0.5],
                    "flame_keypoints": [],
                }
            )
        document = {
            "frames": frames[::-1],  # order means nothing
            "intrinsics": focal_and_centre.tolist(),
            "shape_params": recording.clip.shape.astype(float).tolist(),
        }
        (folder / video / "flame_params.json").write_text(json.dumps(document))
    return folder


def six_numbers(turns: np.ndarray) -> np.ndarray:
    """The first two rows of each rotation's matrix."""
    matrices = Rotation.from_rotvec(np.reshape(turns, (-1, 3))).as_matrix()
    return matrices[:, :2].ravel()


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path.write_text("\n".join(["# a comment", *lines]) + "\n")
