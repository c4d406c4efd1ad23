"""A stand-in for INSTA's repository: its file names, and a program with its options, output and rules about paths."""

from __future__ import annotations

import sys
from pathlib import Path

from headbench.methods.official.insta.export import MASKS

from .repository import committed

PROGRAM = """#!{python}
import argparse, json, os, sys
from pathlib import Path
import numpy as np
from PIL import Image

parser = argparse.ArgumentParser()
for name in ("config", "scene", "snapshot", "width", "height"):
    parser.add_argument("--" + name)
for name in ("no-gui", "version"):
    parser.add_argument("--" + name, action="store_true")
arguments = parser.parse_args()
if arguments.version:
    print("neural graphics primitives version 1.0dev")
    sys.exit()
behaviour = Path(__file__).parents[1].joinpath("behaviour.txt")
behaviour = behaviour.read_text() if behaviour.exists() else ""
config = json.loads((Path("configs/nerf") / arguments.config).read_text())
config = json.loads((Path("configs/nerf") / config["parent"]).read_text()) | config
assert config["learning_rate"] == 0.25 and not config["render_novel_trajectory"]
scene = Path(arguments.scene)
folder = scene.parent if scene.suffix == ".json" else scene
size = int(arguments.width), int(arguments.height)
assert arguments.no_gui and not os.path.isabs(arguments.scene)


def vertices(path):
    lines = [line.split() for line in path.read_text().splitlines()]
    faces = np.array([line[1:] for line in lines if line[0] == "f"], int)
    points = np.array([line[1:] for line in lines if line[0] == "v"], float)
    assert faces.min() == 1 and faces.max() <= len(points)
    return points


def load(part):
    paths = [scene] if scene.suffix == ".json" and part == "train" else [
        path for path in folder.iterdir() if path.suffix == ".json" and part in str(path)]
    frames = [(path, frame) for path in paths for frame in json.loads(path.read_text())["frames"]]
    return [frame for _, frame in sorted(frames, key=lambda pair: pair[1]["mesh_path"])]


canonical = vertices(folder / "canonical.obj")
for name in ("lips", "face", "boundary", "right_ear", "left_ear", "eye_region"):
    assert len(vertices(Path("mesh_masks") / (name + ".obj"))) == len(canonical)
debug = folder / "experiments" / Path(arguments.config).stem / "debug"
for place in (debug.parent.parent, debug.parent, debug):
    place.mkdir(exist_ok=True)
if not arguments.snapshot:
    frames = load("train")
    for frame in frames:
        size_of = {{Image.open(folder / frame[k]).size for k in ("file_path", "seg_mask_path", "depth_path")}}
        assert size_of == {{(frame["w"], frame["h"])}}
        assert len((folder / frame["exp_path"]).read_text().split()) >= 16
        assert vertices(folder / frame["mesh_path"]).shape == canonical.shape
    print("loads", len(frames), config["max_images_gpu"])
    for iteration in range(1, config["max_steps"] + 1):
        print(f"\\x1b[0;35mINFO     \\x1b[0;37miteration={{iteration}} loss=0.{{iteration}}\\x1b[0m", flush=True)
        if behaviour == "crash" and iteration == 5:
            (debug / "overlay").mkdir()
            Image.new("RGB", (9, 9)).save(debug / "overlay" / "left.png")
            print("Uncaught exception: out of memory")
            sys.exit(1)
else:
    assert config["render_from_snapshot"] and Path(arguments.snapshot).read_bytes() == b"field"
if behaviour != "no snapshot":
    (debug / "snapshot.msgpack").write_bytes(b"field")
frames = load("test")
assert len(frames) <= config["max_images_gpu"]
(debug / "overlay").mkdir()
shown = frames[::-1] if behaviour == "reversed" else frames
recorded = []
for index, frame in enumerate(shown):
    pixel = Image.open(folder / frame["file_path"])
    assert frame["mesh_path"] == sorted(f["mesh_path"] for f in shown)[index] or behaviour == "reversed"
    points = vertices(folder / frame["mesh_path"])
    matrix = np.array(frame["transform_matrix"])
    recorded.append({{"mesh_path": f"meshes/{{index:05d}}.obj", "transform_matrix": matrix.tolist()}})
    if behaviour == "crash in rendering" and arguments.snapshot:
        print("Uncaught exception: out of memory")
        sys.exit(1)
    if behaviour == "one too few" and index == 1:
        continue
    width, height = size[0] - (behaviour == "other size"), size[1]
    # What a frame shows: its expression, its mesh, and its camera's place and focal length; covered by 3/5.
    focal = frame["fl_x"] / pixel.size[1] * height
    levels = [30 + 20 * float((folder / frame["exp_path"]).read_text().split()[0]), 5000 * points.std(), focal]
    image = np.empty((height, width, 4), np.uint8)
    image[:] = np.floor(np.clip([*levels, 153], 0, 153))
    image[0, 0, :3] = np.floor(np.clip(75 + 60 * matrix[:3, 3], 0, 153))
    if behaviour == "no coverage":
        image = np.ascontiguousarray(image[..., :3])
    Image.fromarray(image).save(debug / "overlay" / f"{{index:05d}}.png")
    print(f"INFO     Recording frame [{{index + 1}}/{{len(frames)}}] in the mode overlay", flush=True)
if behaviour != "no cameras":
    (debug / "transforms_overlay.json").write_text(json.dumps({{"frames": recorded}}))
"""


def make_insta_repository(folder: Path, masks: str = "v 0 0 0 1 0 0\nf 1 1 1\n") -> str:
    """Write the stand-in, commit it and build it; return its commit.

    ``masks`` is the mesh that tells FLAME's topology.
    """
    for name in ("configs/nerf", "mesh_masks", "src", "build"):
        (folder / name).mkdir(parents=True)
    (folder / ".gitignore").write_text("build\n")
    (folder / "configs/nerf/main.json").write_text('{"max_steps": 33000, "learning_rate": 0.25}')
    (folder / "src/recorder.cu").write_text("")
    for name in MASKS:
        (folder / "mesh_masks" / f"{name}.obj").write_text(masks)
    commit = committed(folder)
    program = folder / "build" / "rta"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    return commit
