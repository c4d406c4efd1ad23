"""Runs scripts of Gaussian Head Avatar's authors for given numbers of iterations; copied to their working directory.

Their training has no number of iterations, and their renderer writes JPEG beside its input image. A plan (JSON) lists
scripts and configurations; each runs in a separate process of the same interpreter. This file requires only Python 3.8
and the standard library.
"""

import json
import os
import random
import runpy
import subprocess
import sys

RECORDERS = {
    "train_meshhead.py": "MeshHeadTrainRecorder",
    "train_gaussianhead.py": "GaussianHeadTrainRecorder",
}
TRAINERS = {
    "train_meshhead.py": ("lib.trainer.MeshHeadTrainer", "MeshHeadTrainer"),
    "train_gaussianhead.py": ("lib.trainer.GaussianHeadTrainer", "GaussianHeadTrainer"),
}
LOSSES = ("loss_rgb", "loss_rgb_hr")
EPOCHS = 10**9


def main():
    """Run the parts of a plan one after another, or one of them."""
    with open(sys.argv[1]) as stream:
        plan = json.load(stream)
    if len(sys.argv) > 2:
        run(plan["checkout"], plan["seed"], plan["parts"][int(sys.argv[2])])
        return
    for number in range(len(plan["parts"])):
        code = subprocess.call([sys.executable, os.path.abspath(__file__), sys.argv[1], str(number)])
        if code:
            sys.exit(code if code > 0 else 128 - code)


def run(checkout, seed, part):
    """Run one script with its configuration until it ends or its iterations are done."""
    script = part["script"]
    sys.path.insert(0, checkout)
    sys.argv = [os.path.join(checkout, script), "--config", part["config"]]
    seeded(seed)
    if script in TRAINERS:
        bounded(script, part)
    else:
        numbered(part)
    runpy.run_path(sys.argv[0], run_name="__main__")
    if script in TRAINERS:
        sys.exit(f"{script} ended before its {part['iterations']} iterations")


def seeded(seed):
    """Seed the random number generators of their code."""
    import torch

    random.seed(seed)
    torch.manual_seed(seed)


def bounded(script, part):
    """End a training after its last iteration is recorded, since their code has only a number of epochs."""
    import importlib

    recorder = getattr(importlib.import_module("lib.recorder.Recorder"), RECORDERS[script])
    module, name = TRAINERS[script]
    trainer = getattr(importlib.import_module(module), name)
    record, train = recorder.log, trainer.train

    def log(self, values):
        record(self, values)
        done = values["iter"] + 1
        loss = next(float(values[name]) for name in LOSSES if name in values)
        print(f"\nheadbench: iteration {part['before'] + done} loss {loss:.4f}", flush=True)
        if done == part["iterations"]:
            # An exception would not end the process: the threads of their loader wait for a consumer.
            sys.stdout.flush()
            os._exit(0)

    recorder.log = log
    trainer.train = lambda self, start=0, epochs=0: train(self, start, EPOCHS)


def numbered(part):
    """Write renders as PNG, named by the numbers of the frames of this camera in the plan."""
    import cv2

    write = cv2.imwrite

    def imwrite(path, image, *rest):
        index = int(os.path.splitext(os.path.basename(path))[0])
        path = os.path.join(part["renders"], f"{part['numbers'][index]:06d}.png")
        done = write(path, image)
        if not done:
            raise OSError(f"OpenCV could not write {path}")
        print(f"\nheadbench: drawn {part['before'] + index + 1}", flush=True)
        return done

    cv2.imwrite = imwrite


if __name__ == "__main__":
    main()
