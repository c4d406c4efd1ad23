"""``make pictures``: what goes wrong with videos, from a synthetic capture: ``docs/pictures/footage-*.jpg``.

``python docs/_ext/footage.py CAPTURE`` with a capture of ``headbench synth`` or ``headbench demo``. The first picture of each pair is
right, the second shows the fault.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from headbench.bench.contracts import ByteArray, Camera
from headbench.datasets.clip import CaptureClip
from headbench.datasets.ga.reader import read_capture
from headbench.datasets.head.model import PosedSubject
from headbench.datasets.mesh_pictures import draw_mesh
from headbench.datasets.synthetic.plan import FRONTAL

PICTURES = Path(__file__).parents[1] / "pictures"
LONGEST = 440
"""Longest side of a picture, pixels."""
NOISE, CONTRAST = 2.0, 12.0
"""Of the camera, and smallest difference from the wall that shows, levels of 255."""


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


def before_wall(clip: CaptureClip, camera: Camera, mesh: np.ndarray) -> ByteArray:
    """The first frame with a mask by the difference from a wall that has the colour of the hair."""
    key = clip.frame_at[min(clip.poses), camera.id]
    image, cover = clip.image(key), clip.mask(key)[..., None] / 255
    seen = mesh @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (seen @ camera.K.T)[:, :2] / seen[:, 2:]
    face = pixels[np.asarray(clip.head.regions["face"])]
    rows = np.arange(len(image))[:, None, None]
    hair = (cover > 0.9) & (rows < face[:, 1].min())
    wall = np.median(image[hair[..., 0]], axis=0)
    # The person's own colours without the white that the capture has at soft edges.
    own = np.where(cover > 0.05, 255 + (image - 255.0) / np.maximum(cover, 0.05), 255)
    difference = cover * (own - wall) + np.random.default_rng(0).normal(0, NOISE, image.shape)
    shown = ndimage.binary_opening(np.abs(difference).max(axis=2) > CONTRAST, np.ones((3, 3)))
    parts, _ = ndimage.label(shown)
    person = parts == np.bincount(parts[parts > 0]).argmax()
    return np.where(ndimage.binary_fill_holes(person)[..., None], image, 255).astype(np.uint8)


def main(capture: Path) -> None:
    clip = read_capture(capture)
    first, camera = min(clip.poses), clip.cameras[FRONTAL]
    key = clip.frame_at[first, camera.id]
    image = clip.image(key)
    ((_, mesh),) = PosedSubject.of(clip).each(clip, [first])
    shifted = np.array(camera.K)
    shifted[:2, 2] += [0.17 * camera.width, 0.06 * camera.height]
    side = next(name for name in clip.cameras if name != camera.id)
    pairs = {
        "mesh": (mesh_over(clip, camera, image), mesh_over(clip, replace(camera, K=shifted), image)),
        "mask": (image, before_wall(clip, camera, mesh)),
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
        picture.thumbnail((LONGEST, LONGEST))
        picture.save(PICTURES / f"footage-{name}.jpg", quality=85)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
