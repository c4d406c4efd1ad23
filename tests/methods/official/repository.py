"""A stand-in for an official repository: its file names, options and output, a few lines of Python behind them."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from headbench.bench.contracts import Budget, no_progress
from headbench.bench.engine.guard import TrainingView
from headbench.bench.io.arrays import check_arrays
from headbench.datasets.head.subject import PosedSubject
from headbench.datasets.head.teeth import lip_rings
from headbench.datasets.tracker_files.metrical import MEMBERS, metrical_frame
from headbench.methods.official.config import GAOfficialConfig
from headbench.methods.official.ga.method import GAOfficial
from headbench.methods.official.gha.method import GHAOfficial
from headbench.methods.official.tga.method import TGAOfficial
from headbench.methods.official.workplace import Workplace

BUDGET = Budget(iterations=20)


def fit(method, clip, out, progress=no_progress, *, budget=BUDGET, seed=0):
    """Train on the clip's training frames."""
    return method.fit(TrainingView(clip), out, budget, device="cpu", seed=seed, progress=progress)


def views(clip, *splits):
    """Camera and pose by key, of the frames of some splits."""
    return {k: (clip.cameras[k.camera], clip.poses[k.timestep]) for s in splits for k in clip.splits[s]}


WHITE = (1.0, 1.0, 1.0)


def renders(avatar, clip, ground=WHITE):
    """Frames of the held-out view by key."""
    return dict(avatar.render_listed(views(clip, "novel_view"), ground, no_progress))


def rendered(avatar, wanted, ground=WHITE):
    """Frames of a list by key; each is there in the size of its camera, and the progress goes up to their number."""
    done = []
    found = dict(avatar.render_listed(wanted, ground, lambda count, total, note="": done.append(count)))
    assert found.keys() == wanted.keys()
    assert done == sorted(done)
    assert done[-1] == len(wanted)
    for key, (camera, _) in wanted.items():
        assert found[key].rgb.shape == (camera.height, camera.width, 3)
    return found


def with_an_odd_size(wanted):
    """The same list, whose first frame has another width than the others."""
    odd, (camera, pose) = next(iter(wanted.items()))
    return wanted | {odd: (replace(camera, width=30), pose)}


def workplace(method, folder):
    """An empty place to export to."""
    work = Workplace.at(folder, method.inspect())
    work.make()
    return work


def export(method, clip, folder):
    """Export the clip's training frames: the place, and the images in it by key."""
    work = workplace(method, folder)
    return work, method.export(TrainingView(clip), work, no_progress)


class Killed(KeyboardInterrupt):
    """What a signal raises."""


def kill_at(iteration, clip):
    """A progress that raises `Killed` in this iteration of a training."""
    frames = len(clip.splits["train"])

    def progress(done, total, note=""):
        if done >= frames + iteration:
            raise Killed

    return progress


def read_tracked(path):
    """A frame's file by torch and the formulae of the reader of the tracker's files.

    That reader has height before width, the programs that the file is for have width first.
    """
    with torch.serialization.safe_globals([np.ndarray]):
        content = torch.load(path, weights_only=True)
    arrays = {
        f"{part}.{name}": array for part in ("flame", "opencv") for name, array in content[part].items()
    }
    arrays["img_size"] = content["img_size"][::-1]
    check_arrays(path, arrays, MEMBERS)
    return metrical_frame(path, int(path.stem), arrays)


def check_tracked(found, clip, key, window=None):
    """A frame's file has the pose of a clip's frame, and the camera of its image, or of a window of it."""
    camera, pose = clip.cameras[key.camera], clip.poses[key.timestep]
    shown = camera if window is None else window.camera
    assert (found.width, found.height) == (shown.width, shown.height)
    size = len(pose.expression)
    assert np.array_equal(found.expression[:size], pose.expression)
    assert found.expression.shape == (100,)
    assert not found.expression[size:].any()
    assert found.shape.shape == (300,)
    assert np.abs(found.shape[: len(clip.shape)] - clip.shape).max() < 1e-6
    for name in ("eyelids", "jaw", "eyes"):
        assert np.abs(getattr(found, name) - getattr(pose, name)).max() < 1e-6
    subject = PosedSubject.of(clip)
    points, motion = subject.neutral[::7], subject.motions([pose])[0]
    world = points @ motion[:3, :3].T + motion[:3, 3]
    local = world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    theirs = points @ found.world_to_camera[:3, :3].T + found.world_to_camera[:3, 3]
    here, there = ((p @ K.T)[:, :2] / p[:, 2:] for p, K in ((local, camera.K), (theirs, found.K)))
    there = there if window is None else there + [window.left, window.top]
    return float(np.abs(here - there).max())


LINES_BEGIN = 12
"""Iteration at which the stand-in of TGA's training begins to train feature lines."""

COMMON = """
import argparse, json, os, sys, time
from pathlib import Path
from pickle import load
import numpy as np
from PIL import Image

parser = argparse.ArgumentParser()
for name in ("source_path", "model_path", "iterations", "iteration"):
    parser.add_argument("--" + name)
arguments, others = parser.parse_known_args()
source, model = Path(arguments.source_path), Path(arguments.model_path)
here = Path(__file__).parent
behaviour = (here / "behaviour.txt").read_text() if (here / "behaviour.txt").exists() else ""
with open("flame_model/assets/flame/flame2023.pkl", "rb") as stream:
    head = load(stream, encoding="latin1")
with open("flame_model/assets/flame/FLAME_masks.pkl", "rb") as stream:
    masks = load(stream, encoding="latin1")
landmarks = np.load("flame_model/assets/flame/landmark_embedding_with_eyes.npy")[()]
assert landmarks["full_lmk_faces_idx"].shape == (1, 70)
assert head["shapedirs"].shape[2] == 400 and head["posedirs"].shape[-1] == 36

def frames(split):
    return json.loads((source / f"transforms_{split}.json").read_text())["frames"]
"""

TRAIN = """
print("environment", sorted(os.environ))
listed = frames("train")
assert not frames("val") and not frames("test")
meshes = {f["timestep_index"]: dict(np.load(source / f["flame_param_path"])) for f in listed}
assert sorted(meshes) == list(range(len(meshes)))
sizes = {Image.open(source / f["file_path"]).size == (f["w"], f["h"]) for f in listed}
assert sizes == {True}
iterations = int(arguments.iterations)
model.mkdir(parents=True, exist_ok=True)
print("finds", sorted(path.name for path in model.iterdir()))
for iteration in range(1, iterations + 1):
    bar = f"\\rTraining progress:  {iteration}%|#| {iteration}/{iterations} [00:01<00:10, 5.0it/s, Loss=0.{iteration}]"
    print(bar, end="", flush=True)
    (model / "checkpoint").write_text(str(iteration))
    if behaviour == "crash" and iteration == 5:
        raise RuntimeError("CUDA out of memory")
    if behaviour == "hang" and iteration == 5:
        child = os.fork()
        if child:
            (here / "pids.txt").write_text(f"{os.getpid()} {child}")
            print(flush=True)
        time.sleep(60)
print()
made = model / "point_cloud" / f"iteration_{iterations}"
made.mkdir(parents=True)
(model / "cfg_args").write_text(f"Namespace(white_background={'--white_background' in others})")
if behaviour != "no ply":
    (made / "point_cloud.ply").write_bytes(b"ply of " + str(len(listed)).encode())
dynamic = ("expr", "rotation", "neck_pose", "jaw_pose", "eyes_pose", "translation")
refined = {name: np.concatenate([meshes[t][name] for t in sorted(meshes)]) for name in dynamic}
refined["expr"] = refined["expr"] + np.float32(0.25)
if (source / "sorted_jaw_poses.npz").exists():
    bases = np.load(source / "sorted_jaw_poses.npz")["jaw_poses"]
    labels = np.load(source / "train_cluster_16.npz")["labels"]
    assert bases.shape == (16, 4) and bases.dtype == np.float32
    assert labels.shape == (len(meshes),) and labels.dtype == np.int64
    for name in ("triplane.pth", "feat_line.pth"):
        (made / name).write_bytes(b"tensors")
np.savez(made / "flame_param.npz", **refined, dynamic_offset=np.zeros((len(meshes), 9, 3), np.float32))
"""

RENDER = """
parameters = np.load(model / "point_cloud" / f"iteration_{arguments.iteration}" / "flame_param.npz")
folder = model / "test" / f"ours_{arguments.iteration}"
for name in ("renders", "gt"):
    (folder / name).mkdir(parents=True)
listed = frames("test")
shown = listed[::-1] if behaviour == "reversed" else listed
for index, frame in enumerate(shown):
    print(f"\\rRendering progress:  5%|#| {index + 1}/{len(listed)} [00:01<00:10]", end="", flush=True)
    if behaviour == "crash in rendering" and index == 1:
        raise RuntimeError("CUDA out of memory")
    if behaviour == "one too few" and index == 1:
        continue
    t, width, height = frame["timestep_index"], frame["w"], frame["h"]
    if behaviour == "other size":
        width -= 1
    # What a frame shows: its expression, rotation and camera, and where in the window it is.
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.clip(100 + 40 * parameters["expr"][t, 0], 0, 255)
    image[..., 1] = np.clip(100 + 900 * parameters["rotation"][t, 0], 0, 255)
    image[..., 2] = 20 * int(frame["camera_id"]) % 256
    Image.fromarray(image).save(folder / "renders" / f"{index:05d}.png")
    Image.open(source / frame["file_path"]).save(folder / "gt" / f"{index:05d}.png")
print()
if (source / "sorted_jaw_poses.npz").exists():
    assert (model / "point_cloud" / f"iteration_{arguments.iteration}" / "feat_line.pth").exists()
    open("/nowhere/fps.txt", "a")
"""

MODEL = """
self.mesh_lst = torch.zeros([T, {}, 3], requires_grad=False).cuda()
self.face_center_lst = torch.zeros([T, {}, 3], requires_grad=False).cuda()
"""


def make_repository(folder: Path, rings: tuple[list[int], list[int]], sizes: tuple[int, int]) -> str:
    """Write the stand-in and commit it; return its commit.

    ``rings`` are the vertices that its teeth would hang on, ``sizes`` the vertices and triangles, teeth included, that
    TGA's code would fix.
    """
    for name in ("scene", "flame_model"):
        (folder / name).mkdir(parents=True)
    (folder / "train.py").write_text(f"offset_start_iter = {LINES_BEGIN}\n{COMMON}{TRAIN}")
    (folder / "render.py").write_text(COMMON + RENDER)
    (folder / "scene" / "dataset_readers.py").write_text("")
    (folder / "scene" / "flame_gaussian_model.py").write_text(MODEL.format(*sizes))
    upper, lower = (", ".join(map(str, ring)) + "," for ring in rings)
    source = "".join(
        f'self.v.register_buffer(\n    "lip_outside_ring_{name}",\n    torch.tensor([\n        {ring} \n    ])\n)\n'
        for name, ring in (("upper", upper), ("lower", lower))
    )
    (folder / "flame_model" / "flame.py").write_text(source)
    return committed(folder)


def committed(folder: Path) -> str:
    """Commit all files of a folder; return the commit."""
    options = ("user.name=A", "user.email=a@b.c", "commit.gpgsign=false")
    git = ["git", "-C", str(folder), *(word for option in options for word in ("-c", option))]
    for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *words], check=True)
    done = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    return done.stdout.strip()


class StandIn(GAOfficial):
    """`GAOfficial` around the stand-in, which needs no module that is not here."""

    repository = replace(GAOfficial.repository, modules=("json",), trial="")


class TensorialStandIn(TGAOfficial):
    """`TGAOfficial` around the stand-in."""

    repository = replace(TGAOfficial.repository, modules=("json",), trial="")


def settings(checkout: Path, commit: str, **changes) -> GAOfficialConfig:
    """Settings that find the stand-in."""
    values = {"checkout": str(checkout), "python": sys.executable, "commit": commit} | changes
    return GAOfficialConfig(**values)


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


def lip_numbers(head) -> tuple[tuple[list[int], list[int]], tuple[int, int]]:
    """Rings and sizes, as `make_repository` takes them: lips at numbers that no vertex of the head has."""
    count, first = len(lip_rings(head)[0]), len(head.template) + 5
    rings = list(range(first, first + 2 * count, 2)), list(range(first + 1, first + 2 * count, 2))
    return rings, (max(rings[1]) + 1 + 120, len(head.faces) + 168)


# ------------------------------------------------------------------ Gaussian Head Avatar

HEAD_AVATAR = {
    "torch.py": "def manual_seed(seed):\n    print('torch seeded with', seed)\n",  # torch itself takes seconds to import
    "lib/dataset/Dataset.py": "",
    "config/config.py": "",
    "lib/recorder/Recorder.py": """
import os

class MeshHeadTrainRecorder:
    files, loss = ("meshhead",), "loss_rgb"

    def __init__(self, config):
        self.config = config
        self.folder = os.path.join(config["checkpoint_path"], config["name"])
        os.makedirs(self.folder)

    def log(self, values):
        assert set(values) == {"iter", self.loss}
        if values["iter"] % self.config["save_freq"] == 0:
            for name in self.files:
                with open(os.path.join(self.folder, name + "_latest"), "w") as stream:
                    stream.write(str(values["iter"] + 1))

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
    "lib/trainer/GaussianHeadTrainer.py": """
from lib.trainer.MeshHeadTrainer import MeshHeadTrainer

class GaussianHeadTrainer(MeshHeadTrainer):
    pass
""",
}
HEAD_AVATAR_STAGE = """
import json, os, sys
import cv2
import numpy as np
from lib.recorder.Recorder import {recorder} as Recorder
from lib.trainer.{trainer} import {trainer} as Trainer

assert os.path.exists("assets/tets_data.npz")
here = os.path.dirname(os.path.abspath(__file__))
with open(sys.argv[2]) as stream:
    config = json.load(stream)
data = config["dataset"]
side, frames = data["original_resolution"], os.listdir(os.path.join(data["dataroot"], "images"))
for frame in frames:
    for camera in data["camera_ids"]:
        place = os.path.join(data["dataroot"], "images", frame, "%s_" + camera + ".jpg")
        assert {{cv2.imread(place % kind).shape for kind in ("image", "mask", "visible")}} == {{(side, side, 3)}}
        small = {{cv2.imread(place % (kind + "_lowres")).shape for kind in ("image", "mask", "visible")}}
        assert small == {{(256, 256, 3)}}
        K = np.load(os.path.join(data["dataroot"], "cameras", frame, "camera_" + camera + ".npz"))["intrinsic"]
        assert K[0, 2] == K[1, 2] == side / 2
    values = np.load(os.path.join(data["dataroot"], "params", frame, "params.npz"))
    module = config["meshheadmodule"]
    assert module["exp_color_mlp"][0] == 128 + values["exp_coeff"].shape[1]
    assert values["pose"].shape == (1, 6) and values["scale"].shape == (1,)
    landmarks = np.load(os.path.join(data["dataroot"], "params", frame, "lmk_3d.npy"))
    assert landmarks.shape[0] >= 66
behaviour = os.path.join(here, "behaviour.txt")
behaviour = open(behaviour).read() if os.path.exists(behaviour) else ""
if behaviour == "crash" and "{trainer}".startswith("Gaussian"):
    raise RuntimeError("CUDA out of memory")
trainer = Trainer(len(frames), Recorder(config["recorder"]))
if behaviour == "stop":
    trainer.train = lambda start, epochs: None
trainer.train(0, 1)
"""
HEAD_AVATAR_RENDERER = """
import glob, json, os, sys
import cv2
import numpy as np

here = os.path.dirname(os.path.abspath(__file__))
behaviour = os.path.join(here, "behaviour.txt")
behaviour = open(behaviour).read() if os.path.exists(behaviour) else ""
with open(sys.argv[2]) as stream:
    config = json.load(stream)
data = config["dataset"]
images, parameters = (
    sorted(glob.glob(os.path.join(data["dataroot"], data[kind]))) for kind in ("image_files", "param_files")
)
assert len(images) == len(parameters)
if behaviour == "reversed":
    images = images[::-1]
os.makedirs(os.path.join(config["recorder"]["result_path"], config["recorder"]["name"]))
assert open(config["load_supres_checkpoint"]).read() == open(config["load_gaussianhead_checkpoint"]).read()
size = data["resolution"] - (2 if behaviour == "other size" else 0)
before = None
for index, (image, path) in enumerate(zip(images, parameters)):
    values = np.load(path)
    shown = np.concatenate([values["exp_coeff"][0], values["pose"][0]])
    before = shown if before is None else before * 0.5 + shown * 0.5
    beside = cv2.resize(cv2.imread(image), (size, size))
    color = np.clip([120, 100 + 300 * before[-6], 100 + 40 * before[0]], 0, 255)
    render = np.empty((size, size, 3), np.uint8)
    render[:] = color.astype(np.uint8)
    if behaviour == "one too few" and index == 1:
        continue
    name = os.path.join(config["recorder"]["result_path"], config["recorder"]["name"], "%06d.jpg" % index)
    cv2.imwrite(name, np.hstack([beside, render]))
"""


def make_head_avatar_repository(folder: Path) -> str:
    """Write a stand-in for Gaussian Head Avatar's and commit it; return its commit."""
    files = dict(HEAD_AVATAR)
    for script, kind in (("train_meshhead.py", "MeshHead"), ("train_gaussianhead.py", "GaussianHead")):
        files[script] = HEAD_AVATAR_STAGE.format(recorder=f"{kind}TrainRecorder", trainer=f"{kind}Trainer")
    files["reenactment.py"] = HEAD_AVATAR_RENDERER
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    commit = committed(folder)
    (folder / "assets").mkdir()
    (folder / "assets" / "tets_data.npz").write_bytes(b"tetrahedra")
    return commit


class HeadAvatarStandIn(GHAOfficial):
    """`GHAOfficial` around the stand-in."""

    repository = replace(GHAOfficial.repository, modules=("json",))
