"""Pictures of what goes wrong with videos, from a synthetic capture: ``docs/pictures/footage-*.jpg``.

``python docs/_ext/footage.py CAPTURE`` with a capture of ``headbench synth --cameras 4 --timesteps 12 --performance still``; the first
picture of each pair is right, the second shows the fault.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from headbench.bench.contracts import ByteArray, Camera
from headbench.datasets.clip import CaptureClip
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.mesh_pictures import draw_mesh
from headbench.datasets.synthetic.plan import FRONTAL

PICTURES = Path(__file__).parents[1] / "pictures"


def mesh_over(clip: CaptureClip, camera: Camera, image: ByteArray) -> ByteArray:
    """The tracked mesh of the first frame over an image, as ``overlay.png`` shows it."""
    ((_, mesh),) = PosedSubject.of(clip).each(clip, [min(clip.poses)])
    return draw_mesh(mesh, clip.head.faces, camera, background=image, opacity=0.6)


def nearer(camera: Camera, head: np.ndarray, ratio: float) -> Camera:
    """A camera at ``ratio`` of the distance to a point and of the focal length, so that the point keeps its size and place."""
    K, pose = np.array(camera.K), np.array(camera.world_to_camera)
    K[0, 0] *= ratio
    K[1, 1] *= ratio
    pose[2, 3] -= (1 - ratio) * (pose[2, :3] @ head + pose[2, 3])
    return replace(camera, K=K, world_to_camera=pose)


def main(capture: Path) -> None:
    clip = read_capture(capture)
    first, camera = min(clip.poses), clip.cameras[FRONTAL]
    key = clip.frame_at[first, camera.id]
    image, mask = clip.image(key), clip.mask(key)
    ((_, mesh),) = PosedSubject.of(clip).each(clip, [first])
    shifted = np.array(camera.K)
    shifted[:2, 2] += [0.17 * camera.width, 0.06 * camera.height]
    rows = np.arange(len(mask))[:, None]
    top = int(np.flatnonzero(mask.max(axis=1))[0])
    cut = np.where(rows < top + 0.12 * len(mask), 0, mask)
    side = next(name for name in clip.cameras if name != camera.id)
    pairs = {
        "mesh": (mesh_over(clip, camera, image), mesh_over(clip, replace(camera, K=shifted), image)),
        "mask": (image, np.where(cut[..., None] > 127, image, 255).astype(np.uint8)),
        "lost": (image, clip.image(clip.frame_at[first, side])[:, : camera.width // 2 + camera.width // 12]),
        "focal": (
            mesh_over(clip, camera, image),
            mesh_over(
                clip, nearer(camera, mesh[np.asarray(clip.head.regions["face"])].mean(axis=0), 0.35), image
            ),
        ),
    }
    for name, (right, wrong) in pairs.items():
        space = np.full((len(right), 12, 3), 255, np.uint8)
        picture = Image.fromarray(np.concatenate([right, space, wrong], axis=1))
        picture.save(PICTURES / f"footage-{name}.jpg", quality=85)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
