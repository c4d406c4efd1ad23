"""A method as somebody outside writes it: draws the tracked mesh in the mean colour of the training images."""

import cv2
import numpy as np

import headbench as hb
from headbench import Frame, MethodSpec

LIGHT = np.array([0.3, -0.5, -0.8])  # from above the camera, OpenCV axes


class MeshAvatar:
    """The tracked mesh of a subject, flat shaded."""

    def __init__(self, folder):
        self._head, self._paths = (
            hb.load_head(folder / "head.npz"),
            [folder / "head.npz", folder / "subject.npz"],
        )
        with np.load(folder / "subject.npz", allow_pickle=False) as subject:
            self._shape, self._offset, self._color = (subject[name] for name in ("shape", "offset", "color"))

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        world = self._head(pose, self._shape, self._offset)
        motion = np.asarray(camera.world_to_camera, np.float64)
        points = world @ motion[:3, :3].T + motion[:3, 3]
        pixels = points @ np.asarray(camera.K, np.float64).T
        pixels = pixels[:, :2] / pixels[:, 2:]
        corners = points[self._head.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
        shades = 0.3 + 0.7 * np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
        rgb = np.tile(np.asarray(background, np.float32), (camera.height, camera.width, 1))
        alpha = np.zeros(rgb.shape[:2], np.float32)
        for face in np.argsort(-corners[:, :, 2].mean(axis=1)):  # the farthest first
            polygon = np.rint(pixels[self._head.faces[face]]).astype(np.int32)
            cv2.fillConvexPoly(rgb, polygon, (shades[face] * self._color).tolist())
            cv2.fillConvexPoly(alpha, polygon, 1.0)
        return Frame(rgb, alpha)

    def files(self):
        return self._paths


class Mesh:
    """Trains nothing but a colour."""

    def fit(self, clip, out, budget, *, device, seed, progress):
        out.mkdir(parents=True, exist_ok=True)
        seen = []
        for key in clip.splits["train"][:8]:
            mask = clip.mask(key)
            image = clip.image(key).reshape(-1, 3)
            seen.append(image if mask is None else image[mask.ravel() > 127])
        color = np.concatenate(seen).mean(axis=0) / 255
        hb.save_head(out / "head.npz", clip.head)
        np.savez(out / "subject.npz", shape=clip.shape, offset=clip.static_offset, color=color)
        progress(1, 1)
        return self.load(out, device=device)

    def load(self, path, *, device):
        return MeshAvatar(path)


SPEC = MethodSpec(
    "mesh", "the tracked mesh, flat shaded", "outside_method:Mesh", presets={"smoke": {}, "fast": {}}
)
