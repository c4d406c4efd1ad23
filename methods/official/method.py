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
from ...bench.process import ProgramEnd, described, run_program
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

TRAINING, RENDERING = "training", "rendering"
"""Temporary folders inside the avatar's, for training and for rendering."""
TRAINING_LOG, RENDERING_LOG = "training.log", "rendering.log"
EXPORTED = "exported.json"
PLAN, LAUNCHER = "plan.json", Path(__file__).parent / "shim" / "launch.py"

Patch = tuple[str, str, str]
"""A source file of theirs, a text in it, and its replacement when the file is run."""

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
        """The input folder as an absolute path, since the program has another working directory."""
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

    A derived class defines spec and repository, export of clips, commands to run, output to keep, and location of
    renders.
    """

    name: ClassVar[str]
    version: ClassVar[str]
    config_class: ClassVar[Any]
    repository: ClassVar[Repository]
    shimmed: ClassVar[Literal["", "bound splats", "blendshapes"]] = ""
    """Kind of code for `shim`; "" if it does not support the repository."""
    variables: ClassVar[Mapping[str, str]] = {}
    """Environment variables of the authors' programs besides `process.environment`."""

    def __init__(self, config: Config | None = None):
        self.config: Config = config or self.config_class()

    # ------------------------------------------------------------------ what a repository needs

    @abstractmethod
    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Raise `InputError` for a clip that the repository's code does not support."""

    def check_length(self, iterations: int, checkout: Checkout) -> None:
        """Raise `InputError` for a length of the run that the repository's code does not support."""

    @abstractmethod
    def export(
        self, clip: Clip, checkout: Checkout, work: Workplace, progress: Progress
    ) -> dict[str, FrameKey]:
        """Write the training frames in the repository's format; return the key of every image, by path in the input."""

    @abstractmethod
    def train_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str]:
        """The training command."""

    def shrink_command(self, fit: Fit, checkout: Checkout, work: Workplace) -> list[str] | None:
        """A command, run after training, that removes data from its output that rendering never reads."""
        return None

    @abstractmethod
    def done(self, line: str) -> tuple[int, str] | None:
        """Iterations done and a short status, if a line of the training's output has them."""

    @abstractmethod
    def keep(self, fit: Fit, work: Workplace) -> dict[str, Any]:
        """Move the output needed for rendering into the avatar's folder; return entries for the record.

        Subject and head model are written beside it.
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
        """Write the frames to render, in order, in the repository's format."""

    @abstractmethod
    def render_command(self, folder: Path, checkout: Checkout, work: Workplace) -> list[str]:
        """The render command."""

    @abstractmethod
    def drawn(self, line: str) -> int | None:
        """Frames drawn, if a line of the renderer's output has their number."""

    @abstractmethod
    def render_folder(self, folder: Path, work: Workplace) -> Path:
        """Folder of the renders."""

    @abstractmethod
    def render_name(self, number: int) -> str:
        """File name of a render by its number in the list, according to the repository."""

    def is_render(self, name: str) -> bool:
        """Whether a file in the folder of the renders is one of them, since the program may write other files there."""
        return True

    @abstractmethod
    def read_back(self, frame: Listed, path: Path, work: Workplace) -> Frame:
        """A render for its camera. Raises `InputError` for a render of another size or frame."""

    def excused(self, ended: ProgramEnd) -> bool:
        """Whether a failed renderer failed after all frames were rendered."""
        return False

    def remarks(self, clip: Clip, seed: int) -> dict[str, list[str]]:
        """For the record: ``leaks`` of held-out data, and ``differences`` from the published code."""
        return {"leaks": [], "differences": []}

    def changes(self) -> list[Patch]:
        """Texts in their sources that every training replaces in memory, for what no option of theirs allows."""
        return []

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Texts in their sources that the CPU shim replaces in memory for a training with this number of iterations."""
        return []

    def patches_to_render(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """The same for rendering an avatar."""
        return []

    def patches_for_order(self) -> list[Patch]:
        """Texts replaced for a given order of the images, in code that draws images without a loader."""
        return []

    def image_name(self, path: str) -> str:
        """Name of an exported image in their loader, by its position."""
        return Path(path).name

    # ------------------------------------------------------------------ the method

    def check_launch(self) -> None:
        """Raise `InputError` if the shim or an order of the images is requested for code that does not support it."""
        asked = {"device": (self.config.device, "cuda"), "order": (self.config.order, "published")}
        for name, (value, only) in asked.items():
            if value != only and not self.shimmed:
                expected = f"{only}; the shim does not support this code"
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
        """A command of theirs, run by the launcher if its sources have to be changed."""
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
        """Names of the images in the order of the native method with this seed, one for each iteration; empty for their order."""
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
                "run on a CPU with headbench's renderer instead of their CUDA rasteriser (cpu-shim): not the original"
            )
        if self.config.order == "native":
            differences.append("images in the order in which the native method draws them with this seed")
        return differences + [f"{file}: {old!r} read as {new!r}" for file, old, new in patches]

    def inspect(self) -> Checkout:
        """Check the settings; see `checkout.inspect_checkout`."""
        return inspect_checkout(self.name, self.config, self.repository, self.inspect_environment)

    def inspect_environment(self) -> Environment:
        """Check the interpreter or program that runs their code."""
        return inspect_interpreter(self.name, self.config, self.repository, shim=bool(self.shimmed))

    def check(self, clip: Clip | None, budget: Budget) -> None:
        """Raise `InputError` for a missing checkout or interpreter, and for a clip or budget that the code does not support."""
        self._checked(clip, budget)

    def _checked(self, clip: Clip | None, budget: Budget) -> Checkout:
        check_budget(budget)
        if budget.iterations is None or budget.seconds is not None:
            remedy = f"--set settings.{self.name}.budget.iterations=N, and no seconds."
            raise InputError(
                "budget", "seconds", "only iterations, since their code has no time limit", "seconds", remedy
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

        After a kill the training restarts on the existing export, since the repositories' checkpoints do not allow an
        exact continuation. Raises `InputError` before any work for what `check` refuses and for a budget in seconds,
        and `ProgramError` if the program fails.
        """
        run = run_digest(self.name, self.version, self.config, clip, budget, seed)
        if not is_finished(out, run):
            checkout = self._checked(clip, budget)
            with _alone(out / TRAINING) as held:
                self._train(Fit(clip, out, budget, self.config.device, seed, progress, run), checkout, held)
        _remove(out / TRAINING)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> OfficialAvatar:
        """Read an avatar that `fit` wrote; the checkout is validated when frames are requested."""
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
        patches = self.changes() + (self.patches(fit.clip.head, iterations, checkout) if shim else [])
        patches += self.patches_for_order() if self.config.order == "native" else []
        command = self._launched(
            [*command, *self.config.arguments],
            checkout,
            work,
            patches=patches,
            order=self._order(fit, work),
        )
        shrinking = self.shrink_command(fit, checkout, work)
        commands = [(command, f"The training command of {checkout.folder}")]
        commands += [] if shrinking is None else [(shrinking, "Leaving the optimiser out of its output")]
        ends = []
        for each, what in commands:
            ended = run_program(
                each,
                work.program,
                fit.out / TRAINING_LOG,
                on_line,
                variables=self.variables,
                held=held,
                hours=self.config.time_limit_hours,
            )
            if ended.code:
                raise ended.error(f"{what} {described(ended.code)}")
            ends.append(ended)
        try:
            kept = self.keep(fit, work)
            write_subject(fit.out / SUBJECT_FILE, Subject.of(fit.clip))
            save_shared_head(fit.out, fit.clip.head)
        except (InputError, OSError) as error:
            raise ends[0].error(
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
        """Write the program's input, or reuse that of an earlier call if it is complete; then compare it with the
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
        """Files of the subject that the authors' program needs for rendering, without the driving signal."""
        return self._method.files(self._folder)

    def shared_files(self) -> Sequence[Path]:
        """Further files, the same for every subject, without the checkout."""
        return self._method.shared_files(self._folder)

    def render(self, camera: Camera, pose: HeadPose, background: Sequence[float] = (1.0, 1.0, 1.0)) -> Frame:
        """Single frames are not supported: raises `UnavailableError`, see `ListedFrames`."""
        raise UnavailableError(
            f"{self._method.name} renders lists of frames by the authors' program, not single frames.",
            "Use the native method of the same paper.",
        )

    def render_listed(
        self,
        views: Mapping[FrameKey, tuple[Camera, HeadPose]],
        background: Sequence[float],
        progress: Progress,
    ) -> Iterator[tuple[FrameKey, Frame]]:
        """Render frames by the authors' program; yield each with its key. See `ListedFrames`."""
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
                command,
                work.program,
                folder / RENDERING_LOG,
                on_line,
                variables=method.variables,
                held=held,
                hours=method.config.time_limit_hours,
            )
            if ended.code and not method.excused(ended):
                raise ended.error(f"The render command of {checkout.folder} {described(ended.code)}")
            yield from _read_back(method, folder, frames, work, ended)
        _remove(work.root)


def _read_back(
    method: OfficialMethod[Any], folder: Path, frames: Sequence[Listed], work: Workplace, ended: ProgramEnd
) -> Iterator[tuple[FrameKey, Frame]]:
    """Renders by the names of the index. Raises `InputError` unless these and no others exist."""
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
    """Verify that the program gets only training frames.

    Every image in the program's folders is one that was exported for a training key, each equally often, or a
    placeholder, which has a single pixel and shows no frame. `clip` gives no pixels of other frames
    (`headbench.bench.engine.guard.TrainingView`), so that none can have such a name.

    Raises `InputError` for an image of another frame, one that was not exported, and a missing one.
    """
    allowed = frozenset(clip.splits["train"])
    for path, key in images.items():
        if key not in allowed:
            raise InputError(work.root / path, str(key), "a training frame", "a held-out one")
    if len(set(Counter(images.values()).values())) > 1:
        expected, found = "as many images of each training frame", "different numbers"
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
    """Write a placeholder for an image that a loader requires: one pixel, black and transparent."""
    write_image(path, np.zeros((1, 1, 4), np.uint8))


def _is_placeholder(path: Path) -> bool:
    if path.suffix != ".png" or path.is_symlink():
        return False
    info = probe_image(path)
    return (info.width, info.height) == (1, 1)


_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".exr", ".mp4", ".avi", ".mkv")
_LOCK = "program.lock"


def _files(work: Workplace) -> list[str]:
    """Files of the program's input and working directory, by path."""
    folders = (work.input, work.program)
    found = (path for folder in folders for path in folder.rglob("*") if path.is_file() or path.is_symlink())
    return sorted(path.relative_to(work.root).as_posix() for path in found)


def _as_recorded(record: Path, work: Workplace) -> bool:
    """Whether all exported files exist unchanged."""
    files = read_json(record).get("files", {})
    return files.keys() <= set(_files(work)) and all(
        digest_file(work.root / path) == known for path, known in files.items()
    )


@contextmanager
def _alone(folder: Path) -> Iterator[IO[str]]:
    """Make a folder and hold its lock; a program that inherits the lock keeps it if this process is killed.

    Raises `InputError` if a program of an earlier call still runs.
    """
    check_output_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK).open("a+") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            stream.seek(0)
            started = stream.read(200).strip()
            remedy = "Wait until it ends, or terminate it."
            found = f"one of an earlier call ({started})"
            raise InputError(folder, "", "no running program", found, remedy) from None
        stream.truncate(0)
        stream.write(f"started by process {os.getpid()}")
        stream.flush()
        yield stream


def _remove(folder: Path, but: str = "") -> None:
    """Remove a folder, or everything in it except one name."""
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
