"""Methods that change or read what they must not; each is a subclass of the toy method."""

import os
import resource
import signal
import socket
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from toy_plugin import METHOD, ToyAvatar, ToyConfig, ToyMethod

from headbench.bench.contracts import Frame


class Attack(ToyMethod):
    """Trains as the toy method does, after ``attack``; its frames are those of ``drawn``."""

    def attack(self, clip, out):
        pass

    def fit(self, clip, out, budget, **arguments):
        self.attack(clip, out)
        return super().fit(clip, out, budget, **arguments)

    def load(self, path, *, device):
        avatar = Attacked(path)
        avatar.attack = self
        return avatar

    def drawn(self, frame, camera, pose):
        return frame


class Attacked(ToyAvatar):
    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        return self.attack.drawn(super().render(camera, pose, background), camera, pose)


def found(out, text):
    """Record what an attack obtained, where the test finds it."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "found.txt").write_text(str(text))


class ScalesCamera(Attack):
    def drawn(self, frame, camera, pose):
        camera.K[:] /= 2
        return frame


class ScalesCameraByForce(Attack):
    def drawn(self, frame, camera, pose):
        camera.K.flags.writeable = True
        camera.K[:] /= 2
        return frame


class ZeroesExpression(Attack):
    def drawn(self, frame, camera, pose):
        pose.expression[:] = 0
        return frame


class EmptiesClip(Attack):
    def attack(self, clip, out):
        clip.poses.clear()


class PaintsTrainingImages(Attack):
    def attack(self, clip, out):
        clip.image(clip.splits["train"][0])[:] = 0


class PaintsByForce(Attack):
    def attack(self, clip, out):
        clip.image(clip.splits["train"][0]).flags.writeable = True


class ReplacesClip(Attack):
    def attack(self, clip, out):
        found(out, clip._clip.image(clip.splits["novel_view"][0]))


class NotANumber(Attack):
    def drawn(self, frame, camera, pose):
        return Frame(frame.rgb, np.full_like(frame.alpha, np.nan))


class TooBright(Attack):
    def drawn(self, frame, camera, pose):
        return Frame(np.full_like(frame.rgb, 1e30), frame.alpha)


class ReadsClosure(Attack):
    """Finds the clip of the run in memory, which works in one process."""

    def attack(self, clip, out):
        cells = [cell.cell_contents for cell in clip.image.__closure__]
        whole = next(each for each in cells if hasattr(each, "splits"))
        found(out, whole.image(clip.splits["novel_view"][0])[0, 0, 0])


class ShowsTruth(ReadsClosure):
    """Renders the test images, which it finds in memory."""

    def drawn(self, frame, camera, pose):
        level = 40 + 10 * pose.timestep + (camera.id == "b")
        return Frame(np.full_like(frame.rgb, level / 255), frame.alpha)


class AsksForTestImage(Attack):
    def attack(self, clip, out):
        found(out, clip.image(clip.splits["novel_view"][0])[0, 0, 0])


class ReadsCapture(Attack):
    def attack(self, clip, out):
        found(out, Path(os.environ["ATTACKED"], "secret.txt").read_text())


class ReadsByDefault(ReadsCapture):
    """Names everything in a default of its settings."""


@dataclass(frozen=True)
class Everything(ToyConfig):
    weights: str = "/"


class ReadsDisk(Attack):
    def attack(self, clip, out):
        with open(os.environ["ATTACKED_DISK"], "rb") as disk:
            found(out, disk.read(16))


class ReadsParentMemory(Attack):
    def attack(self, clip, out):
        with open(f"/proc/{os.getppid()}/mem", "rb", 0) as memory:
            found(out, memory.fileno())


class OpensParentRoot(Attack):
    def attack(self, clip, out):
        found(out, Path(f"/proc/{os.getppid()}/root{os.environ['ATTACKED']}/secret.txt").read_text())


class WritesOutside(Attack):
    def attack(self, clip, out):
        Path(os.environ["ATTACKED"], "secret.txt").write_text("changed")


class Connects(Attack):
    def attack(self, clip, out):
        with socket.create_connection(("127.0.0.1", int(os.environ["ATTACKED_PORT"])), timeout=5):
            found(out, "connected")


class KillsParent(Attack):
    def attack(self, clip, out):
        os.kill(os.getppid(), signal.SIGUSR1)
        found(out, "sent")


class TakesProcessors(Attack):
    def attack(self, clip, out):
        os.sched_setaffinity(os.getppid(), {min(os.sched_getaffinity(0))})


class TakesFiles(Attack):
    def attack(self, clip, out):
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.prlimit(os.getppid(), resource.RLIMIT_NOFILE, (soft - 1, hard))


class NamesOutside(Attack):
    def load(self, path, *, device):
        avatar = super().load(path, device=device)
        avatar.files = lambda: [Path(os.environ["ATTACKED"], "secret.txt")]
        return avatar


class Shares(Attack):
    def load(self, path, *, device):
        avatar = super().load(path, device=device)
        avatar.shared_files = lambda: [Path(np.__file__)]
        return avatar


class Wordless(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class RaisesWordless(Attack):
    def attack(self, clip, out):
        raise Wordless


class LinksCapture(Attack):
    """Lets the folder of the avatar lead to the capture, which the process of the rendering might follow."""

    def attack(self, clip, out):
        (out / "link.txt").symlink_to(Path(os.environ["ATTACKED"], "secret.txt"))

    def drawn(self, frame, camera, pose):
        raise RuntimeError(f"read {(self.path / 'link.txt').read_text()}")

    def load(self, path, *, device):
        self.path = path
        return super().load(path, device=device)


class DrawsCapture(Attack):
    def drawn(self, frame, camera, pose):
        raise RuntimeError(f"read {Path(os.environ['ATTACKED'], 'secret.txt').read_text()}")


class SendsNonsense(Attack):
    def attack(self, clip, out):
        clip._connection.send_bytes(b'[{"done": null}, {"x": ["float32", [99999999999]]}]')
        time.sleep(60)


class SendsPickle(Attack):
    def attack(self, clip, out):
        clip._connection.send_bytes(b"cos\nsystem\n(S'touch /tmp/x'\ntR.")
        time.sleep(60)


class Ends(Attack):
    def attack(self, clip, out):
        os._exit(7)


class LeavesChild(Attack):
    def attack(self, clip, out):
        child = os.fork()
        if child == 0:
            time.sleep(600)
            os._exit(0)
        found(out, child)


class LeavesDaemon(Attack):
    """Leaves a process in another session, whose parent has ended."""

    def attack(self, clip, out):
        reader, writer = os.pipe()
        if os.fork() == 0:
            os.setsid()
            daemon = os.fork()
            if daemon == 0:
                time.sleep(600)
            os.write(writer, str(daemon).encode())
            os._exit(0)
        os.wait()
        found(out, os.read(reader, 20).decode())


def spec(name):
    """The registry entry of an attack."""
    return replace(METHOD, name=name.lower(), implementation=f"attacks:{name}")


for _name, _kind in list(vars(sys.modules[__name__]).items()):
    if isinstance(_kind, type) and issubclass(_kind, Attack):
        globals()[_name.upper()] = spec(_name)

READSBYDEFAULT = replace(READSBYDEFAULT, config="attacks:Everything")  # noqa: F821
