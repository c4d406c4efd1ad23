"""A stand-in for RGBAvatar's repository: its file names, options, configuration, output and loader's rules."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from headbench.methods.official.rgbavatar.method import RGBAvatarOfficial

from .repository import committed

CONFIG = """data_dir: /somewhere/INSTA # a comment
output_dir: ./output/
template_type: Flame

dataset:
  pin_memory: True

model:
  tex_size: 256
  init_scaling: 0.0008

train:
  batch_size: 10
  iteration: 50_000

  recon:
    blend_start_iter: 3000
    position_lr_final: 0.000008
    position_lr_max_steps: 30_000
"""

COMMON = """
import argparse, io, os, sys, time, zipfile
from pathlib import Path
from pickle import load
import numpy as np
import yaml
from PIL import Image

here = Path(__file__).parent
behaviour = (here / "behaviour.txt").read_text() if (here / "behaviour.txt").exists() else ""

def read(path):
    with zipfile.ZipFile(path) as archive:
        name = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
        return load(io.BytesIO(archive.read(name)))

def load_video(folder):
    paths = {kind: sorted(os.listdir(folder / kind)) for kind in ("images", "checkpoint")}
    assert [name[:5] for name in paths["images"]] == [name[:5] for name in paths["checkpoint"]]
    frames = [read(folder / "checkpoint" / name) for name in paths["checkpoint"]]
    images = [Image.open(folder / "images" / name) for name in paths["images"]]
    assert {image.mode for image in images} == {"RGBA"} and len({image.size for image in images}) == 1
    sizes = {"shape": 300, "exp": 100, "jaw": 6, "eyes": 12, "eyelids": 2}
    for found in frames:
        assert {name: array.shape for name, array in found["flame"].items()} == {n: (1, s) for n, s in sizes.items()}
        assert {array.dtype for array in found["flame"].values()} == {np.dtype("float32")}
    first = read(folder / "checkpoint/00000.frame")
    return frames, images, first["opencv"]["K"][0], first["img_size"]

with open("./data/FLAME2020/generic_model.pkl", "rb") as stream:
    head = load(stream, encoding="latin1")
vertices = len(head["v_template"])
assert head["J_regressor"].todense().shape == (5, vertices)
assert head["shapedirs"].shape == (vertices, 3, 400)
assert len(np.load("./data/FLAME2020/flame_uv.npz")["ft"]) == len(head["f"])
for side in "lr":
    assert np.load(f"./data/FLAME2020/{side}_eyelid.npy").shape == (vertices, 3)

parser = argparse.ArgumentParser()
for name in ("subject", "work_name", "config", "split", "output_dir"):
    parser.add_argument("--" + name)
for name in ("preload", "alpha", "log"):
    parser.add_argument("--" + name, action="store_true")
args = parser.parse_args()
"""

TRAIN = """
with open(args.config) as stream:
    config = yaml.safe_load(stream)
assert args.split == "all" and args.preload
frames, images, K, size = load_video(Path(config["data_dir"]) / args.subject)
assert images[0].size == tuple(size)
batch, count = config["train"]["batch_size"], config["train"]["iteration"]
np.random.choice(len(frames), batch, replace=False)
print("config", config)
output = Path(config["output_dir"]) / args.subject / args.work_name
print("finds", output.exists())
output.mkdir(parents=True)
(output / "config.yaml").write_text(Path(args.config).read_text())
for done in range(batch, count + 1, batch):
    print(f"\\rTraining:  5%|#| {done}/{count} [00:01<00:10, 5.0it/s]", end="", file=sys.stderr, flush=True)
    if behaviour == "crash" and done == 5 * batch:
        raise RuntimeError("CUDA out of memory")
    if behaviour == "hang" and done == 5 * batch:
        print(file=sys.stderr, flush=True)
        time.sleep(60)
if behaviour != "no ply":
    (output / "model.ply").write_bytes(b"splats")
"""

RENDER = """
class Tensor:
    # Values of an image, converted to 8 bits as C does.
    def __init__(self, values):
        self.values = values

    def permute(self, *axes):
        return Tensor(self.values.transpose(axes))

    def __mul__(self, factor):
        return Tensor(self.values * factor)

    def clamp(self, low, high):
        return Tensor(self.values.clip(low, high))

    def to(self, dtype, device):
        return Tensor(self.values.astype(np.int64) % 256)

    def numpy(self):
        return self.values.astype(np.uint8)

class torch:
    uint8 = None

output = Path(args.output_dir) / args.subject / args.work_name
with open(output / "config.yaml") as stream:
    config = yaml.safe_load(stream)
assert (output / "model.ply").read_bytes() == b"splats" and args.alpha
frames, images, K, size = load_video(Path(config["data_dir"]) / args.subject)
assert images[0].size == (1, 1)
(output / "render_image").mkdir()
for index, frame in enumerate(frames):
    if behaviour == "crash in rendering":
        raise RuntimeError("CUDA out of memory")
    width, height = size[0] - (behaviour == "other size"), size[1]
    # What a frame shows: its expression, jaw and place of the camera, covered by 3/5; and in a corner the focal length.
    image = np.zeros((1, 4, height, width))
    jaw, place = frame["flame"]["jaw"][0, 5], frame["opencv"]["t"][0, 0]
    image[0, :3] = np.clip([60 + 20 * frame["flame"]["exp"][0, 0], 60 + 200 * jaw, 60 + 100 * place], 0, 153)[:, None, None]
    image[0, :3, 0, 0] = K[0, 0], K[0, 2], 300
    image[0, 3] = 153
    image = (Tensor(image / 255).permute(0, 2, 3, 1) * 255.0).to(dtype=torch.uint8, device='cpu').numpy()
    if behaviour == "one too few" and index == 1:
        continue
    mode = np.ascontiguousarray(image[0, ..., :3] if behaviour == "no coverage" else image[0])
    Image.fromarray(mode).save(output / "render_image" / f"{index:05d}.png")
    print(f"\\rRendering:  5%|#| {index + 1}/{len(frames)} [00:01<00:10]", end="", file=sys.stderr, flush=True)
print("Done!")
"""


def make_rgbavatar_repository(folder: Path, vertices: int, triangles: int) -> str:
    """Write the stand-in and commit it; return its commit. The numbers are those of the texture chart's head."""
    for name in ("config", "dataset", "submodules/flame", "data/FLAME2020"):
        (folder / name).mkdir(parents=True)
    (folder / "train_offline.py").write_text(COMMON + TRAIN)
    (folder / "render.py").write_text(COMMON + RENDER)
    (folder / "config/offline.yaml").write_text(CONFIG)
    for name in ("dataset/flame_dataset.py", "submodules/flame/flame.py"):
        (folder / name).write_text("")
    np.savez(
        folder / "data/FLAME2020/flame_uv.npz", vt=np.zeros((3, 2)), ft=np.zeros((triangles, 3), np.uint32)
    )
    for side in "lr":
        np.save(folder / f"data/FLAME2020/{side}_eyelid.npy", np.zeros((vertices, 3)))
    return committed(folder)


class RGBAvatarStandIn(RGBAvatarOfficial):
    """`RGBAvatarOfficial` around the stand-in, which needs no module that is not here."""

    repository = replace(RGBAvatarOfficial.repository, modules=("json",), trial="")
