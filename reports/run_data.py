"""Reads what reports show from a run folder, checked: rows, metrics, methods, protocols, renders and truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image, UnidentifiedImageError

from ..bench.captures import open_clips
from ..bench.configuration import build
from ..bench.contracts import ByteArray, Clip, FrameKey
from ..bench.errors import InputError
from ..bench.frames import read_png
from ..bench.run_config import RunConfig
from ..bench.scoring import FULL
from ..bench.specs import MetricSpec
from ..bench.store import RunFolder, keys_of, read_rows


@dataclass(frozen=True)
class RunData:
    """A finished run, read. Images are read when asked for.

    Attributes
    ----------
    folder : where it lies.
    manifest : content of ``run.json``.
    rows : one per value; columns as in `headbench.bench.store.Row`.
    metrics : in the order of the configuration.
    methods, trivial : names in the order of the configuration, and those among them that are floors.
    tasks : in the order of the configuration.
    """

    folder: RunFolder
    manifest: Mapping[str, Any]
    rows: pd.DataFrame
    metrics: tuple[MetricSpec, ...]
    methods: tuple[str, ...]
    trivial: tuple[str, ...]
    tasks: tuple[str, ...]

    @classmethod
    def read(cls, root: Path) -> RunData:
        """Read a run folder. Raises `InputError` naming what is missing or malformed."""
        folder = RunFolder(root)
        manifest = folder.read_manifest()
        try:
            fields = {field.name for field in dataclasses.fields(MetricSpec)}
            metrics = tuple(
                MetricSpec(**{key: value for key, value in entry.items() if key in fields})
                for entry in manifest["metrics"]
            )
            methods = tuple(str(entry["name"]) for entry in manifest["methods"])
            trivial = tuple(str(entry["name"]) for entry in manifest["methods"] if entry["trivial"])
            tasks = tuple(map(str, manifest["protocols"]))
        except (KeyError, TypeError, AttributeError) as error:
            raise InputError(
                folder.manifest, "metrics, methods, protocols", "the records of a run", f"{error!r}"
            ) from error
        return cls(folder, manifest, read_rows(folder.rows), metrics, methods, trivial, tasks)

    @property
    def derived(self) -> dict[str, Mapping[str, Any]]:
        """Of methods whose avatars were derived from trained ones: from which, the variant, what was changed."""
        entries = self.manifest["methods"]
        return {str(entry["name"]): entry["derived"] for entry in entries if entry.get("derived")}

    @property
    def protocol_ids(self) -> dict[str, str]:
        """Readable name of each task's protocol."""
        return {task: str(self.manifest["protocols"][task].get("id", "")) for task in self.tasks}

    @property
    def machine(self) -> str:
        """The processor that speed was measured on, and the device if it was another."""
        processor = str(self.manifest.get("machine", {}).get("processor", ""))
        device = str(self.manifest.get("configuration", {}).get("device", "cpu"))
        return processor if device == "cpu" else f"{device}, {processor}"

    def keys(self, task: str) -> Sequence[FrameKey]:
        """Frames of a task, sorted."""
        return sorted(keys_of(self.manifest, task))

    @property
    def seed(self) -> int:
        """The seed whose images are shown: the first configured."""
        return int(self.manifest["configuration"]["seeds"][0])

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
        own = self.rows[(self.rows["method"] == method) & (self.rows["subject"] == key.subject)]
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
                try:
                    with Image.open(path) as image:
                        sizes.add(image.size)
                except (UnidentifiedImageError, OSError) as error:
                    raise InputError(path, "", "a PNG image", "a file that cannot be decoded") from error
        return " to ".join(dict.fromkeys(f"{w} x {h}" for w, h in (min(sizes), max(sizes)))) if sizes else ""

    @cached_property
    def _by_frame(self) -> dict[tuple[Any, ...], float]:
        rows = self.rows
        shown = rows[(rows["status"] == "ok") & (rows["timestep"] >= 0) & (rows["seed"] == self.seed)]
        shown = shown[shown["region"] == FULL]
        places = shown[["metric", "method", "task", *FrameKey._fields]].itertuples(index=False, name=None)
        return dict(zip(places, shown["value"].astype(float)))

    @cached_property
    def _clips(self) -> dict[str, Clip]:
        config = build(RunConfig, self.manifest["configuration"], str(self.folder.manifest))
        clips = {clip.subject: clip for clip in open_clips(config)}
        for entry in self.manifest["clips"]:
            clip = clips.get(entry["subject"])
            found = "no such capture" if clip is None else clip.fingerprint[:12]
            if clip is None or clip.fingerprint != entry["fingerprint"]:
                raise InputError(
                    config.data,
                    f"capture of {entry['subject']}",
                    f"fingerprint {entry['fingerprint'][:12]}, as when the run was made",
                    found,
                    "Run the comparison again.",
                )
        return clips
