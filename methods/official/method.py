"""Common code of official methods: check, export, train and render with the authors' program, and read back frames by key."""

from __future__ import annotations

import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, ClassVar, Generic, Literal, TypeVar

from ...bench.contracts import Budget, Camera, Clip, Frame, FrameKey, HeadAsset, HeadPose, Progress
from ...bench.errors import InputError, UnavailableError
from ...bench.io.documents import read_json
from ...bench.io.files import write_json
from ...bench.process import ProgramEnd, described, run_program
from ..shared.avatar_files import (
    HEAD_FILE,
    SUBJECT_FILE,
    Subject,
    is_finished,
    read_shared_head,
    read_subject,
    run_digest,
    save_shared_head,
    write_record,
    write_subject,
)
from ..shared.loop import Fit, TrainingSummary, check_budget, check_training_split
from ..shared.schedule import ShuffledEpochs
from ..shared.threads import threads
from .checkout import Checkout, Environment, Repository, inspect_checkout, inspect_interpreter
from .spec import OfficialConfig
from .workplace import LOCK, Listed, Patch, Workplace, alone, check_export, remove, write_launcher

TRAINING, RENDERING = "training", "rendering"
"""Temporary folders inside the avatar's, for training and for rendering."""
TRAINING_LOG, RENDERING_LOG = "training.log", "rendering.log"
EXPORTED, INDEX = "exported.json", "index.json"
LAUNCHER = Path(__file__).parent / "shim" / "launch.py"

Config = TypeVar("Config", bound=OfficialConfig)


class OfficialMethod(ABC, Generic[Config]):
    """A `CheckedMethod` around an official repository.

    A derived class defines spec and repository, export of clips, commands to run, output to keep, and location of
    renders.
    """

    name: ClassVar[str]
    version: ClassVar[str]
    config_class: ClassVar[Any]
    repository: ClassVar[Repository]
    shimmed: ClassVar[Literal["", "bound splats", "blendshapes", "charted splats", "blended splats"]] = ""
    """Kind of code for `shim`; "" if it does not support the repository."""
    variables: ClassVar[Mapping[str, str]] = {}
    """Environment variables of the authors' programs besides `process.environment`."""
    changes: tuple[Patch, ...] = ()
    """Source patches applied in memory in every training, where the authors' code has no option."""
    order_changes: ClassVar[tuple[Patch, ...]] = ()
    """Source patches for a given order of images, for code that draws images without a loader."""
    iteration_line: ClassVar[str]
    """Regular expression of a line of their training: iterations done and, if it has them, the loss."""
    frame_line: ClassVar[str]
    """Regular expression of a line of their renderer: frames drawn."""
    avatar_files: ClassVar[tuple[str, ...]]
    """The subject's files that rendering needs."""
    render_folder: ClassVar[str] = "renders"
    """Folder of the renders inside the one of the model."""
    render_name: ClassVar[str] = "{:06d}.png"
    """File name of a render by its number in the list, according to the repository."""
    render_files: ClassVar[str] = "*"
    """Pattern of the names of renders, since the program may write other files into their folder."""
    starts_launcher: ClassVar[bool] = True
    """Whether the launcher that patches sources starts the render command itself, rather than the calls in it."""
    excused: ClassVar[str] = ""
    """Regular expression of a line of a renderer that failed after all frames were rendered; "" for none."""

    def __init__(self, config: Config | None = None):
        self.config: Config = config or self.config_class()

    # ------------------------------------------------------------------ specific to a repository

    @abstractmethod
    def check_clip(self, clip: Clip, checkout: Checkout) -> None:
        """Raise `InputError` for a clip that the repository's code does not support."""

    def check_length(self, iterations: int, checkout: Checkout) -> None:
        """Raise `InputError` for a length of the run that the repository's code does not support."""

    @abstractmethod
    def export(self, clip: Clip, work: Workplace, progress: Progress) -> dict[str, FrameKey]:
        """Write the training frames in the repository's format; return the key of every image, by path in the input."""

    @abstractmethod
    def train_command(self, fit: Fit, work: Workplace) -> list[str]:
        """The training command."""

    def shrink_command(self, fit: Fit, work: Workplace) -> list[str] | None:
        """A command, run after training, that removes data from its output that rendering never reads."""
        return None

    def done(self, line: str) -> tuple[int, str] | None:
        """Iterations done and a short status, if a line of the training's output has them."""
        match = re.search(self.iteration_line, line)
        return None if match is None else (int(match[1]), f"loss {match[2]}" if match.lastindex == 2 else "")

    @abstractmethod
    def keep(self, fit: Fit, work: Workplace) -> None:
        """Move the output needed for rendering into the avatar's folder; subject and head model are written beside it."""

    @abstractmethod
    def render_command(
        self, folder: Path, frames: Sequence[Listed], background: Sequence[float], work: Workplace
    ) -> list[str]:
        """Write the frames to render, in order, in the repository's format; return the command that renders them."""

    @abstractmethod
    def read_back(self, frame: Listed, path: Path, background: Sequence[float], work: Workplace) -> Frame:
        """A render for its camera."""

    def differences(self, clip: Clip, seed: int) -> list[str]:
        """Differences from the published code, for the record."""
        return []

    def patches(self, head: HeadAsset, iterations: int, checkout: Checkout) -> list[Patch]:
        """Source patches applied in memory with the CPU shim, for a training with this number of iterations."""
        return []

    def patches_to_render(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """The same for rendering an avatar."""
        return []

    def render_patches(self, folder: Path, checkout: Checkout) -> list[Patch]:
        """`patches_to_render` with the shim, else none."""
        return [] if self.config.device == "cuda" else self.patches_to_render(folder, checkout)

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

    def launched(
        self, command: Sequence[str], work: Workplace, patches: Sequence[Patch], order: Sequence[str] = ()
    ) -> list[str]:
        """A command of the authors' code, run by the launcher if sources have to be patched."""
        shim = self.config.device != "cuda"
        if not (shim or patches or order):
            return list(command)
        plan = {
            "shim": self.shimmed if shim else "",
            "threads": threads(),
            "patches": list(patches),
            "order": list(order),
        }
        count = len(work.checkout.python)
        return [*command[:count], *write_launcher(LAUNCHER, plan, work), *command[count:]]

    def _order(self, fit: Fit, work: Workplace) -> list[str]:
        """Space-separated image names of each iteration, in the native method's order with this seed; empty for the authors'
        order."""
        if self.config.order == "published":
            return []
        images = read_json(work.root / EXPORTED)["images"]
        names = {FrameKey(*key): self.image_name(path) for path, key in images.items()}
        keys = fit.clip.splits["train"]
        return [" ".join(names[keys[index]] for index in batch) for batch in self.batches(fit)]

    def batches(self, fit: Fit) -> Iterator[Sequence[int]]:
        """Indices of the training frames of each iteration of the native method."""
        sampler = ShuffledEpochs(len(fit.clip.splits["train"]), fit.seed)
        return ([sampler(iteration)] for iteration in range(1, (fit.budget.iterations or 0) + 1))

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

    def repeated(self, seed: int) -> list[str]:
        """Record entry for code with a fixed seed."""
        if not seed or self.config.order != "published":
            return []
        return [f"their code fixes the seed at 0; seed {seed} repeats the same training"]

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
        exact continuation.
        """
        run = run_digest(self.name, self.version, self.config, clip, budget, seed)
        if not is_finished(out, run):
            work = Workplace.at(out / TRAINING, self._checked(clip, budget))
            with alone(out / TRAINING) as held:
                self._train(Fit(clip, out, budget, self.config.device, seed, progress, run), work, held)
        remove(out / TRAINING)
        return self.load(out, device=device)

    def load(self, path: Path, *, device: str) -> OfficialAvatar:
        """Read an avatar that `fit` wrote; the checkout is validated when frames are requested."""
        avatar = OfficialAvatar(self, path)
        for file in avatar.files():
            if not file.is_file():
                raise InputError(file, "", f"a file of an avatar of {self.name}", "no such file")
        return avatar

    def run(
        self,
        command: Sequence[str],
        work: Workplace,
        log: Path,
        on_line: Callable[[str], None],
        held: IO[str],
    ) -> ProgramEnd:
        """Run a command of the authors' code in the program's folder; see `process.run_program`."""
        return run_program(
            command,
            work.program,
            log,
            on_line,
            variables=self.variables,
            held=held,
            hours=self.config.time_limit_hours,
        )

    def _train(self, fit: Fit, work: Workplace, held: IO[str]) -> None:
        start, checkout = time.monotonic(), work.checkout
        frames, iterations = len(fit.clip.splits["train"]), fit.budget.iterations or 0
        self._export(fit, work)
        command = self.train_command(fit, work)
        remove(work.model)
        work.make()

        def on_line(line: str) -> None:
            progress = self.done(line)
            if progress is not None:
                fit.progress(frames + min(progress[0], iterations), frames + iterations, progress[1])

        shim = self.config.device != "cuda"
        patches = [*self.changes, *(self.patches(fit.clip.head, iterations, checkout) if shim else ())]
        patches += self.order_changes if self.config.order == "native" else ()
        command = self.launched([*command, *self.config.arguments], work, patches, self._order(fit, work))
        shrinking = self.shrink_command(fit, work)
        commands = [(command, f"The training command of {checkout.folder}")]
        commands += [] if shrinking is None else [(shrinking, "Leaving the optimiser out of its output")]
        ends = []
        for each, what in commands:
            ended = self.run(each, work, fit.out / TRAINING_LOG, on_line, held)
            if ended.code:
                raise ended.error(f"{what} {described(ended.code)}")
            ends.append(ended)
        try:
            self.keep(fit, work)
            write_subject(fit.out / SUBJECT_FILE, Subject.of(fit.clip))
            save_shared_head(fit.out, fit.clip.head)
        except (InputError, OSError) as error:
            raise ends[0].error(
                f"The training command of {checkout.folder} left no whole avatar: {error}"
            ) from error
        fit.progress(frames + iterations, frames + iterations)
        official = {**checkout.record, "device": self.config.device, "arguments": list(self.config.arguments)}
        differences = self.differences(fit.clip, fit.seed) + self._of_launch(patches)
        summary = TrainingSummary(iterations, iterations, time.monotonic() - start)
        write_record(fit, summary, leaks=[], differences=differences, official=official)

    def _export(self, fit: Fit, work: Workplace) -> None:
        """Write the program's input, or reuse that of an earlier call if it is complete; then compare it with the
        training split."""
        record = work.root / EXPORTED
        steps = len(fit.clip.splits["train"]) + (fit.budget.iterations or 0)

        def exporting(done: int, total: int, note: str = "") -> None:
            fit.progress(done, steps, note or "exporting")

        if not (record.exists() and read_json(record).get("run") == fit.run):
            for folder in (work.input, work.program, work.model):
                remove(folder)
            record.unlink(missing_ok=True)
            work.make()
            images = self.export(fit.clip, work, exporting)
            named = {path: list(key) for path, key in images.items()}
            write_json(record, {"run": fit.run, "images": named})
        check_export(work, {p: FrameKey(*key) for p, key in read_json(record)["images"].items()}, fit.clip)


class OfficialAvatar:
    """A trained avatar of an official repository (`ListedFrames`, `SharingAvatar`)."""

    def __init__(self, method: OfficialMethod[Any], folder: Path):
        self._method, self._folder = method, folder

    def files(self) -> Sequence[Path]:
        """Files of the subject that the authors' program needs for rendering, without the driving signal."""
        return [self._folder / name for name in self._method.avatar_files]

    def shared_files(self) -> Sequence[Path]:
        """The head model: the same for every subject, without the checkout."""
        return [self._folder / HEAD_FILE]

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
        frames = [Listed(number, key, *view) for number, (key, view) in enumerate(views.items())]
        work = Workplace.at(folder / RENDERING, method.inspect())
        with alone(work.root) as held:
            remove(work.root, but=LOCK)
            work.make()
            write_json(work.root / INDEX, {method.render_name.format(f.number): list(f.key) for f in frames})
            command = method.render_command(folder, frames, background, work)

            def on_line(line: str) -> None:
                drawn = re.search(method.frame_line, line)
                if drawn is not None:
                    progress(min(int(drawn[1]), len(frames)), len(frames))

            if method.starts_launcher:
                command = method.launched(command, work, method.render_patches(folder, work.checkout))
            ended = method.run(command, work, folder / RENDERING_LOG, on_line, held)
            excused = method.excused and any(re.search(method.excused, line) for line in ended.lines)
            if ended.code and not excused:
                raise ended.error(f"The render command of {work.checkout.folder} {described(ended.code)}")
            yield from _read_back(method, frames, background, work, ended)
        remove(work.root)


def _read_back(
    method: OfficialMethod[Any],
    frames: Sequence[Listed],
    background: Sequence[float],
    work: Workplace,
    ended: ProgramEnd,
) -> Iterator[tuple[FrameKey, Frame]]:
    """Renders by the names of the index."""
    renders = work.model / method.render_folder
    index = {name: FrameKey(*key) for name, key in read_json(work.root / INDEX).items()}
    renders_there = {path.name for path in renders.glob(method.render_files)}
    for what, names in (
        ("lacks", index.keys() - renders_there),
        ("has besides", renders_there - index.keys()),
    ):
        if names:
            first = min(names)
            named = f" ({index[first]})" if first in index else ""
            raise ended.error(f"{renders} {what} {len(names)} of {len(index)} renders, first {first}{named}")
    by_key = {frame.key: frame for frame in frames}
    for name, key in index.items():
        try:
            frame = method.read_back(by_key[key], renders / name, background, work)
        except InputError as error:
            raise ended.error(str(error)) from error
        yield key, frame


def read_identity(folder: Path) -> tuple[Subject, HeadAsset]:
    """Subject and head model of an avatar."""
    head = read_shared_head(folder)
    return read_subject(folder / SUBJECT_FILE, head), head
