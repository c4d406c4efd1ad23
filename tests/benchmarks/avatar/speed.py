"""Pairs of ways to the same frame, one of which leaves work out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import cycle
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ....bench.contracts import Camera, HeadAsset, HeadPose, Progress, no_progress
from ....bench.specs import Findings
from ....datasets.head.procedural.model import procedural_head
from ....methods.ga.method import GAAvatar
from ....methods.ops.planes import (
    ENCODING_SIZE,
    Bounds,
    LinePosition,
    line_offsets,
    line_position,
    offset_writer,
    plane_colors,
    shader,
    sum_rows,
)
from ....methods.ops.splats import activate, directions_to, to_world
from ....methods.ours.appearance import driving_coefficients
from ....methods.ours.avatar import OursAvatar
from ....methods.ours.field import (
    FIRST_LAYER,
    LAST_LAYER,
    CanonicalFrames,
    apply_offsets,
    blend_lines,
    color_network,
    line_table,
    normalised_weight,
    offset_layers,
    plane_features,
    position_part,
)
from ....methods.shared.rendering import draw_splats, read_back, view_of
from ..timing import seconds_of, table, take_turns, torch_threads
from .untrained import cameras_around, random_poses, untrained_avatar

Run = Callable[[], Any]
BLOCK = 1024  # splats at which every line is sampled at once; bounds the memory of the slow way


@dataclass(frozen=True)
class Pair:
    """Milliseconds of processor time, the least of runs that take turns."""

    name: str
    before: float
    after: float
    note: str = ""


@dataclass(frozen=True)
class Beside:
    """Milliseconds of a frame, medians of runs that take turns: processor time, all threads together."""

    threads: int
    ours: float
    ga: float


class Bench:
    """One avatar with poses and cameras, taken apart."""

    def __init__(
        self, head: HeadAsset, count: int, width: int, height: int, *, budget: float, least_runs: int
    ):
        self.head, self.count, self.size = head, count, (width, height)
        self._budget, self._least_runs = budget, least_runs
        self.avatar = untrained_avatar(head, count)
        self.poses = random_poses(head, 8)
        self.cameras = cameras_around(head, 4, width, height)

    def pairs(self) -> Iterator[Pair]:
        """Every saving, alone, then all together, against the same frame drawn by the definition's own functions."""
        parts = _Parts(self.avatar, self.poses[0], self.cameras[0])
        frames = cycle([_Parts(self.avatar, p, c) for p, c in zip(self.poses, cycle(self.cameras))])
        prepared = self._again()
        prepared.prepare(self.poses)
        every = self._frames(self.avatar)
        whole, narrow, inside = self._narrow()
        by_name: dict[str, tuple[Run, Run] | tuple[Run, Run, str]] = {
            "all, a new pose and camera every frame": (lambda: next(frames).plain(), every),
            "known poses prepared": (every, self._frames(prepared), "mesh, frames, jaw weights, offsets"),
            "another camera, same pose": (every, self._same_pose(cycle(self.cameras))),
            "same camera, same pose": (every, self._same_pose(cycle(self.cameras[:1]))),
            "lines blended once a frame": (parts.offsets_by_line, parts.offsets, "not per splat"),
            "first line layer on the blended lines": (parts.offsets_by_splat, parts.offsets, "not per splat"),
            "splats outside the lines' box skipped": (whole.offsets, narrow.offsets, f"{inside:.0%} inside"),
            "offset network in one pass, without units that are off": (
                *(parts.offsets_by_torch, parts.offsets),
                f"{parts.units_on():.0%} on",
            ),
            "planes folded into the first colour layer": (parts.colors_by_planes, parts.colors_direct),
            "colour network in one pass, directions included": (parts.colors_direct, parts.colors),
            "splats to the world in one pass": (parts.world_by_torch, parts.world),
        }
        for name, (before, after, *note) in by_name.items():
            least = self._least({"before": before, "after": after})
            yield Pair(name, least["before"], least["after"], *note)

    def stages(self) -> list[tuple[str, float]]:
        """Milliseconds of the steps of one frame."""
        parts = _Parts(self.avatar, self.poses[0], self.cameras[0])
        runs: dict[str, Run] = {
            "mesh": parts.mesh,
            "triangle frames": parts.frames,
            "line offsets": parts.offsets,
            "splats to the world": parts.world,
            "colours": parts.colors,
            "rasterise, to numpy": parts.raster,
        }
        return list(self._least(runs).items())

    def beside_ga(self) -> list[Beside]:
        """Whole frames of `ours` and of `ga` with the same splats, harmonics of degree 3, poses and cameras."""
        avatar, found = self.avatar, []
        splats = {name: getattr(avatar.neutral, name) for name in ("means", "log_scales", "quats")}
        generator = torch.Generator().manual_seed(0)
        harmonics = 0.2 * torch.randn(self.count, 3, 16, generator=generator)
        splats |= {
            "opacities": avatar.neutral.logits,
            "sh_dc": harmonics[:, :, 0],
            "sh_rest": harmonics[:, :, 1:],
        }
        binding = avatar.field.tensors["splats"][:, -1].to(torch.int64)
        other = GAAvatar([], avatar.mesh, avatar.subject, splats, binding, None, "cpu")
        runs = {"ours": self._frames(avatar), "ga": self._frames(other)}
        for threads in (1, 2):
            timed = {name: seconds_of(run, time.process_time) for name, run in runs.items()}
            with torch_threads(threads), torch.no_grad():
                seconds = take_turns(timed, budget=self._budget, least_runs=self._least_runs)
            medians = (1e3 * float(np.median(seconds[name])) for name in runs)
            found.append(Beside(threads, *medians))
        return found

    def _least(self, runs: dict[str, Run]) -> dict[str, float]:
        timed = {name: seconds_of(run, time.thread_time) for name, run in runs.items()}
        with torch_threads(1), torch.no_grad():
            seconds = take_turns(timed, budget=self._budget, least_runs=self._least_runs)
        return {name: 1e3 * min(values) for name, values in seconds.items()}

    def _frames(self, avatar: OursAvatar) -> Run:
        """A new pose and a new camera every frame."""
        frames = cycle([(self.cameras[n % len(self.cameras)], pose) for n, pose in enumerate(self.poses)])
        return lambda: avatar.render(*next(frames))

    def _same_pose(self, cameras: Iterator[Camera]) -> Run:
        own = self._again()  # another run's pose between two of these would be the last one
        return lambda: own.render(next(cameras), self.poses[0])

    def _again(self) -> OursAvatar:
        return OursAvatar([], self.avatar.mesh, self.avatar.subject, self.avatar.field, "cpu")

    def _narrow(self) -> tuple[_Parts, _Parts, float]:
        """The avatar, one with lines over the front half of the head (``lines.bounds: face``), the share inside."""
        field = self.avatar.field
        low, high = field.tensors["line_box"]
        front = torch.stack([torch.stack([low[0], low[1], 0.5 * (low[2] + high[2])]), high])
        narrow = field._replace(tensors={**field.tensors, "line_box": front})
        other = OursAvatar([], self.avatar.mesh, self.avatar.subject, narrow, "cpu")
        share = len(other.line_offsets.inside) / max(self.count, 1) if other.line_offsets else 0.0
        whole, part = (_Parts(one, self.poses[0], self.cameras[0]) for one in (self.avatar, other))
        return whole, part, share


class _Parts:
    """The steps of one frame by themselves; the slow ways by the functions that training uses."""

    def __init__(self, avatar: OursAvatar, pose: HeadPose, camera: Camera):
        self._avatar, self._tensors = avatar, avatar.field.tensors
        self._mesh, self._pose = avatar.mesh, pose
        self._view = view_of(camera, "cpu", (1.0, 1.0, 1.0))
        with torch.no_grad():
            self._vertices = self.mesh()
            self._frames = self.frames()
            self._binding = self._tensors["splats"][:, -1].to(torch.int64)
            self._canonical = CanonicalFrames.of(self._mesh.frames(self._mesh.canonical))
            self._turns = self._canonical.turns(self._frames)
            self._positions = self._canonical.positions(self._binding, avatar.neutral.means)
            self._box = Bounds(*self._tensors["line_box"])
            self._inside = self._box.contains(self._positions).nonzero().squeeze(1)
            unit = self._box.unit(self._positions.index_select(0, self._inside))
            self._place = line_position(unit, self._tensors["lines"].shape[2])
            features = plane_features(self._tensors, Bounds(*self._tensors["plane_box"]), self._positions)
            self._from_position = position_part(self._tensors, features)
            self._activated = activate(avatar.neutral.log_scales, avatar.neutral.quats)
            self._coefficients = self._driving()
            self._offsets = self.offsets()
            self._splats = self._changed(self._offsets)
            self._world = self.world()
            self._shown = self.colors()

    def mesh(self) -> Tensor:
        return self._mesh.posed(self._mesh.arguments([self._pose]))

    def frames(self) -> Any:
        return self._mesh.frames(self._vertices)

    def offsets(self) -> Tensor:
        assert self._avatar.line_offsets is not None
        return self._avatar.line_offsets(torch.cat(self._coefficients))

    def offsets_by_torch(self) -> Tensor:
        """With the first layer on the blended lines, all units of all layers."""
        assert self._avatar.line_offsets is not None
        table = self._avatar.line_offsets.table(torch.cat(self._coefficients))
        offsets = table.new_zeros(len(self._binding), len(self._tensors["line_bias_2"]))
        offset_writer.definition(offset_layers(self._tensors), self._place)(offsets, self._inside, table)
        return offsets

    def units_on(self) -> float:
        """Part of the first layer's units that are on, over all splats inside."""
        assert self._avatar.line_offsets is not None
        table = self._avatar.line_offsets.table(torch.cat(self._coefficients))
        return float((sum_rows(table, *self._place) > 0).float().mean())

    def offsets_by_line(self) -> Tensor:
        """Every line sampled at each splat, and the samples blended there."""
        expression, jaw = self._coefficients
        lines = self._tensors["lines"]
        features = []
        for start in range(0, len(self._inside), BLOCK):
            place = LinePosition(*(part[start : start + BLOCK] for part in self._place))
            kinds = zip((expression, jaw), lines.split([len(expression), len(jaw)]))
            features.append(torch.cat([_blend_samples(own, weights, place) for weights, own in kinds], dim=1))
        return self._offsets_of(torch.cat(features))

    def offsets_by_splat(self) -> Tensor:
        """Blended lines sampled at each splat, 6 C features, and all layers there."""
        blended = blend_lines(self._tensors["lines"], *self._coefficients)
        return self._offsets_of(torch.cat([sum_rows_by_axis(kind, self._place) for kind in blended], dim=1))

    def _offsets_of(self, features: Tensor) -> Tensor:
        summed = features @ normalised_weight(self._tensors, 0).t()
        inside = offset_layers(self._tensors)(summed)
        return inside.new_zeros(len(self._binding), inside.shape[1]).index_copy(0, self._inside, inside)

    def world(self) -> Any:
        splats = self._splats
        shape = splats.log_scales, splats.quats
        return to_world(self._frames, self._binding, splats.means, *shape, self._activated)

    def world_by_torch(self) -> Any:
        splats = self._splats
        return to_world.definition(self._frames, self._binding, splats.means, splats.log_scales, splats.quats)

    def colors(self) -> Tensor:
        return self._avatar.colors(self._world.means, self._view.center, self._turns, self._binding)

    def colors_direct(self) -> Tensor:
        """By torch, with the part of the position known."""
        of_direction = self._tensors[FIRST_LAYER][:, -ENCODING_SIZE:].t()
        shade = shader.definition(self._from_position, of_direction, self._tensors[LAST_LAYER])
        return shade(self._world.means, self._view.center, self._turns, self._binding)

    def colors_by_planes(self) -> Tensor:
        """Planes sampled and all layers at each splat."""
        directions = directions_to(self._world.means, self._view.center, self._turns, self._binding)
        box = Bounds(*self._tensors["plane_box"])
        return plane_colors(self._positions, directions, box, color_network(self._tensors))

    def raster(self) -> Any:
        opacities = torch.sigmoid(self._splats.logits)
        return read_back(draw_splats(self._world, opacities, self._shown, self._view))

    def plain(self) -> Any:
        """A whole frame by training's functions, nothing known beforehand but the canonical positions."""
        self._vertices = self.mesh()
        self._frames = self.frames()
        self._turns = self._canonical.turns(self._frames)
        self._coefficients = self._driving()
        blended = blend_lines(self._tensors["lines"], *self._coefficients)
        table = line_table(blended, normalised_weight(self._tensors, 0))
        offsets = line_offsets(self._positions, self._box, table, offset_layers(self._tensors))
        self._splats = self._changed(offsets)
        self._world = self.world()
        self._shown = self.colors_by_planes()
        return self.raster()

    def _driving(self) -> tuple[Tensor, Tensor]:
        bases = self._tensors["jaw_bases"].numpy().astype(float)
        found = driving_coefficients(self._pose, len(self._tensors["lines"]) - len(bases), bases)
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])

    def _changed(self, offsets: Tensor) -> Any:
        return apply_offsets(self._avatar.neutral, offsets, self._avatar.field.dynamic)


def sum_rows_by_axis(lines: Tensor, place: LinePosition) -> Tensor:
    """(N, 3 C) samples of (3, L, C) lines at each splat."""
    axes, resolution, _ = lines.shape
    rows, weights = place.rows.view(-1, 2, axes), place.weights.view(-1, 2, axes)
    parts = [
        sum_rows(lines[axis], rows[:, :, axis] - axis * resolution, weights[:, :, axis].contiguous())
        for axis in range(axes)
    ]
    return torch.cat(parts, dim=1)


def _blend_samples(lines: Tensor, weights: Tensor, place: LinePosition) -> Tensor:
    """(n, 3 C) weighted sums of the samples of (K, 3, L, C) lines."""
    count, _, _, channels = lines.shape
    side_by_side = lines.permute(1, 2, 0, 3).flatten(2).contiguous()
    samples = sum_rows_by_axis(side_by_side, place).view(len(place.rows), -1, count, channels)
    return torch.einsum("nakc,k->nac", samples, weights).flatten(1)


SIZES = ((20_000, 144, 208), (20_000, 550, 802), (60_000, 550, 802))
QUICK = ((2_000, 72, 104),)


def measure(quick: bool = False, progress: Progress = no_progress) -> Findings:
    """Milliseconds per frame of an untrained avatar of ours by part, and of each saving alone, on one thread."""
    head = procedural_head()
    results = []
    sizes = QUICK if quick else SIZES
    for number, (count, width, height) in enumerate(sizes):
        progress(number, len(sizes), f"{count} splats, {width}x{height}")
        bench = Bench(head, count, width, height, budget=0.1 if quick else 1.5, least_runs=2 if quick else 8)
        results.append(
            {
                "splats": count,
                "width": width,
                "height": height,
                "stages_ms": dict(bench.stages()),
                "savings": [asdict(pair) for pair in bench.pairs()],
                "beside_ga": [asdict(beside) for beside in bench.beside_ga()],
            }
        )
    text = "\n\n".join(_text(result) for result in results)
    note = (
        "Processor time, ms, of one thread, the least of runs that take turns; of whole frames beside ga's that of all\n"
        "threads, medians. Before: the same frame, or step, by the functions of training, or without what is known. After\n"
        "differs from before by rounding; colours also by a table of directions, see methods/ours/README.md."
    )
    return Findings(f"{text}\n\n{note}", {"sizes": results})


def _text(result: Mapping[str, Any]) -> str:
    stages = [(name, f"{ms:.2f}") for name, ms in result["stages_ms"].items()]
    savings = [
        (
            pair.name,
            f"{pair.before:.2f}",
            f"{pair.after:.2f}",
            f"{pair.before / max(pair.after, 1e-9):.1f}",
            pair.note or "-",
        )
        for pair in (Pair(**values) for values in result["savings"])
    ]
    beside = [
        (str(one.threads), f"{one.ours:.2f}", f"{one.ga:.2f}", f"{one.ours / one.ga:.2f}")
        for one in (Beside(**values) for values in result["beside_ga"])
    ]
    head = f"{result['splats']} splats, {result['width']}x{result['height']}"
    tables = (
        table(("step of a frame", "ms"), stages),
        table(("saving", "before", "after", "times", "note"), savings),
        table(("frame, threads", "ours", "ga", "ratio"), beside),
    )
    return "\n\n".join([head, *tables])
