"""Methods whose process comes to harm, for tests of executors. What they left on disk tells what happened."""

import errno
import os
import signal
import time
from dataclasses import replace

from toy_plugin import METHOD, ToyMethod


class Dying(ToyMethod):
    """Killed in its first training of each avatar, after a checkpoint."""

    kills = 1

    def fit(self, clip, out, budget, **arguments):
        out.mkdir(parents=True, exist_ok=True)
        with (out / "starts.log").open("a") as stream:
            stream.write("x")
        if (out / "starts.log").stat().st_size <= self.kills:
            print("about to be killed", flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        return super().fit(clip, out, budget, **arguments)


class AlwaysDying(Dying):
    kills = 1000


class FullDisk(ToyMethod):
    def fit(self, clip, out, budget, **arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out / "level.txt"))


class FailingOnce(ToyMethod):
    def fit(self, clip, out, budget, **arguments):
        out.mkdir(parents=True, exist_ok=True)
        if not (out / "starts.log").exists():
            (out / "starts.log").touch()
            raise RuntimeError("the first training diverged")
        return super().fit(clip, out, budget, **arguments)


class Slow(ToyMethod):
    """Trains until a file `go` lies in the working directory."""

    def fit(self, clip, out, budget, **arguments):
        out.mkdir(parents=True, exist_ok=True)
        with (out / "starts.log").open("a") as stream:
            stream.write("x")
        while not os.path.exists("go"):
            time.sleep(0.02)
        return super().fit(clip, out, budget, **arguments)


DYING = replace(METHOD, name="dying", implementation="dying_plugin:Dying")
ALWAYS = replace(METHOD, name="always", implementation="dying_plugin:AlwaysDying")
FULL = replace(METHOD, name="full", implementation="dying_plugin:FullDisk")
FAILING_ONCE = replace(METHOD, name="once", implementation="dying_plugin:FailingOnce")
SLOW = replace(METHOD, name="slow", implementation="dying_plugin:Slow")
