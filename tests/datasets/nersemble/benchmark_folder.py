"""The benchmark's folder in small: calibration and tracking of one participant, random but right."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from headbench.datasets.head.arrays import HeadArrays
from headbench.datasets.nersemble.benchmark.submission import MONO, TRACKING_FILE, TRACKS

from .recordings import write_video

SCALE = 4.0
TRAINING = {"EMO-2-surprise+fear": 3, "EXP-1-head": 4}
"""Training sequences and their numbers of frames."""


def tracking(head: HeadArrays, frames: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Arrays of a tracking file for a head."""
    rng = np.random.default_rng(seed)
    euler = rng.normal(0, 0.2, (frames, 3))
    draw = {
        "shape": rng.normal(size=(1, head.shape_basis.shape[2])),
        "expression": rng.normal(size=(frames, head.expression_basis.shape[2])),
        "rotation": euler,
        "rotation_matrices": Rotation.from_euler("XYZ", euler).as_matrix(),
        "translation": rng.normal(0, 0.1, (frames, 3)),
        "jaw": rng.normal(0, 0.1, (frames, 3)),
        "neck": rng.normal(0, 0.1, (frames, 3)),
        "eyes": rng.normal(0, 0.1, (frames, 6)),
        "scale": np.full((1, 1), SCALE),
    }
    return {name: values.astype(np.float32) for name, values in draw.items()} | {"frames": np.arange(frames)}


def write_benchmark(root: Path, head: HeadArrays) -> Path:
    """Write cameras and tracking, two frames a sequence, of participant 393; return the benchmark's folder."""
    home = root / MONO.name / "393"
    for number, sequence in enumerate(MONO.sequences["393"]):
        folder = home / "sequences" / sequence / "tracking"
        folder.mkdir(parents=True)
        np.savez(folder / TRACKING_FILE, **tracking(head, 2, number))
    turns = Rotation.from_rotvec([[0, turn, 0] for turn in (0.0, -0.5, 0.1, 0.5)]).as_matrix()
    turns = turns * np.array(
        [[1.0], [-1.0], [-1.0]]
    )  # OpenCV's axes: the head's top is up, its face towards the camera
    matrices = {}
    for serial, turn in zip(MONO.serials, turns):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[2, 3] = turn, SCALE
        matrices[serial] = matrix.tolist()
    K = [[1500.0, 0, 250.0], [0, 1500.0, 260.0], [0, 0, 1]]
    (home / "calibration").mkdir()
    document = {"world_2_cam": matrices, "intrinsics": dict.fromkeys(MONO.serials, K)}
    (home / "calibration" / "camera_params.json").write_text(json.dumps(document))
    return root


def write_training(
    root: Path, head: HeadArrays, serials: dict[str, list[str]]
) -> dict[str, list[np.ndarray]]:
    """Write videos of participant 393: of each track, those of ``serials``. The person is a square; returns its colours."""
    colours = {}
    for track, cameras in serials.items():
        width, height = TRACKS[track].size
        home = root / track / "393"
        for number, (sequence, count) in enumerate(TRAINING.items()):
            colours[sequence] = [np.array([60 + 30 * frame, 90, 160 - 50 * number]) for frame in range(count)]
            mask = np.zeros((height, width), np.uint8)
            mask[height // 4 : height // 2, width // 4 : width // 2] = 255
            images = [
                np.where(mask[..., None] > 0, colour, 255).astype(np.uint8) for colour in colours[sequence]
            ]
            folder = home / "sequences" / sequence
            for serial in cameras:
                write_video(folder / "images" / f"cam_{serial}.mp4", images, 24.3)
                write_video(folder / "alpha_maps" / f"cam_{serial}.mp4", [mask] * count, 24.3)
            if track == MONO.name:
                (folder / "tracking").mkdir()
                np.savez(folder / "tracking" / TRACKING_FILE, **tracking(head, count, 10 + number))
    return colours
