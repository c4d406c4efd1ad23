"""Common code of official methods: check, export, train and render by the authors' program, read back by
key."""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np

from ...bench.contracts import (
    Budget,
    Camera,
    Clip,
    FloatArray,
    Frame,
    FrameKey,
    HeadAsset,
    HeadPose,
    Progress,
)
from ...bench.errors import InputError, UnavailableError
from ...bench.io.documents import read_json
from ...bench.io.files import check_output_folder, digest_file, write_json
from ...bench.io.images import probe_image
from ...datasets.images import write_image
from ..shared.avatar_files import (
    HEAD_FILE,
    SUBJECT_FILE,
    Subject,
    is_finished,
    run_digest,
    save_shared_head,
    write_record,
    write_subject,
)
from ..shared.loop import Fit, TrainingSummary, check_budget, check_training_split
from ..shared.schedule import ShuffledEpochs
from ..shared.threads import threads
from .checkout import Checkout, Environment, Repository, inspect_checkout, inspect_interpreter
from .config import OfficialConfig
from .process import ProgramEnd, described, run_program

TRAINING, RENDERING = "training", "rendering"
"""Folders inside the avatar's: of a training under way, and of frames being rendered. Neither outlives its work."""
TRAINING_LOG, RENDERING_LOG = "training.log", "rendering.log"
EXPORTED = "exported.json"
PLAN, LAUNCHER = "plan.json", Path(__file__).parent / "shim" / "launch.py"

Patch = tuple[str, str, str]
"""A source file of theirs, a text in it, and what stands there instead when it is run."""

INDEX = "index.json"

Config = TypeVar("Config", bound=OfficialConfig)


@dataclass(frozen=True)
class Workplace:
    """Folders of one call of the authors' program.

    Attributes
    ----------
    input : Path
        The capture in the repository's own format.
    program : Path
        The program's working directory, with the files that it expects; the checkout is not modified.
    """

    root: Path

    @classmethod
    def at(cls, root: Path) -> Workplace:
        """Input with absolute paths, since the program has another working directory."""
        return cls(root.absolute())

    @property
    def input(self) -> Path:
        return self.root / "input"

    @property
    def program(self) -> Path:
        return self.root / "program"

    @property
    def model(self) -> Path:
        return self.root / "model"

    def make(self) -> None:
        """Make the folders."""
        for folder in (self.input, self.program, self.model):
            folder.mkdir(parents=True, exist_ok=True)


@dataclass(frozen=True)
class Listed:
    """A frame to render: its number in the program's list, its key, camera and pose."""

    number: int
    key: FrameKey
    camera: Camera
    pose: HeadPose


class OfficialMethod(ABC, Generic[Config]):
    """A `CheckedMethod` around an official repository.

    A derived class names its spec and repository, and says how a clip is exported, which commands are run, what of the
    program's output has to be kept, and where its renders are.
    """

    name: ClassVar[str]
    version: ClassVar[str]
    config_class: ClassVar[Any]
    repository: ClassVar[Repository]
    shimmed: ClassVar[Literal["", "bound splats", "blendshapes"]] = ""
    """Which code `shim` has to stand in for things of; "" where it is not made for the repository."""
    variables: ClassVar[Mapping[str, str]] = {}
    """Variables of the environment that the authors' programs need besides `process.environment`."""

    def __init__(self, config: Config | None = None):
        self.config: Config = config or self.config_class()

    # ------------------------------------------------------------------ what a repository needs

    @abstractmethod
    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Raise `InputError` for a clip that the repository's code cannot take."""

    def check_length(self, iterations: int, checkout: Checkout) -> None:
        """Raise `InputError` for a run of a length that the repository's code cannot make sense of."""

    @abstractmethod
    def export(
        self, clip: Clip, checkout: Checkout, work: Workplace, progress: Progress
    ) -> dict[str, FrameKey]:
        """Write the training frames in the repository's form; return the key of every image, by place in the input."""

    @abstractmethod
    def train_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str]:
        """The training command."""

    def shrink_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str] | None:
        """A command, run when training has ended, that leaves out of its output what rendering never reads."""
        return None

    @abstractmethod
    def done(self, line: str) -> tuple[int, str] | None:
        """Iterations done and a few words, where a line of the training's output tells."""

    @abstractmethod
    def keep(self, fit: Fit, work: Workplace) -> dict[str, Any]:
        """Put what rendering needs of the program's output into the avatar's folder; return more for the record.

        Subject and head model are put beside it.
        """

    @abstractmethod
    def files(self, folder: Path) -> list[Path]:
        """The subject's files that rendering needs."""

    def shared_files(self, folder: Path) -> list[Path]:
        """The head model."""
        return [folder / HEAD_FILE]

    @abstractmethod
    def write_list(
        self,
        folder: Path,
        frames: Sequence[Listed],
        background: Sequence[float],
        checkout: Checkout,
        work: Workplace,
    ) -> None:
        """Write the frames to render, in order, in the repository's form."""

    @abstractmethod
    def render_command(self, folder: Path, checkout: Checkout, work: Workplace) -> list[str]:
        """The render command."""

    @abstractmethod
    def drawn(self, line: str) -> int | None:
        """Frames drawn, where a line of the renderer's output tells."""

    @abstractmethod
    def render_folder(self, folder: Path, work: Workplace) -> Path:
        """Folder of the renders."""

    @abstractmethod
    def render_name(self, number: int) -> str:
        """File name of a render, by its number in the list: the repository's rule."""

    def is_render(self, name: str) -> bool:
        """Whether a file beside the renders is one of them: the program may write more into that folder."""
        return True

    @abstractmethod
    def read_back(self, frame: Listed, path: Path, work: Workplace) -> Frame:
        """A render as the camera asked for it. Raises `InputError` for one of another size or of another frame."""

    def excused(self, ended: ProgramEnd) -> bool:
        """Whether a renderer that failed has failed after its work was done."""
        return False

    def remarks(self, clip: Clip, seed: int) -> dict[str, list[str]]:
        """For the record: ``leaks`` of held-out data, and ``differences`` from the published code."""
        return {"leaks": [], "differences": []}

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Texts of their sources that the CPU shim replaces in memory for a training with this number of
        iterations."""
        return []

    def patches_to_render(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """The same for rendering an avatar."""
        return []

    def patches_for_order(self) -> list[Patch]:
        """Texts that are replaced where the order of the images is given, in code that draws them without a loader."""
        return []

    def image_name(self, path: str) -> str:
        """Name of an exported image in their loader, by its position."""
        return Path(path).name

    # ------------------------------------------------------------------ the method

    def check_launch(self) -> None:
        """Raise `InputError` where the shim, or an order of the images, is asked of code that neither is made for."""
        asked = {"device": (self.config.device, "cuda"), "order": (self.config.order, "published")}
        for name, (value, only) in asked.items():
            if value != only and not self.shimmed:
                expected = f"{only}; the shim does not know what this code needs"
                raise InputError(f"settings.{self.name}", name, expected, value)

    def _launched(
        self,
        command: Sequence[str],
        checkout: Checkout,
        work: Workplace,
        *,
        patches: Sequence[Patch],
        order: Sequence[str] = (),
    ) -> list[str]:
        """A command of theirs, by way of our launcher where there is something to do before."""
        shim = self.config.device != "cuda"
        if not (shim or patches or order):
            return list(command)
        plan = {
            "shim": self.shimmed if shim else "",
            "threads": threads(),
            "patches": list(patches),
            "order": list(order),
        }
        write_json(work.root / PLAN, plan)
        shutil.copyfile(LAUNCHER, work.root / LAUNCHER.name)
        python, script = command[: len(checkout.python)], command[len(checkout.python) :]
        return [*python, str(work.root / LAUNCHER.name), str(work.root / PLAN), *script]

    def _order(self, fit: Fit, work: Workplace) -> list[str]:
        """Names of the images that the native method takes with this seed, one for each iteration; empty for theirs."""
        if self.config.order == "published":
            return []
        images = read_json(work.root / EXPORTED)["images"]
        names = {FrameKey(*key): self.image_name(path) for path, key in images.items()}
        keys = fit.clip.splits["train"]
        sampler = ShuffledEpochs(len(keys), fit.seed)
        return [names[keys[sampler(i)]] for i in range(1, (fit.budget.iterations or 0) + 1)]

    def _of_launch(self, patches: Sequence[Patch]) -> list[str]:
        """Changes by the launcher, for the record."""
        differences = []
        if self.config.device != "cuda":
            differences.append(
                "run on a CPU by our renderer in place of their CUDA rasteriser (cpu-shim): not the original"
            )
        if self.config.order == "native":
            differences.append("images in the order in which the native method draws them with this seed")
        return differences + [f"{file}: {old!r} read as {new!r}" for file, old, new in patches]

    def inspect(self) -> Checkout:
        """Check the settings; see `checkout.inspect_checkout`."""
        return inspect_checkout(self.name, self.config, self.repository, self.inspect_environment)

    def inspect_environment(self) -> Environment:
        """Check what runs their code: an interpreter, by default."""
        return inspect_interpreter(self.name, self.config, self.repository)

    def check(self, clip: Clip | None, budget: Budget) -> None:
        """Raise `InputError` for a checkout or an interpreter that is not there, and work that the code cannot do."""
        self._checked(clip, budget)

    def _checked(self, clip: Clip | None, budget: Budget) -> Checkout:
        check_budget(budget)
        if budget.iterations is None or budget.seconds is not None:
            remedy = f"--set settings.{self.name}.budget.iterations=N, and no seconds."
            raise InputError(
                "budget", "seconds", "iterations alone; their code knows no clock", "seconds", remedy
            )
        self.check_launch()
        checkout = self.inspect()
        self.check_length(budget.iterations, checkout)
        if clip is not None:
            check_training_split(clip)
            self.check_clip(clip, checkout)
        return checkout

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> OfficialAvatar:
        """Export the training frames, run the authors' training on them, and keep what rendering needs.

        After a kill the training begins anew, on the export that is there: the repositories' checkpoints lack what it would
        need to go on as it was. Raises `InputError` before any work for what `check` refuses and a budget in seconds, `ProgramError`
        where the program fails.
        """
        run = run_digest(self.name, self.version, self.config, clip, budget, seed)
        if not is_finished(out, run):
            checkout = self._checked(clip, budget)
            with _alone(out / TRAINING) as held:
                self._train(Fit(clip, out, budget, self.config.device, seed, progress, run), checkout, held)
        _remove(out / TRAINING)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> OfficialAvatar:
        """Read an avatar that `fit` wrote; the checkout is looked at when frames are asked for."""
        avatar = OfficialAvatar(self, path)
        for file in avatar.files():
            if not file.is_file():
                raise InputError(file, "", f"a file of an avatar of {self.name}", "no such file")
        return avatar

    def _train(self, fit: Fit, checkout: Checkout, held: IO[str]) -> None:
        work, start = Workplace.at(fit.out / TRAINING), time.monotonic()
        frames, iterations = len(fit.clip.splits["train"]), fit.budget.iterations or 0
        self._export(fit, checkout, work)
        command = self.train_command(fit, checkout, work)
        _remove(work.model)
        work.make()

        def on_line(line: str) -> None:
            found = self.done(line)
            if found is not None:
                fit.progress(frames + min(found[0], iterations), frames + iterations, found[1])

        shim = self.config.device != "cuda"
        patches = self.patches(fit.clip.head, iterations, checkout) if shim else []
        patches += self.patches_for_order() if self.config.order == "native" else []
        command = self._launched(
            [*command, *self.config.arguments],
            checkout,
            work,
            patches=patches,
            order=self._order(fit, work),
        )
        ended = run_program(
            command, work.program, fit.out / TRAINING_LOG, on_line, variables=self.variables, held=held
        )
        if ended.code:
            raise ended.error(f"The training command of {checkout.folder} {described(ended.code)}")
        shrinking = self.shrink_command(fit, checkout, work)
        if shrinking is not None:
            shrunk = run_program(
                shrinking, work.program, fit.out / TRAINING_LOG, on_line, variables=self.variables, held=held
            )
            if shrunk.code:
                raise shrunk.error(f"Leaving the optimiser out of its output {described(shrunk.code)}")
        try:
            kept = self.keep(fit, work)
            write_subject(fit.out / SUBJECT_FILE, Subject.of(fit.clip))
            save_shared_head(fit.out, fit.clip.head)
        except (InputError, OSError) as error:
            raise ended.error(
                f"The training command of {checkout.folder} left no whole avatar: {error}"
            ) from error
        fit.progress(frames + iterations, frames + iterations)
        official = {
            **checkout.record,
            "device": self.config.device,
            "arguments": list(self.config.arguments),
        }
        remarks = self.remarks(fit.clip, fit.seed)
        remarks["differences"] += self._of_launch(patches)
        recorded = {**remarks, "official": official, **kept}
        write_record(fit, TrainingSummary(iterations, iterations, time.monotonic() - start), **recorded)

    def _export(self, fit: Fit, checkout: Checkout, work: Workplace) -> None:
        """Write the program's input, or keep the complete one of an earlier call; then compare it with the
        training split."""
        record = work.root / EXPORTED
        steps = len(fit.clip.splits["train"]) + (fit.budget.iterations or 0)

        def exporting(done: int, total: int, note: str = "") -> None:
            fit.progress(done, steps, note or "exporting")

        if not (record.exists() and read_json(record).get("run") == fit.run and _as_recorded(record, work)):
            for folder in (work.input, work.program, work.model):
                _remove(folder)
            record.unlink(missing_ok=True)
            work.make()
            images = self.export(fit.clip, checkout, work, exporting)
            digests = {path: digest_file(work.root / path) for path in _files(work)}
            named = {path: list(key) for path, key in images.items()}
            write_json(record, {"run": fit.run, "images": named, "files": digests})
        check_export(work, {p: FrameKey(*key) for p, key in read_json(record)["images"].items()}, fit.clip)


class OfficialAvatar:
    """A trained avatar of an official repository (`ListedFrames`, `SharingAvatar`)."""

    def __init__(self, method: OfficialMethod[Any], folder: Path):
        self._method, self._folder = method, folder

    def files(self) -> Sequence[Path]:
        """Files of the subject that the authors' program needs to render; the driving signal does not count."""
        return self._method.files(self._folder)

    def shared_files(self) -> Sequence[Path]:
        """Files that it needs besides, the same for every subject; not their checkout."""
        return self._method.shared_files(self._folder)

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Never a single frame: raises `UnavailableError`, see `ListedFrames`."""
        raise UnavailableError(
            f"{self._method.name} renders lists of frames by the authors' program, never one frame on its own.",
            "The native method of the same paper can be measured so.",
        )

    def render_listed(
        self,
        views: Mapping[FrameKey, tuple[Camera, HeadPose]],
        background: Sequence[float],
        progress: Progress,
    ) -> Iterator[tuple[FrameKey, Frame]]:
        """Render frames by the authors' program; give each with its key. See `ListedFrames`."""
        method, folder = self._method, self._folder
        checkout = method.inspect()
        frames = [Listed(number, key, *view) for number, (key, view) in enumerate(views.items())]
        work = Workplace.at(folder / RENDERING)
        with _alone(work.root) as held:
            _remove(work.root, but=_LOCK)
            work.make()
            write_json(work.root / INDEX, {method.render_name(f.number): list(f.key) for f in frames})
            method.write_list(folder, frames, background, checkout, work)

            def on_line(line: str) -> None:
                drawn = method.drawn(line)
                if drawn is not None:
                    progress(min(drawn, len(frames)), len(frames))

            command = method._launched(
                method.render_command(folder, checkout, work),
                checkout,
                work,
                patches=method.patches_to_render(folder, checkout) if method.config.device != "cuda" else [],
            )
            ended = run_program(
                command, work.program, folder / RENDERING_LOG, on_line, variables=method.variables, held=held
            )
            if ended.code and not method.excused(ended):
                raise ended.error(f"The render command of {checkout.folder} {described(ended.code)}")
            yield from _read_back(method, folder, frames, work, ended)
        _remove(work.root)


def _read_back(
    method: OfficialMethod[Any], folder: Path, frames: Sequence[Listed], work: Workplace, ended: ProgramEnd
) -> Iterator[tuple[FrameKey, Frame]]:
    """Renders by the names of the index that was written before; all are there and none besides."""
    renders = method.render_folder(folder, work)
    index = {name: FrameKey(*key) for name, key in read_json(work.root / INDEX).items()}
    found = {path.name for path in renders.iterdir()} if renders.is_dir() else set()
    found = {name for name in found if method.is_render(name)}
    for what, names in (("lacks", index.keys() - found), ("has besides", found - index.keys())):
        if names:
            first = min(names)
            named = f" ({index[first]})" if first in index else ""
            raise ended.error(f"{renders} {what} {len(names)} of {len(index)} renders, first {first}{named}")
    by_key = {frame.key: frame for frame in frames}
    for name, key in index.items():
        try:
            frame = method.read_back(by_key[key], renders / name, work)
        except InputError as error:
            raise ended.error(str(error)) from error
        yield key, frame


def check_export(work: Workplace, images: Mapping[str, FrameKey], clip: Clip) -> None:
    """Prove that the program is given training frames alone.

    Every image under the program's folders is one that was exported for a training key, each as often, or a placeholder,
    which has a single pixel and so shows no frame. `clip` gives no pixels of other frames
    (`headbench.bench.engine.adaptation.TrainingView`), so that none can stand under such a name.

    Raises `InputError` for an image of another frame, one that nobody exported, and one that is gone.
    """
    allowed = frozenset(clip.splits["train"])
    for path, key in images.items():
        if key not in allowed:
            raise InputError(work.root / path, str(key), "a training frame", "a held-out one")
    if len(set(Counter(images.values()).values())) > 1:
        expected, found = "as many images of each training frame", "more of one than of another"
        raise InputError(work.root, "images", expected, found)
    there = {path for path in _files(work) if Path(path).suffix.lower() in _IMAGES}
    there -= {path for path in there - images.keys() if _is_placeholder(work.root / path)}
    for what, names in (
        ("an exported image", images.keys() - there),
        ("exported images alone", there - images.keys()),
    ):
        if names:
            raise InputError(
                work.root / min(names), "", what, "none" if what.startswith("an ") else "another image"
            )


def write_placeholder(path: Path) -> None:
    """Write what stands for an image that a loader insists on: one pixel, black and transparent."""
    write_image(path, np.zeros((1, 1, 4), np.uint8))


def _is_placeholder(path: Path) -> bool:
    if path.suffix != ".png" or path.is_symlink():
        return False
    info = probe_image(path)
    return (info.width, info.height) == (1, 1)


_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".exr", ".mp4", ".avi", ".mkv")
_LOCK = "program.lock"


def _files(work: Workplace) -> list[str]:
    """Files of the program's input and working directory, by their place."""
    folders = (work.input, work.program)
    found = (path for folder in folders for path in folder.rglob("*") if path.is_file() or path.is_symlink())
    return sorted(path.relative_to(work.root).as_posix() for path in found)


def _as_recorded(record: Path, work: Workplace) -> bool:
    """Whether everything that was exported is there as it was written."""
    files = read_json(record).get("files", {})
    return files.keys() <= set(_files(work)) and all(
        digest_file(work.root / path) == known for path, known in files.items()
    )


@contextmanager
def _alone(folder: Path) -> Iterator[IO[str]]:
    """Make a folder and hold its lock; a program that inherits it holds it on, should we be killed before it ends.

    Raises `InputError` where a program of an earlier call still runs.
    """
    check_output_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK).open("a+") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.seek(0)
            started = stream.read(200).strip()
            remedy = "Wait until it ends, or end it."
            found = f"one of an earlier call ({started})"
            raise InputError(folder, "", "no program at work there", found, remedy) from None
        stream.truncate(0)
        stream.write(f"started by process {os.getpid()}")
        stream.flush()
        yield stream


def _remove(folder: Path, but: str = "") -> None:
    """Remove a folder, or all in it but one name."""
    if not but:
        shutil.rmtree(folder, ignore_errors=True)
        return
    for path in folder.iterdir():
        if path.name != but:
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def opaque(rgb: np.ndarray) -> Frame:
    """A frame of an 8-bit image (H, W, 3) with unknown coverage."""
    return opaque_colours(rgb.astype(np.float32) / 255)


def opaque_colours(rgb: FloatArray) -> Frame:
    """A frame of colours (H, W, 3) in [0, 1] with unknown coverage."""
    return Frame(rgb, np.ones(rgb.shape[:2], np.float32))
