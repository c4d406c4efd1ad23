"""A stand-in for GaussianBlendshapes' repository: its file names, options, output and loader's rules."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from headbench.methods.official.gbs.method import GBSOfficial

from .repository import committed

HELD_OUT = 7
"""Frames at the end that the stand-in holds out; another number than the original's, so that it has to be read."""
CYLINDER = (0.0, -0.05, 0.02)

COMMON = """
import argparse, io, json, os, sys, zipfile
from pathlib import Path
from pickle import load
import numpy as np
from PIL import Image

parser = argparse.ArgumentParser()
for name in ("source_path", "model_path", "iterations", "checkpoint_iterations", "test_iterations", "load_iteration",
             "position_lr_max_steps", "densify_from_iter", "densification_interval", "densify_until_iter",
             "opacity_reset_interval", "render_seq", "render_test", "dump_for_viewer", "feature_lr"):
    parser.add_argument("--" + name)
arguments, unknown = parser.parse_known_args()
assert not unknown, unknown
assert os.environ["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] == "1"
source, model = Path(arguments.source_path), Path(arguments.model_path)
with open("data/FLAME2020/generic_model.pkl", "rb") as stream:
    head = load(stream, encoding="latin1")
vertices = len(head["v_template"])
assert head["shapedirs"].shape == (vertices, 3, 400)
lids = [np.load(Path(__file__).parent / f"FLAME/blendshapes/{side}_eyelid.npy") for side in "lr"]
assert {lid.shape for lid in lids} == {(vertices, 3)}
landmarks = np.load("data/landmark_embedding.npy")[()]
assert landmarks["dynamic_lmk_bary_coords"].shape == (79, 17, 3)
assert np.load("FLAME/mediapipe/mediapipe_landmark_embedding.npz")["lmk_b_coords"].shape == (105, 3)
corners = [line.split()[1:] for line in (source / "canonical.obj").read_text().splitlines() if line[:2] == "f "]
assert [[int(corner.split("/")[0]) - 1 for corner in face] for face in corners] == head["f"].tolist()
back = np.loadtxt("data/FLAME2020/back_of_head.txt").astype(int)
assert head["f"][back].max() < vertices
assert np.loadtxt("data/FLAME2020/neck_exclude_vertex.txt").max() < vertices
assert Path("data/up_billboard_tri.obj").exists() and Path("data/down_billboard_tri.obj").exists()

def frame(number):
    with zipfile.ZipFile(source / f"checkpoint/{number:05d}.frame") as archive:
        name = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
        return load(io.BytesIO(archive.read(name)))

count = len(list(source.glob("checkpoint/*.frame")))
frames = [frame(number) for number in range(count)]
images = [Image.open(source / f"images/{number:05d}.png") for number in range(count)]
assert {image.mode for image in images} == {"RGBA"}
sizes = {"shape": 300, "exp": 100, "tex": 140, "jaw": 6, "eyes": 12, "eyelids": 2}
for found in frames:
    assert {name: array.shape for name, array in found["flame"].items()} == {n: (1, s) for n, s in sizes.items()}
    assert {array.dtype for part in found.values() for array in part.values()} == {np.dtype("float32")}
"""

TRAIN = """
held_out = HELD_OUT
assert {image.size for image in images[-held_out:]} == {(1, 1)}
assert min(image.size[0] for image in images[:-held_out]) > 1
iterations = int(arguments.iterations)
print("options", vars(arguments))
import random
taken = []
for iteration in range(1, iterations + 1):
    viewpoint_stack = list(range(count - held_out))
    taken.append(viewpoint_stack.pop(random.randint(0, len(viewpoint_stack)-1)))
print("taken", taken[:40])
for iteration in range(10, iterations + 1, 10):
    bar = f"\\rTraining progress:  5%|#| {iteration}/{iterations} [00:01<00:10, 5.0it/s, Loss=0.{iteration}]"
    print(bar, end="", flush=True)
model.mkdir(parents=True, exist_ok=True)
for name in ("fix_chkpnt", "mouth0_chkpnt", "mouth1_chkpnt"):
    (model / f"{name}{arguments.checkpoint_iterations}.pth").write_bytes(name.encode())
(model / f"acc{arguments.checkpoint_iterations}.npy").write_bytes(b"acc")
(model / "cfg_args").write_text("")
"""

RENDER = """
for name, suffix in (("fix_chkpnt", "pth"), ("mouth0_chkpnt", "pth"), ("mouth1_chkpnt", "pth"), ("acc", "npy")):
    assert (model / f"{name}{arguments.load_iteration}.{suffix}").read_bytes() == name.encode()
assert (source / "WeightID_256.pt").exists() and (source / "Weight5node_256.pt").exists()
assert (arguments.render_seq, arguments.render_test) == ("True", "False")
folder = model / "seq" / f"split_{arguments.load_iteration}"
folder.mkdir(parents=True)
for index, (found, truth) in enumerate(zip(frames, images)):
    print(f"\\rRendering progress:  5%|#| {index + 1}/{count} [00:01<00:10]", end="", flush=True)
    width, height = truth.size
    drawn = np.zeros((height, width, 3), np.uint8)
    # What a frame shows: its expression, jaw and place of the camera, covered by 3/5.
    drawn[..., 0] = np.clip(60 + 20 * found["flame"]["exp"][0, 0], 0, 153)
    drawn[..., 1] = np.clip(60 + 200 * found["flame"]["jaw"][0, 5], 0, 153)
    drawn[..., 2] = np.clip(60 + 100 * found["opencv"]["t"][0, 0], 0, 153)
    covered = np.zeros_like(drawn)
    covered[..., 0] = 153
    shown = {"pred": drawn, "pred_mask": covered, "gt": np.asarray(truth)[..., :3], "mesh": drawn}
    for name, image in CHANGE(shown, index).items():
        Image.fromarray(image).save(folder / f"{name}_{index:05d}.png")
"""


def make_blendshapes_repository(folder: Path, vertices: int, change: str = "shown") -> str:
    """Write the stand-in and commit it; return its commit.

    Parameters
    ----------
    vertices : of the eyelid bases, which tell FLAME's topology.
    change : expression of ``shown`` and ``index``: what the renderer writes.
    """
    for name in ("FLAME/blendshapes", "config", "utils", "data/FLAME2020"):
        (folder / name).mkdir(parents=True)
    (folder / "train.py").write_text(COMMON + TRAIN.replace("HELD_OUT", str(HELD_OUT)))
    (folder / "test.py").write_text(f"CHANGE = lambda shown, index: {change}\n{COMMON}{RENDER}")
    (folder / "FLAME" / "dataset.py").write_text(f"self.n_seg = {HELD_OUT} # held out\n")
    (folder / "FLAME" / "FLAME.py").write_text("")
    (folder / "config" / "config_blendshapes.py").write_text(f"cylinder_params = {[*CYLINDER, 0.03, 0.02]}\n")
    for side in "lr":
        np.save(folder / f"FLAME/blendshapes/{side}_eyelid.npy", np.zeros((vertices, 3)))
    for name in ("up", "down"):
        (folder / f"data/{name}_billboard_tri.obj").write_text("v 0 0 0\n")
    for name in ("back_of_head", "neck_exclude_vertex"):
        (folder / f"data/FLAME2020/{name}.txt").write_text("3\n1\n2\n")
    return committed(folder)


class BlendshapesStandIn(GBSOfficial):
    """`GBSOfficial` around the stand-in, which needs no module that is not here."""

    repository = replace(GBSOfficial.repository, modules=("json",), trial="")

    def shrink_command(self, fit, work):
        """Nothing: its checkpoints are no torch files."""
        return
