"""Avatars that are drawn as their mesh: a method without training, whose stored avatars tests write."""

from dataclasses import replace

import numpy as np

from headbench.bench.contracts import Budget, Frame
from headbench.bench.engine.config import ResolvedMethod
from headbench.bench.engine.stored import HEAD_FILE, SUBJECT_FILE, write_avatar_record
from headbench.bench.specs import MethodSpec
from headbench.datasets.ga.writer import save_npz
from headbench.datasets.head.arrays import read_head, save_head
from headbench.datasets.mesh_pictures import draw_mesh

SPEC = MethodSpec("mesh", "Its mesh.", "mesh_method:MeshMethod")
VIDEO = replace(SPEC, name="mesh video", monocular=True)


class MeshAvatar:
    def __init__(self, folder):
        self.head = read_head(folder / HEAD_FILE)
        self.subject = dict(np.load(folder / SUBJECT_FILE))

    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        mesh = self.head(pose, self.subject["shape"], self.subject["static_offset"])
        image = draw_mesh(mesh, self.head.faces, camera, background=background, supersampling=1)
        return Frame((image / 255).astype(np.float32), np.ones(image.shape[:2], np.float32))

    def files(self):
        return []


class MeshMethod:
    def load(self, path, *, device):
        return MeshAvatar(path)


def write_mesh_avatar(folder, head, *, subject="901", shape=None, offset=None, spec=SPEC):
    """Store an avatar of a head; without an identity it is the mean head."""
    folder.mkdir(parents=True)
    shape = np.zeros(head.shape_basis.shape[2]) if shape is None else shape
    offset = np.zeros(head.template.shape) if offset is None else offset
    save_head(folder / HEAD_FILE, head)
    identity = {"shape": shape, "static_offset": offset}
    save_npz(folder / SUBJECT_FILE, {name: np.asarray(v, np.float32) for name, v in identity.items()})
    method = ResolvedMethod(spec, None, Budget())
    write_avatar_record(folder, method, subject, shape, head.version, "training", {})
    return folder
