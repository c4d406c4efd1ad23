"""Renders lists of frames by INSTA's program, one after the other; run as a script.

The program renders one list at one image size in a call, beside the list. A plan (JSON) names the lists. Each render
is named by the number of its frame, after the cameras that the program writes beside its renders are compared with the
list. This file requires only the standard library.
"""

import json
import os
import re
import subprocess
import sys

RECORDED = re.compile(rb"Recording frame \[(\d+)/\d+\]")
TOLERANCE = 1e-3


def main():
    """Render the parts of a plan."""
    with open(sys.argv[1]) as stream:
        plan = json.load(stream)
    done = 0
    for part in plan["parts"]:
        render(plan, part, done)
        done += len(part["numbers"])
        print(f"\nheadbench: drawn {done}", flush=True)


def render(plan, part, before):
    """One call of the program."""
    scene = os.path.join(plan["input"], part["folder"])
    listed = os.path.join(scene, plan["list"])
    size = ["--width", str(part["width"]), "--height", str(part["height"])]
    command = [*plan["program"], "--scene", listed, *size]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        for line in process.stdout or ():
            sys.stdout.buffer.write(line)
            recorded = RECORDED.search(line)
            if recorded:
                sys.stdout.buffer.write(b"\nheadbench: drawn %d\n" % (before + int(recorded[1])))
            sys.stdout.buffer.flush()
    code = process.returncode
    if code:
        sys.exit(code if code > 0 else 128 - code)
    output = os.path.join(scene, plan["output"])
    check_cameras(listed, os.path.join(output, "transforms_overlay.json"))
    for index, number in enumerate(part["numbers"]):
        made = os.path.join(output, "overlay", f"{index:05d}.png")
        if os.path.exists(made):
            os.rename(made, os.path.join(plan["renders"], f"{number:06d}.png"))


def check_cameras(listed, shown):
    """Exit with an error if frames were rendered by other cameras, or in another order, than listed."""
    if not os.path.exists(shown):
        sys.exit(f"the program wrote no {shown}")
    wanted, found = (cameras(path) for path in (listed, shown))
    if len(wanted) != len(found):
        sys.exit(f"{shown} has {len(found)} frames of {len(wanted)}")
    for index, (one, other) in enumerate(zip(wanted, found)):
        if not max(abs(a - b) for a, b in zip(one, other)) < TOLERANCE:
            sys.exit(f"{shown}: frame {index} was rendered by the camera of another: the order has changed")


def cameras(path):
    """Rotation and position of each frame's camera, in the order of their names."""
    with open(path) as stream:
        frames = sorted(json.load(stream)["frames"], key=lambda frame: frame["mesh_path"])
    return [[float(value) for row in frame["transform_matrix"][:3] for value in row] for frame in frames]


if __name__ == "__main__":
    main()
