"""The benchmark's folder in small: calibration, tracking and videos of one participant, random but right."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from headbench.bench.contracts import HeadPose
from headbench.datasets.head.arrays import HeadArrays
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.nersemble.benchmark.submission import MONO, TRACKING_FILE, BenchmarkTrack
from headbench.datasets.nersemble.recording import read_calibration

from ..tiny_capture import silhouette
from .recordings import write_video

SCALE = 4.0
TRAINING = {"EMO-2-surprise+fear": 3, "EXP-1-head": 4}
"""Training sequences and their numbers of frames."""


def tracking(head: HeadArrays, frames: int, seed: int = 0, person: int = 0) -> dict[str, np.ndarray]:
    """Arrays of a tracking file for a head; all of a ``person`` have one shape."""
    rng = np.random.default_rng(seed)
    euler = rng.normal(0, 0.2, (frames, 3))
    draw = {
        "shape": np.random.default_rng(person).normal(size=(1, head.shape_basis.shape[2])),
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


def write_benchmark(root: Path, head: HeadArrays, track: BenchmarkTrack = MONO) -> Path:
    """Write cameras and tracking, two frames a sequence, of participant 393; return the benchmark's folder."""
    home = root / track.name / "393"
    for number, sequence in enumerate(track.sequences["393"]):
        folder = home / "sequences" / sequence / "tracking"
        folder.mkdir(parents=True)
        np.savez(folder / TRACKING_FILE, **tracking(head, 2, number))
    turns = Rotation.from_rotvec([[0, turn, 0] for turn in (0.0, -0.5, 0.1, 0.5)]).as_matrix()
    turns = turns * np.array(
        [[1.0], [-1.0], [-1.0]]
    )  # OpenCV's axes: the head's top is up, its face towards the camera
    matrices = {}
    for serial, turn in zip(track.serials, turns):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[2, 3] = turn, SCALE
        matrices[serial] = matrix.tolist()
    K = np.diag([track.size[0] / 512, track.size[1] / 512, 1]) @ [
        [1500.0, 0, 250.0],
        [0, 1500.0, 260.0],
        [0, 0, 1],
    ]
    (home / "calibration").mkdir()
    document = {"world_2_cam": matrices, "intrinsics": dict.fromkeys(track.serials, K.tolist())}
    (home / "calibration" / "camera_params.json").write_text(json.dumps(document))
    return root


def write_training(
    root: Path, head: HeadArrays, *tracks: tuple[BenchmarkTrack, list[str]]
) -> dict[str, list[np.ndarray]]:
    """Write videos of participant 393 by cameras of each track, and tracking: the posed head, shaded, on white.

    Returns the colours of the head by sequence and frame.
    """
    colours = {}
    for number, (sequence, count) in enumerate(TRAINING.items()):
        arrays = tracking(head, count, 10 + number)
        vertices = world_vertices(head, arrays)
        colours[sequence] = [np.array([60 + 30 * frame, 90, 160 - 50 * number]) for frame in range(count)]
        for track, serials in tracks:
            home = root / track.name / "393"
            folder = home / "sequences" / sequence
            if track.name == MONO.name:
                (folder / "tracking").mkdir(parents=True)
                np.savez(folder / "tracking" / TRACKING_FILE, **arrays)
            calibration = read_calibration(home / "calibration" / "camera_params.json")
            for serial in serials:
                camera = calibration.camera(serial, track.size, track.size)
                inside = [silhouette(posed, head.faces, camera) for posed in vertices]
                images = [
                    np.where(covered[..., None], shaded(colour, *track.size), 255).astype(np.uint8)
                    for covered, colour in zip(inside, colours[sequence])
                ]
                masks = [255 * covered.astype(np.uint8) for covered in inside]
                write_video(folder / "images" / f"cam_{serial}.mp4", images, 24.3)
                write_video(folder / "alpha_maps" / f"cam_{serial}.mp4", masks, 24.3)
    return colours


def shaded(colour: np.ndarray, width: int, height: int) -> np.ndarray:
    """(H, W, 3) levels of the head: darker to the left, brighter to the right."""
    return np.broadcast_to(colour + np.linspace(-50, 50, width)[:, None], (height, width, 3))


def world_vertices(head: HeadArrays, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """(T, V, 3) vertices by the benchmark's own formula: FLAME without rotation and translation, then scale, rotation, translation."""
    zero = np.zeros(3, np.float32)
    poses = [
        HeadPose(head.version, expression, rotation=zero, neck=neck, jaw=jaw, eyes=eyes, translation=zero)
        for expression, neck, jaw, eyes in zip(
            *(arrays[name] for name in ("expression", "neck", "jaw", "eyes"))
        )
    ]
    still = PosedSubject(head, arrays["shape"][0], np.zeros_like(head.template)).meshes(poses)
    turned = np.einsum("tij,tvj->tvi", arrays["rotation_matrices"], still)
    return SCALE * turned + arrays["translation"][:, None]
