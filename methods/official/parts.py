"""Renders lists of frames by calls of the authors' program, one after the other; run as a script.

A call renders one list of frames with equal image size or intrinsics, which the program fixes in a call. A plan
(JSON) names the calls and where each leaves its renders, which are then named by the numbers of their frames. If a
call writes the cameras of its renders, they are compared with the list first. This file requires only the standard
library.
"""

import json
import os
import re
import subprocess
import sys

TAIL = 2000
TOLERANCE = 1e-3


def main():
    """Run the calls of a plan."""
    with open(sys.argv[1]) as stream:
        plan = json.load(stream)
    drawn = re.compile(plan["drawn"].encode())
    done = 0
    for part in plan["parts"]:
        run(part["command"], drawn, done)
        if part.get("cameras"):
            check_cameras(*part["cameras"])
        for index, number in enumerate(part["numbers"]):
            made = os.path.join(part["renders"], f"{index:05d}.png")
            if os.path.exists(made):
                os.rename(made, os.path.join(plan["renders"], f"{number:06d}.png"))
        done += len(part["numbers"])
        print(f"\nheadbench: drawn {done}", flush=True)


def run(command, drawn, before):
    """Run one call; its output is passed on, with the number of frames drawn in all calls."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        tail, told = b"", 0
        while process.stdout is not None:
            chunk = os.read(process.stdout.fileno(), 1 << 16)
            if not chunk:
                break
            sys.stdout.buffer.write(chunk)
            tail = (tail + chunk)[-TAIL:]
            found = [int(number) for number in drawn.findall(tail)]
            if found and found[-1] > told:
                told = found[-1]
                sys.stdout.buffer.write(b"\nheadbench: drawn %d\n" % (before + told))
            sys.stdout.buffer.flush()
    code = process.returncode
    if code:
        sys.exit(code if code > 0 else 128 - code)


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
