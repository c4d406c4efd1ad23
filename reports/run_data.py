"""Reads what reports show from a run folder, checked: rows, metrics, methods, protocols, renders and truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ..bench.contracts import ByteArray, Clip, FrameKey
from ..bench.errors import InputError
from ..bench.io.frames import read_png
from ..bench.io.images import probe_image
from ..bench.manifest import Derived, Manifest
from ..bench.rows import ALL, Rows
from ..bench.runner.captures import open_run_clips
from ..bench.runner.options import RunOptions
from ..bench.runner.scoring import FULL
from ..bench.runner.store import RunFolder
from ..bench.specs import MetricSpec


@dataclass(frozen=True)
class RunData:
    """A finished run, read. Images are read when asked for.

    Attributes
    ----------
    folder : where it lies.
    manifest : content of ``run.json``.
    rows : one per value.
    """

    folder: RunFolder
    manifest: Manifest
    rows: Rows

    @classmethod
    def read(cls, root: Path) -> RunData:
        """Read a run folder. Raises `InputError` naming what is missing or malformed."""
        folder = RunFolder(root)
        manifest = folder.read_manifest()
        return cls(folder, manifest, folder.read_rows(manifest))

    @property
    def metrics(self) -> tuple[MetricSpec, ...]:
        """In the order of the configuration."""
        return self.manifest.metrics

    @property
    def methods(self) -> tuple[str, ...]:
        """Names, in the order of the configuration."""
        return tuple(method.name for method in self.manifest.methods)

    @property
    def trivial(self) -> tuple[str, ...]:
        """Names of the methods that are trivial baselines."""
        return tuple(method.name for method in self.manifest.methods if method.trivial)

    @property
    def tasks(self) -> tuple[str, ...]:
        """In the order of the configuration."""
        return tuple(self.manifest.protocols)

    @property
    def derived(self) -> dict[str, Derived]:
        """Of methods whose avatars were derived from trained ones: from which, the variant, what was changed."""
        return {method.name: method.derived for method in self.manifest.methods if method.derived}

    @property
    def protocol_ids(self) -> dict[str, str]:
        """Readable name of each task's protocol."""
        return {task: protocol.id for task, protocol in self.manifest.protocols.items()}

    @property
    def machine(self) -> str:
        """The processor that speed was measured on, and the device if it was another."""
        processor = str(self.manifest.machine.get("processor", ""))
        device = self.manifest.configuration.device
        return processor if device == "cpu" else f"{device}, {processor}"

    def keys(self, task: str) -> Sequence[FrameKey]:
        """Frames of a task, sorted."""
        return sorted(self.manifest.protocols[task].keys)

    @property
    def seed(self) -> int:
        """The seed whose images are shown: the first configured."""
        return self.manifest.configuration.seeds[0]

    def render_path(self, method: str, task: str, key: FrameKey) -> Path | None:
        """Where that seed's render of a frame lies, or None where there is none."""
        path = self.folder.cell(key.subject, method, self.seed).render(task, key)
        return path if path.is_file() else None

    def render(self, method: str, task: str, key: FrameKey) -> ByteArray | None:
        """Read that render, (H, W, 3) 8-bit, or return None where there is none."""
        path = self.render_path(method, task, key)
        return None if path is None else read_png(path)

    def truth(self, key: FrameKey) -> ByteArray:
        """Read the captured image of a frame, (H, W, 3) 8-bit, from the capture the run was made from."""
        return self._clips[key.subject].image(key)

    def reason(self, method: str, task: str, key: FrameKey) -> str:
        """Why a method has no render of a frame, as far as the rows know."""
        seeds = (self.seed,)
        own = self.rows.select(
            method=method, metric=ALL, task=task, region=FULL, seeds=seeds, subject=key.subject
        )
        failed = own[own["status"] == "failed"]
        return "not rendered" if failed.empty else str(failed.iloc[0]["reason"])

    def value(self, metric: str, method: str, task: str, key: FrameKey) -> float | None:
        """Return a metric of the whole image shown, or None where it was not measured."""
        return self._by_frame.get((metric, method, task, *key))

    @property
    def image_size(self) -> str:
        """Size of the rendered images, "width x height", or the range where they differ; "" without renders."""
        first_of_camera = {
            (task, key.subject, key.camera): key for task in self.tasks for key in reversed(self.keys(task))
        }
        sizes = set()
        for (task, _, _), key in first_of_camera.items():
            paths = (self.render_path(method, task, key) for method in self.methods)
            if path := next((path for path in paths if path), None):
                info = probe_image(path)
                sizes.add((info.width, info.height))
        return " to ".join(dict.fromkeys(f"{w} x {h}" for w, h in (min(sizes), max(sizes)))) if sizes else ""

    @cached_property
    def _by_frame(self) -> dict[tuple[Any, ...], float]:
        rows = self.rows.select(method=ALL, metric=ALL, task=ALL, region=FULL, seeds=(self.seed,))
        shown = rows[(rows["status"] == "ok") & (rows["timestep"] >= 0)]
        places = shown[["metric", "method", "task", *FrameKey._fields]].itertuples(index=False, name=None)
        return dict(zip(places, shown["value"].astype(float)))

    @cached_property
    def _clips(self) -> dict[str, Clip]:
        # Pictures are drawn by the run itself, in the process that loaded its plug-ins.
        config, opened = open_run_clips(self.folder.root, RunOptions(trust=True))
        clips = {clip.subject: clip for clip in opened}
        for entry in self.manifest.clips:
            if entry.subject not in clips:
                raise InputError(config.data, f"capture of {entry.subject}", "a capture", "none")
        return clips
