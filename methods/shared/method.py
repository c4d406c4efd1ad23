"""Common code of trained methods around their training: requirements on the machine, checks, resuming, loading."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch

from ...bench.contracts import Budget, Clip, Progress
from ...bench.machine import use_device
from ...bench.specs import Need
from ..splats import cpu, cuda
from .avatar_files import is_finished, run_digest
from .capacity import CapacityPlan
from .loop import CHECKPOINT, Fit, check_budget, check_training_split


def splats(config: Any, device: str) -> Iterator[Need]:
    """The splat renderer: its kernel on CPUs, gsplat on GPUs."""
    if not device.startswith("cuda"):
        yield cpu.KERNEL.need()
        return
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else ""
    installed = importlib.util.find_spec("gsplat") is not None
    slow = f"{cuda.REMEDY} The slow reference backend is used instead."
    yield Need("GPU", gpu, "PyTorch with CUDA, and an NVIDIA driver: https://pytorch.org/get-started.")
    yield Need("gsplat", "installed" if installed else "", slow, required=False)
    if installed and not cuda.compiled():
        yield Need("CUDA toolkit", cuda.toolkit(), cuda.toolkit_remedy())


def insta(config: Any, device: str) -> Iterator[Need]:
    """INSTA's kernel and its device."""
    from ..insta.kernel import KERNEL

    if not device.startswith("cpu"):
        yield Need(f"code for {device}", "", f"INSTA does not compute on {device!r}: run it with device=cpu.")
    yield KERNEL.need()


log = logging.getLogger(__name__)
Config = TypeVar("Config")
Avatar = TypeVar("Avatar")


class TrainedMethod(Generic[Config, Avatar]):
    """Base class of trained methods; subclasses implement `_train`, which writes the avatar under ``fit.out``.

    A derived class defines the classes of its settings and its avatar (with ``read(folder, device)``), name and
    version of its spec, and whether it draws splats.
    """

    name: ClassVar[str]
    version: ClassVar[str]
    config_class: ClassVar[Any]
    avatar_class: ClassVar[Any]
    draws_splats: ClassVar[bool] = True
    _plan: CapacityPlan | None = None

    def __init__(self, config: Config | None = None):
        self.config: Config = config or self.config_class()
        self._clock = time.monotonic

    def fit(
        self, clip: Clip, out: Path, budget: Budget, *, device: str, seed: int, progress: Progress
    ) -> Avatar:
        """Train on the training split and write the avatar under ``out``; continues a killed run."""
        check_budget(budget)
        check_training_split(clip)
        self.prepare(device)
        began = self._clock()
        config, settings = self._resolved(clip, device)
        run = run_digest(self.name, self.version, settings, clip, budget, seed)
        if not is_finished(out, run):
            plan = self._plan
            if plan is not None:
                log.info("%s", plan.summary())
            record = None if plan is None else plan.record()
            self._train(
                Fit(clip, out, budget, device, seed, progress, run, self._clock, began, record), config
            )
        self._remove_training_files(out)
        return self.load(out, device=device)

    def prepare(self, device: str) -> None:
        """Prepare a training on ``device``: the renderer, see `cuda.prepare`, and optimisers."""
        self._use(device)
        load_optimisers()

    def _use(self, device: str) -> None:
        """Prepare rendering on ``device``."""
        if self.draws_splats:
            cuda.prepare(device)
        else:
            use_device(device)

    def load(self, path: Path, *, device: str) -> Avatar:
        """Read an avatar that `fit` wrote."""
        self._use(device)
        avatar: Avatar = self.avatar_class.read(path, device)
        return avatar

    def _resolved(self, clip: Clip, device: str) -> tuple[Any, Any]:
        """The configuration to train with, and the part of it that identifies the run.

        With planned sizes the latter contains the sizes, but not the measurements behind them, whose last digits depend on the
        number of threads.
        """
        config: Any = self.config
        if getattr(config, "capacity", None) is None or config.capacity.mode == "fixed":
            self._plan = None
            return config, config
        self._plan = self._planned(clip, config, device)
        planned = self._plan.apply(config)
        return planned, (config, planned)

    def _planned(self, clip: Clip, config: Any, device: str) -> CapacityPlan:
        """The sizes for a clip if ``config.capacity`` is "auto"."""
        raise NotImplementedError

    def _remove_training_files(self, out: Path) -> None:
        """Remove files that a finished avatar no longer needs, also after a kill before this step."""
        (out / CHECKPOINT).unlink(missing_ok=True)

    def _train(self, fit: Fit, config: Any) -> None:
        raise NotImplementedError


def load_optimisers() -> None:
    """Trigger PyTorch's lazy imports for optimisers (1.5 s), so that they do not count as training time."""
    importlib.import_module("torch._dynamo")
