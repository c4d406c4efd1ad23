"""Every command that loads avatars on the device of their run, over a run on the pretended device; prints JSON.

A process of its own, as torch has to know the device before the first gradient.
``python -m headbench.tests.commands_on_device FOLDER [COMMAND ...]``.
"""

import contextlib
import io
import json
import os
import sys
from pathlib import Path

from headbench.bench import cli
from headbench.bench.engine import config

from .methods import pretended
from .test_end_to_end import CASES, OTHERS, timed_in_few_frames

COMMANDS = ("run sweep", "run curve", "run extremes", "run reenact", "verify", "view")
"""Those that load the avatars of a run on the run's device."""


def attempt(words: str) -> dict:
    """A command's exit code, and what it wrote to the standard error stream."""
    written = io.StringIO()
    with contextlib.redirect_stdout(sys.stderr), contextlib.redirect_stderr(written):
        code = cli.main(words.split())
    return {"words": words, "code": code, "written": written.getvalue()[-3000:]}


def main() -> None:
    """See the module."""
    pretended.register()
    config.DEVICES = f"cpu|{pretended.DEVICE}"
    folder = Path(sys.argv[1]).resolve()
    wanted = sys.argv[2:] or COMMANDS
    folder.mkdir(exist_ok=True)
    os.chdir(folder)
    few = "--set frames_per_task=1 --set metrics=psnr,ssim,storage,fps"
    demo = f"demo --out demo --preset smoke {few} --set device={pretended.DEVICE}"
    assert attempt(OTHERS)["code"] == 0
    found = []
    with pretended.pretended() as device, timed_in_few_frames():

        def work(words: str) -> None:
            device.counts.clear()
            found.append(attempt(words) | {"operations": device.counts["operations"]})

        work(demo)
        for command in wanted:
            for words in (words for words, _, _ in CASES[command] if not words.startswith("table")):
                work(words.format(demo="demo"))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
