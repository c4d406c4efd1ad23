"""Stand-ins for the official repositories: file names, options and output of theirs around a few lines that draw what was exported."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from headbench.datasets.head.teeth import lip_rings
from headbench.methods.official.flashavatar.method import FlashAvatarOfficial
from headbench.methods.official.ga.method import GAOfficial
from headbench.methods.official.gbs.method import GBSOfficial
from headbench.methods.official.gha.method import GHAOfficial
from headbench.methods.official.insta.method import MASKS, INSTAOfficial
from headbench.methods.official.rgbavatar.method import RGBAvatarOfficial
from headbench.methods.official.tga.method import TGAOfficial

LINES_BEGIN = 12
"""Iteration at which the stand-in of TGA's training begins to train feature lines."""
HELD_OUT = 7
"""Frames at the end that the stand-in of GaussianBlendshapes holds out; another number than the original's, so that it has to be read."""
CYLINDER = (0.0, -0.05, 0.02)

COMMON = """
import argparse, io, json, os, sys, time, zipfile
from pathlib import Path
from pickle import load
import numpy as np
from PIL import Image

PLACE = Path({place!r})
behaviour = (PLACE / "behaviour.txt").read_text() if (PLACE / "behaviour.txt").exists() else ""

def options(*names, flags=()):
    parser = argparse.ArgumentParser()
    for name in names:
        parser.add_argument("--" + name)
    for name in flags:
        parser.add_argument("--" + name, action="store_true")
    return parser.parse_known_args()[0]

def train(count, line, step=1):
    # The iterations of a training, each with a line of its output.
    for done in range(step, count + 1, step):
        yield done
        print(line.format(done=done, count=count), flush=True)
        if done == 5 * step and behaviour == "crash":
            raise RuntimeError("CUDA out of memory")
        time.sleep(60 * (done == 5 * step and behaviour == "hang"))

def write(path, content):
    if behaviour != "no output":
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

def order(count):
    # Number of each render, and the frame that it shows.
    if behaviour == "crash in rendering":
        raise RuntimeError("CUDA out of memory")
    for index in range(count):
        if not (behaviour == "one too few" and index == 1):
            yield index, count - 1 - index if behaviour == "reversed" else index

def picture(levels, width, height, most=255):
    image = np.zeros((height, width - (behaviour == "other size"), 3), np.uint8)
    image[:] = np.floor(np.clip(levels, 0, most))
    return image

def read_pickle(path):
    with open(path, "rb") as stream:
        return load(stream, encoding="latin1")

def read_frame(path):
    with zipfile.ZipFile(path) as archive:
        name = next(name for name in archive.namelist() if name.endswith("/data.pkl"))
        return load(io.BytesIO(archive.read(name)))
"""

# ------------------------------------------------------------------ GaussianAvatars and TensorialGaussianAvatar

GA = """
from common import *
arguments = options("source_path", "model_path", "iterations", "iteration", flags=["white_background"])
source, model = Path(arguments.source_path), Path(arguments.model_path)
assert read_pickle("flame_model/assets/flame/flame2023.pkl")["shapedirs"].shape[2] == 400
made = model / "point_cloud" / f"iteration_{arguments.iterations or arguments.iteration}"
frames = {split: json.loads((source / f"transforms_{split}.json").read_text())["frames"] for split in ("train", "val", "test")}
"""
GA_TRAIN = """
assert not frames["val"] and not frames["test"]
meshes = {f["timestep_index"]: dict(np.load(source / f["flame_param_path"])) for f in frames["train"]}
assert all(Image.open(source / f["file_path"]).size == (f["w"], f["h"]) for f in frames["train"])
for done in train(int(arguments.iterations), "\\rTraining progress:  5%|#| {done}/{count} [00:01<00:10, 5.0it/s, Loss=0.{done}]"):
    pass
write(made / "point_cloud.ply", b"ply")
write(model / "cfg_args", f"Namespace(white_background={arguments.white_background})".encode())
names = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")
refined = {name: np.concatenate([meshes[t][name] for t in sorted(meshes)]) for name in names}
refined["expr"] = refined["expr"] + np.float32(0.25)
made.mkdir(parents=True, exist_ok=True)
np.savez(made / "flame_param.npz", **refined)
if (source / "sorted_jaw_poses.npz").exists():
    for name in ("triplane.pth", "feat_line.pth"):
        write(made / name, b"tensors")
"""
GA_RENDER = """
parameters = np.load(made / "flame_param.npz")
folder = model / "test" / f"ours_{arguments.iteration}"
for name in ("renders", "gt"):
    (folder / name).mkdir(parents=True)
for index, at in order(len(frames["test"])):
    frame = frames["test"][at]
    t, place = frame["timestep_index"], np.array(frame["transform_matrix"])[:3, 3]
    levels = [100 + 40 * parameters["expr"][t, 0], 100 + 900 * parameters["rotation"][t, 0], 100 + 200 * place[0]]
    Image.fromarray(picture(levels, frame["w"], frame["h"])).save(folder / "renders" / f"{index:05d}.png")
    Image.open(source / frame["file_path"]).save(folder / "gt" / f"{index:05d}.png")
    print(f"\\rRendering progress:  5%|#| {index + 1}/{len(frames['test'])} [00:01<00:10]", end="", flush=True)
print()
if (source / "sorted_jaw_poses.npz").exists():
    open("/nowhere/fps.txt", "a")
"""
GA_MODEL = """
self.mesh_lst = torch.zeros([T, {}, 3], requires_grad=False).cuda()
self.face_center_lst = torch.zeros([T, {}, 3], requires_grad=False).cuda()
"""


def make_repository(folder: Path, head) -> str:
    """GaussianAvatars' and TGA's.

    The stand-in's teeth would hang on vertices that no vertex of the head has.
    """
    count, first = len(lip_rings(head)[0]), len(head.template) + 5
    rings = [list(range(start, start + 2 * count, 2)) for start in (first, first + 1)]
    sizes = max(rings[1]) + 1 + 120, len(head.faces) + 168
    texts = [
        f'self.v.register_buffer(\n    "lip_outside_ring_{name}",\n    torch.tensor([\n {", ".join(map(str, ring))}, \n    ])\n)\n'
        for name, ring in zip(("upper", "lower"), rings)
    ]
    return made(
        folder,
        {
            "train.py": f"offset_start_iter = {LINES_BEGIN}\n{GA}{GA_TRAIN}",
            "render.py": GA + GA_RENDER,
            "scene/dataset_readers.py": "",
            "scene/flame_gaussian_model.py": GA_MODEL.format(*sizes),
            "flame_model/flame.py": "".join(texts),
        },
    )


# ------------------------------------------------------------------ Gaussian Head Avatar

GHA_STAGE = """
from common import *
from lib.recorder.Recorder import {kind}TrainRecorder
from lib.trainer.{kind}Trainer import {kind}Trainer
config = json.loads(Path(sys.argv[2]).read_text())
data = config["dataset"]
root = Path(data["dataroot"])
if behaviour == "crash" and "{kind}".startswith("Gaussian"):
    raise RuntimeError("CUDA out of memory")
trainer = {kind}Trainer(len(os.listdir(root / "images")), {kind}TrainRecorder(config["recorder"]))
if behaviour == "stop":
    trainer.train = lambda start, epochs: None
trainer.train(0, 1)
"""
GHA_RENDER = """
from common import *
import cv2
config = json.loads(Path(sys.argv[2]).read_text())
data = config["dataset"]
root, name = Path(data["dataroot"]), config["recorder"]["name"]
images, parameters = (sorted(root.glob(data[kind])) for kind in ("image_files", "param_files"))
folder = Path(config["recorder"]["result_path"]) / name
folder.mkdir(parents=True)
extrinsic, before, size = np.load(data["camera_path"])["extrinsic"], None, data["resolution"]
place = -extrinsic[:, :3].T @ extrinsic[:, 3]
for index, at in order(len(images)):
    values = np.load(parameters[index])
    shown = np.concatenate([values["exp_coeff"][0], values["pose"][0]])
    before = shown if before is None else before * 0.5 + shown * 0.5
    levels = [100 + 200 * place[0], 100 + 300 * before[-6], 100 + 40 * before[0]]
    beside = cv2.resize(cv2.imread(str(images[at])), (size, size))
    cv2.imwrite(str(folder / f"{index:06d}.jpg"), np.hstack([beside, picture(levels, size, size)]))
"""
GHA_FILES = {
    "torch.py": "def manual_seed(seed):\n    print('torch seeded with', seed)\n",  # torch itself takes seconds to import
    "lib/dataset/Dataset.py": "",
    "config/config.py": "",
    "reenactment.py": GHA_RENDER,
    "train_meshhead.py": GHA_STAGE.format(kind="MeshHead"),
    "train_gaussianhead.py": GHA_STAGE.format(kind="GaussianHead"),
    "lib/recorder/Recorder.py": """
from common import write
from pathlib import Path

class MeshHeadTrainRecorder:
    files, loss = ("meshhead",), "loss_rgb"

    def __init__(self, config):
        self.config = config

    def log(self, values):
        if values["iter"] % self.config["save_freq"] == 0:
            for name in self.files:
                folder = Path(self.config["checkpoint_path"]) / self.config["name"]
                write(folder / (name + "_latest"), str(values["iter"] + 1).encode())

class GaussianHeadTrainRecorder(MeshHeadTrainRecorder):
    files, loss = ("gaussianhead", "supres"), "loss_rgb_hr"
""",
    "lib/trainer/MeshHeadTrainer.py": """
class MeshHeadTrainer:
    def __init__(self, frames, recorder):
        self.frames, self.recorder = frames, recorder

    def train(self, start_epoch, epochs):
        for iteration in range(start_epoch, epochs * self.frames):
            self.recorder.log({"iter": iteration, self.recorder.loss: 0.5})
""",
    "lib/trainer/GaussianHeadTrainer.py": "from lib.trainer.MeshHeadTrainer import MeshHeadTrainer as GaussianHeadTrainer",
}


def make_head_avatar_repository(folder: Path, head) -> str:
    """Gaussian Head Avatar's, with the file that is downloaded."""
    commit = made(folder, GHA_FILES)
    (folder / "assets").mkdir()
    (folder / "assets" / "tets_data.npz").write_bytes(b"tetrahedra")
    return commit


# ------------------------------------------------------------------ INSTA

INSTA = """#!{python}
import sys
sys.path.insert(0, {place!r})
from common import *
arguments = options("config", "scene", "snapshot", "width", "height", flags=["no-gui", "version"])
if arguments.version:
    print("neural graphics primitives version 1.0dev")
    sys.exit()
config = json.loads((Path("configs/nerf") / arguments.config).read_text())
config = json.loads((Path("configs/nerf") / config["parent"]).read_text()) | config
scene = Path(arguments.scene)
folder = scene.parent if scene.suffix == ".json" else scene

def vertices(path):
    return np.array([line.split()[1:] for line in path.read_text().splitlines() if line.startswith("v")], float)

def frames(part):
    paths = [path for path in folder.iterdir() if path.suffix == ".json" and part in str(path)]
    found = [frame for path in paths for frame in json.loads(path.read_text())["frames"]]
    return sorted(found, key=lambda frame: frame["mesh_path"])

debug = folder / "experiments" / Path(arguments.config).stem / "debug"
for place in (debug.parent.parent, debug.parent, debug):
    place.mkdir(exist_ok=True)
if not arguments.snapshot:
    for done in train(config["max_steps"], "\\x1b[0;35mINFO     \\x1b[0;37miteration={{done}} loss=0.{{done}}\\x1b[0m"):
        pass
    write(debug / "snapshot.msgpack", b"field")
(debug / "overlay").mkdir()
listed, recorded = frames("test"), []
assert len(listed) <= config["max_images_gpu"]
for index, at in order(len(listed)) if arguments.snapshot else ():
    frame, matrix = listed[at], np.array(listed[at]["transform_matrix"])
    recorded.append({{"mesh_path": f"meshes/{{index:05d}}.obj", "transform_matrix": matrix.tolist()}})
    width, height = int(arguments.width), int(arguments.height)
    focal = frame["fl_x"] / Image.open(folder / frame["file_path"]).size[1] * height
    expression = float((folder / frame["exp_path"]).read_text().split()[0])
    image = picture([30 + 20 * expression, 5000 * vertices(folder / frame["mesh_path"]).std(), focal], width, height, 153)
    image[0, 0] = np.floor(np.clip(75 + 60 * matrix[:3, 3], 0, 153))
    if behaviour != "no coverage":
        image = np.dstack([image, np.full(image.shape[:2], 153, np.uint8)])
    Image.fromarray(image).save(debug / "overlay" / f"{{index:05d}}.png")
    print(f"INFO     Recording frame [{{index + 1}}/{{len(listed)}}] in the mode overlay", flush=True)
if behaviour != "no cameras":
    (debug / "transforms_overlay.json").write_text(json.dumps({{"frames": recorded}}))
"""


def make_insta_repository(folder: Path, head) -> str:
    """INSTA's, built; its meshes have another topology than FLAME's."""
    texts = {f"mesh_masks/{name}.obj": "v 0 0 0 1 0 0\nf 1 1 1\n" for name in MASKS}
    texts |= {"configs/nerf/main.json": '{"max_steps": 33000, "learning_rate": 0.25}'}
    commit = made(folder, {".gitignore": "build\n", "src/recorder.cu": "", **texts})
    program = folder / "build" / "rta"
    program.parent.mkdir()
    program.write_text(INSTA.format(python=sys.executable, place=str(folder)))
    program.chmod(0o755)
    return commit


# ------------------------------------------------------------------ GaussianBlendshapes

GBS = """
from common import *
arguments = options(*"source_path model_path iterations checkpoint_iterations load_iteration".split())
source, model = Path(arguments.source_path), Path(arguments.model_path)
assert read_pickle("data/FLAME2020/generic_model.pkl")["shapedirs"].shape[1:] == (3, 400)
count = len(list(source.glob("checkpoint/*.frame")))
frames = [read_frame(source / f"checkpoint/{number:05d}.frame") for number in range(count)]
images = [Image.open(source / f"images/{number:05d}.png") for number in range(count)]
files = ("fix_chkpnt{}.pth", "mouth0_chkpnt{}.pth", "mouth1_chkpnt{}.pth", "acc{}.npy")
"""
GBS_TRAIN = """
for done in train(int(arguments.iterations), "\\rTraining progress:  5%|#| {done}/{count} [00:01<00:10, 5.0it/s, Loss=0.{done}]"):
    pass
for name in files:
    write(model / name.format(arguments.checkpoint_iterations), name.encode())
"""
GBS_RENDER = """
folder = model / "seq" / f"split_{arguments.load_iteration}"
folder.mkdir(parents=True)
for index, at in order(count):
    found, truth = frames[index], images[at]
    levels = [60 + 20 * found["flame"]["exp"][0, 0], 60 + 200 * found["flame"]["jaw"][0, 5], 60 + 100 * found["opencv"]["t"][0, 0]]
    covered = picture([153, 0, 0], *truth.size)
    shown = {"pred": picture(levels, *truth.size, 153), "pred_mask": covered, "gt": np.asarray(truth)[..., :3]}
    for name, image in shown.items():
        if not (behaviour == "no coverage" and name == "pred_mask"):
            Image.fromarray(image).save(folder / f"{name}_{index:05d}.png")
    print(f"\\rRendering progress:  5%|#| {index + 1}/{count} [00:01<00:10]", end="", flush=True)
"""


def make_blendshapes_repository(folder: Path, head) -> str:
    """GaussianBlendshapes', whose eyelid bases have another topology than the head."""
    texts = {
        "train.py": GBS + GBS_TRAIN,
        "test.py": GBS + GBS_RENDER,
        "FLAME/dataset.py": f"self.n_seg = {HELD_OUT} # held out\n",
        "FLAME/FLAME.py": "",
        "config/config_blendshapes.py": f"cylinder_params = {[*CYLINDER, 0.03, 0.02]}\n",
        **{f"data/{name}_billboard_tri.obj": "v 0 0 0\n" for name in ("up", "down")},
        **{f"data/FLAME2020/{name}.txt": "3\n1\n2\n" for name in ("back_of_head", "neck_exclude_vertex")},
    }
    return made(folder, texts, {f"FLAME/blendshapes/{side}_eyelid.npy": 1 for side in "lr"})


# ------------------------------------------------------------------ RGBAvatar

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
RGB = """
from common import *
import yaml
args = options("subject", "work_name", "config", "output_dir", flags=["preload", "alpha"])

def load_video(config):
    folder = Path(config["data_dir"]) / args.subject
    names = sorted(os.listdir(folder / "images"))
    images = [Image.open(folder / "images" / name) for name in names]
    return [read_frame(folder / f"checkpoint/{name[:5]}.frame") for name in names], images
"""
RGB_TRAIN = """
config = yaml.safe_load(Path(args.config).read_text())
frames, images = load_video(config)
output = Path(config["output_dir"]) / args.subject / args.work_name
output.mkdir(parents=True)
(output / "config.yaml").write_text(Path(args.config).read_text())
for done in train(config["train"]["iteration"], "\\rTraining:  5%|#| {done}/{count} [00:01<00:10, 5.0it/s]", config["train"]["batch_size"]):
    pass
write(output / "model.ply", b"splats")
"""
RGB_RENDER = """
class Tensor(np.ndarray):
    clamp = np.ndarray.clip

    def to(self, dtype, device):
        return np.asarray(self.astype(np.int64) % 256, np.uint8)

class torch:
    uint8 = None

output = Path(args.output_dir) / args.subject / args.work_name
frames, images = load_video(yaml.safe_load((output / "config.yaml").read_text()))
K, (width, height) = frames[0]["opencv"]["K"][0], frames[0]["img_size"]
(output / "render_image").mkdir()
for index, at in order(len(frames)):
    flame, place = frames[at]["flame"], frames[at]["opencv"]["t"][0, 0]
    image = picture([60 + 20 * flame["exp"][0, 0], 60 + 200 * flame["jaw"][0, 5], 60 + 100 * place], width, height, 153) / 1.0
    image[0, 0] = K[0, 0], K[0, 2], 300
    image = np.dstack([image, np.full(image.shape[:2], 153)])
    image = (image.view(Tensor) / 255 * 255.0).to(dtype=torch.uint8, device='cpu')
    mode = np.ascontiguousarray(image[..., :3] if behaviour == "no coverage" else image)
    Image.fromarray(mode).save(output / "render_image" / f"{index:05d}.png")
    print(f"\\rRendering:  5%|#| {index + 1}/{len(frames)} [00:01<00:10]", end="", file=sys.stderr, flush=True)
"""


def make_rgbavatar_repository(folder: Path, head) -> str:
    """RGBAvatar's, with the sizes of a head."""
    texts = {
        "train_offline.py": RGB + RGB_TRAIN,
        "render.py": RGB + RGB_RENDER,
        "config/offline.yaml": CONFIG,
    }
    texts |= {"dataset/flame_dataset.py": "", "submodules/flame/flame.py": ""}
    chart = folder / "data/FLAME2020/flame_uv.npz"
    chart.parent.mkdir(parents=True)
    np.savez(chart, vt=np.zeros((3, 2)), ft=np.zeros((len(head.faces), 3), np.uint32))
    return made(folder, texts, {f"data/FLAME2020/{side}_eyelid.npy": len(head.template) for side in "lr"})


# ------------------------------------------------------------------ FlashAvatar

FLASH_SCENE = """
from common import *

class torch:
    zeros = np.zeros

class Scene_mica:
    def __init__(self, datadir, mica_datadir, train_type, white_background):
        self.bg_image = torch.zeros((3, 512, 512))
        self.bg_image[:] = np.reshape([white_background, 1, white_background], (3, 1, 1))
        checkpoints = Path(mica_datadir) / "checkpoint"
        self.N_frames = len(os.listdir(checkpoints))
        test_num = 500
        max_train_num = 10000
        held_out = self.N_frames - test_num
        numbers = list(range(self.N_frames))
        numbers = numbers[:held_out][:max_train_num] if train_type == 0 else numbers[held_out:]
        first = read_frame(checkpoints / "00000.frame")
        self.size, self.K = tuple(first["img_size"]), first["opencv"]["K"][0]
        self.cameras = [self.load(Path(datadir), checkpoints, number) for number in numbers]

    def load(self, folder, checkpoints, number):
        names = ("imgs/%05d.jpg", "alpha/%05d.jpg", "parsing/%05d_neckhead.png", "parsing/%05d_mouth.png")
        images = [Image.open(folder / (name % (number + 1))) for name in names]
        assert images[0].size == self.size
        image, *masks = (np.array(image) / 255.0 for image in images)
        for mask in masks[:2]:
            image = self.bg_image.T + mask[..., None] * (image - self.bg_image.T)
        return image, read_frame(checkpoints / ("%05d.frame" % number))
"""
FLASH = """
from common import *
import cv2
from scene import Scene_mica
args = options("idname", "image_res", "iterations", "checkpoint", flags=["white_background"])
args.image_res = int(args.image_res)
data, tracked = os.path.join("dataset", args.idname), os.path.join("metrical-tracker/output", args.idname)
scene = Scene_mica(data, tracked, 1 if args.checkpoint else 0, args.white_background)
"""
FLASH_TRAIN = """
opt = argparse.Namespace(iterations=int(args.iterations))
mid_num = 15000
for iteration in train(opt.iterations, "step: {done}, huber: 0.50000"):
    image = scene.cameras[0][0].transpose(2, 0, 1)
    if iteration == 1:
        save_image = np.zeros((args.image_res, args.image_res*2, 3))
        save_image[:, :args.image_res, :] = image.transpose(1, 2, 0)
    if iteration % 5000 == 0:
        write(Path(data) / "log" / "ckpt" / ("chkpnt" + str(iteration) + ".pth"), b"splats")
"""
FLASH_TEST = """
logdir = os.path.join(data, "log")
out = None
for iteration, at in order(len(scene.cameras)):
    truth, frame = scene.cameras[at]
    levels = [60 + 20 * frame["flame"]["exp"][0, 0], 60 + 200 * frame["flame"]["jaw"][0, 5], scene.K[0, 0]]
    image = np.zeros_like(truth.transpose(2, 0, 1)) + np.floor(np.clip(levels, 0, 255))[:, None, None]
    save_image = np.zeros((args.image_res, args.image_res*2, 3))
    save_image[:, :args.image_res, :] = truth * 255
    save_image[:, args.image_res:, :] = image.transpose(1, 2, 0)
    save_image = (save_image + 1e-6).astype(np.uint8)[:, :, [2, 1, 0]]
    if behaviour == "other size":
        save_image = save_image[1:]
    out.write(save_image)
"""
FLASH_PLAIN = ("landmark_embedding.npy", "mediapipe/mediapipe_landmark_embedding.npz", "flame_mica.py")


def make_flashavatar_repository(folder: Path, head) -> str:
    """FlashAvatar's, with the vertices of a head in its mesh."""
    vertices = len(head.template)
    texts = {
        "train.py": FLASH + FLASH_TRAIN,
        "test.py": FLASH + FLASH_TEST,
        "scene/__init__.py": FLASH_SCENE,
        "src/deform_model.py": "",
        "flame/FlameMesh.obj": "vt 0 0\nvn 0 0 1\n" + "v 0 0 0\n" * vertices,
        **{f"flame/{name}": "" for name in FLASH_PLAIN},
    }
    return made(folder, texts, {f"flame/blendshapes/{side}_eyelid.npy": vertices for side in "lr"})


# ------------------------------------------------------------------ all


def made(folder: Path, texts: dict[str, str], eyelids: dict[str, int] | None = None) -> str:
    """Write and commit a repository of these texts and of eyelid bases of so many vertices; return the commit."""
    for name, text in {**texts, "common.py": COMMON.format(place=str(folder))}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for name, vertices in (eyelids or {}).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(folder / name, np.zeros((vertices, 3)))
    options = ("user.name=A", "user.email=a@b.c", "commit.gpgsign=false")
    git = ["git", "-C", str(folder), *(word for option in options for word in ("-c", option))]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *words], check=True)
    return subprocess.run(
        [*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True
    ).stdout.strip()


def stand_in(method: type) -> type:
    """A method around a stand-in, which needs no module that is not here and has no torch files."""
    repository = replace(method.repository, modules=("json",), trial="")
    changed = {"repository": repository, "shrink_command": lambda self, fit, work: None}
    return type(f"{method.__name__}StandIn", (method,), changed)


ADAPTERS = {
    "ga": (stand_in(GAOfficial), make_repository),
    "tga": (stand_in(TGAOfficial), make_repository),
    "gbs": (stand_in(GBSOfficial), make_blendshapes_repository),
    "gha": (stand_in(GHAOfficial), make_head_avatar_repository),
    "insta": (INSTAOfficial, make_insta_repository),
    "rgbavatar": (stand_in(RGBAvatarOfficial), make_rgbavatar_repository),
    "flashavatar": (stand_in(FlashAvatarOfficial), make_flashavatar_repository),
}
"""Methods by name, and what writes their repository for a head and returns its commit."""

INTERPRETER = """#!{python}
import json, os, sys
if sys.argv[1] == "-c":
    print("headbench-probe", json.dumps({{"python": "3", "missing": {{}}, "failed": "", "torch": "2", "cuda": True}}))
else:
    os.execv({python!r}, [{python!r}, *sys.argv[1:]])
"""


def make_interpreter(path: Path) -> Path:
    """Write an interpreter that says it has every module that is asked for, and otherwise is this one."""
    path.write_text(INTERPRETER.format(python=sys.executable))
    path.chmod(0o755)
    return path
