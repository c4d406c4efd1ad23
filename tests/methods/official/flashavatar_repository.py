"""A stand-in for FlashAvatar's repository: its file names, options, output and loader's rules, and the texts that are changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from headbench.methods.official.flashavatar.method import FlashAvatarOfficial

from .repository import committed

TORCH = """
import numpy as np

def zeros(shape):
    return np.zeros(shape)
"""

SCENE = """
import io, os, zipfile
from pickle import load
import numpy as np
import torch
from PIL import Image

def read(path):
    with zipfile.ZipFile(path) as archive:
        name = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
        return load(io.BytesIO(archive.read(name)))

def tensor(path):
    values = np.array(Image.open(path)) / 255.0
    return values.transpose(2, 0, 1) if values.ndim == 3 else values[None]

class Scene_mica:
    def __init__(self, datadir, mica_datadir, train_type, white_background):
        self.bg_image = np.asarray(torch.zeros((3, 512, 512)))
        self.bg_image[:] = np.reshape([white_background, 1, white_background], (3, 1, 1))
        checkpoints = os.path.join(mica_datadir, "checkpoint")
        self.N_frames = len(os.listdir(checkpoints))
        test_num = 500
        max_train_num = 10000
        numbers = list(range(self.N_frames))
        held_out = self.N_frames - test_num
        assert held_out >= 0
        numbers = numbers[:held_out][:max_train_num] if train_type == 0 else numbers[held_out:]
        first = read(os.path.join(checkpoints, "00000.frame"))
        self.width, self.height = first["img_size"]
        self.K = first["opencv"]["K"][0]
        self.cameras = [self.load(number, checkpoints, datadir) for number in numbers]

    def getCameras(self):
        return self.cameras

    def load(self, number, checkpoints, folder):
        frame = read(os.path.join(checkpoints, "%05d.frame" % number))
        sizes = {"shape": 300, "exp": 100, "jaw": 6, "eyes": 12, "eyelids": 2}
        shapes = {name: array.shape for name, array in frame["flame"].items()}
        assert shapes == {name: (1, size) for name, size in sizes.items()}
        names = ("imgs/%05d.jpg", "alpha/%05d.jpg", "parsing/%05d_neckhead.png", "parsing/%05d_mouth.png")
        image, alpha, head, mouth = (tensor(os.path.join(folder, name % (number + 1))) for name in names)
        for mask in (alpha, head):
            image = self.bg_image + mask * (image - self.bg_image)
        assert image.shape == (3, self.height, self.width) and mouth.shape == head.shape == alpha.shape
        return image, frame
"""

COMMON = """
import argparse, os, random, sys, time
import cv2
import numpy as np
from pickle import load
from scene import Scene_mica
from src.deform_model import Chart

here = os.path.dirname(os.path.abspath(__file__))
behaviour = BEHAVIOUR
behaviour = open(behaviour).read() if os.path.exists(behaviour) else ""
with open("flame/generic_model.pkl", "rb") as stream:
    head = load(stream, encoding="latin1")
with open("flame/FLAME_masks/FLAME_masks.pkl", "rb") as stream:
    boundary = load(stream, encoding="latin1")["boundary"]
vertices = len(head["v_template"])
chart = Chart()
assert chart.vertices == vertices
listed = [line for line in open("flame/FlameMesh.obj") if line.startswith("f ")]
print("chart of", chart.uv_size, "for", len(listed), "triangles without", len(boundary), "of", vertices)
assert len(boundary) < vertices and (not len(boundary) or boundary.max() < vertices)
assert head["shapedirs"].shape == (vertices, 3, 400)
for side in "lr":
    assert np.load(os.path.join(here, "flame/blendshapes", side + "_eyelid.npy")).shape == (vertices, 3)
for name in ("flame/FlameMesh.obj", "flame/landmark_embedding.npy", "flame/mediapipe/mediapipe_landmark_embedding.npz"):
    assert os.path.exists(name)

parser = argparse.ArgumentParser()
for name in ("idname", "image_res", "seed", "iterations", "checkpoint", "logname"):
    parser.add_argument("--" + name)
parser.add_argument("--white_background", action="store_true")
args = parser.parse_args()
args.image_res = int(args.image_res)
data = os.path.join("dataset", args.idname)
tracked = os.path.join("metrical-tracker/output", args.idname)
"""

MODEL = """
class Chart:
    def __init__(self):
        self.uv_size = 128
        self.vertices = len(range(5023))
        self.uv_vertices_shape, self.uv_head_idx = {(0, "head"): "the neutral mesh"}, "head"
        self.deformNet = self

    def training_setup(self):
        pass

    def load_state_dict(self, state):
        print("starts with", *state, [*state["fcs.0.weight"].shape])
"""

TRAIN = """
import torch
DeformModel, verts_final = chart, ["the first frame"]
DeformModel.training_setup()
gaussians = argparse.Namespace(create_from_verts=lambda points: print("sizes on", points))
gaussians.create_from_verts(verts_final[0])
log = os.path.join(data, "log")
print("finds", sorted(os.listdir(log)))
for name in ("train", "ckpt"):
    os.makedirs(os.path.join(log, name))
scene = Scene_mica(data, tracked, 0, args.white_background)
opt = argparse.Namespace(iterations=int(args.iterations))
print("options", args.seed, len(scene.cameras), "corner", [int(255 * level) for level in scene.cameras[0][0][:, 0, 0]])
mid_num = 15000
viewpoint_stack = []
for iteration in range(1, opt.iterations + 1):
    if not viewpoint_stack:
        viewpoint_stack = scene.getCameras().copy()
    viewpoint_cam = viewpoint_stack.pop(random.randint(0, len(viewpoint_stack)-1))
    image, shown = viewpoint_cam
    print("draws %.6f" % shown["flame"]["eyelids"][0, 0], np.round(shown["opencv"]["t"][0], 3).tolist())
    if iteration % 500 == 0 or iteration==1:
        save_image = np.zeros((args.image_res, args.image_res*2, 3))
        save_image[:, :args.image_res, :] = image.transpose(1, 2, 0)
    if iteration % 5 == 0:
        print("step: %d, huber: %.5f" % (iteration, 0.5))
    if iteration < opt.iterations :
        print("a step")
    if behaviour == "crash" and iteration == 5:
        raise RuntimeError("CUDA out of memory")
    if behaviour == "hang" and iteration == 5:
        time.sleep(60)
    if iteration % 5000 == 0:
        if behaviour != "no checkpoint":
            with open(os.path.join(log, "ckpt", "chkpnt" + str(iteration) + ".pth"), "wb") as stream:
                stream.write(b"splats")
"""

TEST = """
logdir = os.path.join(data, "log")
with open(args.checkpoint, "rb") as stream:
    assert stream.read() == b"splats"
scene = Scene_mica(data, tracked, 1, args.white_background)
out = cv2.VideoWriter(os.path.join(logdir, "test.avi"), 0, 25, (args.image_res * 2, args.image_res), True)
shown = scene.cameras[::-1] if behaviour == "reversed" else scene.cameras
for iteration in range(len(shown)):
    gt_image, frame = shown[iteration]
    if behaviour == "crash in rendering":
        raise RuntimeError("CUDA out of memory")
    if behaviour == "one too few" and iteration == 1:
        continue
    # What a frame shows: its expression, jaw and focal length; in a corner of the image the background.
    levels = [60 + 20 * frame["flame"]["exp"][0, 0], 60 + 200 * frame["flame"]["jaw"][0, 5], scene.K[0, 0]]
    image = np.zeros_like(gt_image) + np.floor(np.clip(levels, 0, 255))[:, None, None] / 255
    save_image = np.zeros((args.image_res, args.image_res*2, 3))
    save_image[:, :args.image_res, :] = gt_image.transpose(1, 2, 0) * 255
    save_image[:, args.image_res:, :] = image.transpose(1, 2, 0) * 255
    save_image = (save_image + 1e-6).astype(np.uint8)[:, :, [2, 1, 0]]
    if behaviour == "other size":
        save_image = save_image[1:]
    out.write(save_image)
out.release()
"""


def make_flashavatar_repository(folder: Path, vertices: int) -> str:
    """Write the stand-in and commit it; return its commit. ``vertices`` is the number in its mesh."""
    for name in ("scene", "src", "flame/blendshapes", "flame/mediapipe"):
        (folder / name).mkdir(parents=True)
    common = COMMON.replace("BEHAVIOUR", repr(str(folder / "behaviour.txt")))
    (folder / "train.py").write_text(common + TRAIN)
    (folder / "test.py").write_text(common + TEST)
    (folder / "torch.py").write_text(TORCH)
    (folder / "scene/__init__.py").write_text(SCENE)
    (folder / "flame/flame_mica.py").write_text("")
    (folder / "src/deform_model.py").write_text(MODEL.replace("5023", str(vertices)))
    (folder / "flame/FlameMesh.obj").write_text("vt 0 0\nvn 0 0 1\n" + "v 0 0 0\n" * vertices)
    for name in ("landmark_embedding.npy", "mediapipe/mediapipe_landmark_embedding.npz"):
        (folder / "flame" / name).write_bytes(b"landmarks")
    for side in "lr":
        np.save(folder / f"flame/blendshapes/{side}_eyelid.npy", np.zeros((vertices, 3)))
    return committed(folder)


class FlashAvatarStandIn(FlashAvatarOfficial):
    """`FlashAvatarOfficial` around the stand-in, which needs no module that is not here."""

    repository = replace(FlashAvatarOfficial.repository, modules=("json",), trial="")

    def shrink_command(self, fit, work):
        """Nothing: its checkpoints are no torch files."""
        return
