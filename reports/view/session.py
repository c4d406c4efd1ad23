"""The session of one browser: continuously draws the view of its controls and camera."""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray
from ...bench.errors import HeadbenchError
from ...bench.experiments.viewpoints import turntable
from ...bench.io.images import write_browser_video, write_png
from ...bench.io.provenance import COMPOSITE
from ...bench.registry import resolve
from .drawing import draw, rotations, splats_of
from .panel import ControlPanel
from .scene import FreeView, Scene, State

log = logging.getLogger(__name__)
SCALE = 100.0
"""Units of the browser's world per metre: covariances are sent as 16-bit floats, which are too coarse in square metres."""
DRAFT_S = 0.026
"""Time of a draft while something moves, so that 30 a second arrive; its size follows from the time of the last one."""
TOLD_S = 0.5
"""Between two texts about drafts: the browser takes longer to set a text than to show a draft."""
THREADS = "headbench.methods.shared.threads:torch_threads"
"""Drafts use one thread: their steps are short, and synchronised threads are slowed down by the browser on the same cores.
By name, since this package imports no method."""
REST_S = 0.3
"""Time without a change after which the image is drawn in full."""
LEAST_DRAFT = 0.12
STILL = 1e-4
"""Motion of the camera that is not drawn: metres, and as much of a unit quaternion."""
DRAFT_QUALITY = 85
APART_M = 0.35
"""Between avatars side by side, where the browser draws splats."""
MOST_WIDTH, MOST_HEIGHT = 3840, 1080
LEAST_FOV, MOST_FOV = 0.01, 3.0
MOST_TASKS = 3
"""Files that wait to be saved; further clicks are ignored."""
VIDEO_HEIGHT = 512
TURNTABLE_VIEWS, BEYOND_DEGREES = 90, 30.0


class Session:
    """A browser and its view. One thread draws, with ``lock`` held, since avatars are shared."""

    def __init__(self, client: Any, scene: Scene, expressions: int, lock: threading.Lock):
        self._client, self._scene, self._lock = client, scene, lock
        self._changed, self._closed = threading.Event(), False
        self._draft = 0.5
        self._handles: dict[int, Any] = {}
        self._seen: FloatArray | None = None
        self._offset: FloatArray = np.zeros(3)
        self._tasks: list[Callable[[], None]] = []
        self._told = -np.inf
        self._threads = resolve(THREADS)
        self._look_at_head()
        self._panel = ControlPanel(client, scene, expressions, self._changed.set, self._jump)
        client.camera.on_update(lambda _: self._camera_moved())
        self._panel.screenshot.on_click(lambda _: self._do(self._screenshot))
        self._panel.turntable.on_click(lambda _: self._do(self._turntable))
        self._panel.sequence.on_click(lambda _: self._do(self._sequence))
        if scene.first.live is not None:
            scene.first.live.listen(self._changed.set)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._changed.set()
        self._thread.start()

    def close(self) -> None:
        """Stop drawing; called when the browser disconnects."""
        self._closed = True
        if self._scene.first.live is not None:
            self._scene.first.live.forget(self._changed.set)
        self._changed.set()
        self._thread.join(timeout=10.0)

    # -------------------------------------------------------------- the loop

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._closed:
            try:
                if self._tasks:
                    self._tasks.pop(0)()
                self._changed.wait(timeout=None if not self._panel.playing else 0.0)
                if self._panel.playing:
                    frames = int((time.perf_counter() - last) * self._panel.fps)
                    if frames:
                        last += frames / self._panel.fps
                        self._panel.advance(frames)
                    else:
                        time.sleep(0.005)
                        continue
                else:
                    last = time.perf_counter()
                self._changed.clear()
                self._show(self._draft)
                whole = self._panel.playing or self._panel.state.splats
                if not whole and not self._changed.wait(timeout=REST_S):
                    self._show(1.0)
            except HeadbenchError as error:
                self._say(str(error))
            except Exception as error:
                if self._closed:
                    return
                log.exception("the viewer could not draw")
                self._say(f"{type(error).__name__}: {error}")

    def _show(self, scale: float) -> None:
        state, start = self._panel.state, time.perf_counter()
        if state.splats:
            self._show_splats(state, start)
            return
        for handle in self._handles.values():
            handle.visible = False
        whole = scale == 1.0
        # With one thread the last digits differ, so full images are drawn as for metrics.
        with self._lock, nullcontext() if whole else self._threads(1):
            drawn = draw(self._scene, state, self._view(), self._size(), scale)
        between = time.perf_counter()
        self._client.scene.set_background_image(
            drawn.image, "png" if whole else "jpeg", jpeg_quality=DRAFT_QUALITY
        )
        self._client.flush()
        end = time.perf_counter()
        if not whole:
            self._draft = float(np.clip(scale * np.sqrt(DRAFT_S / (end - start)), LEAST_DRAFT, 0.99))
            if end - self._told < TOLD_S:
                return
        self._told = end
        each = ", ".join(f"{name} {time_:.0f} ms" for name, time_ in drawn.milliseconds.items())
        height, width = drawn.image.shape[:2]
        self._panel.show_times(
            f"{width}x{height}{'' if whole else ' while moving'}: {each}; sent in {1e3 * (end - between):.0f} ms"
        )

    def _show_splats(self, state: State, start: float) -> None:
        self._client.scene.set_background_image(None)
        told = []
        right = self._view().world_to_camera[0, :3]
        middle = (len(self._scene.shown) - 1) / 2
        for number, shown in enumerate(self._scene.shown):
            with self._lock:
                splats = splats_of(self._scene, shown, state, self._view())
            if splats is None:
                told.append(f"{shown.label} has no plain splats")
                continue
            drawn = time.perf_counter()
            if not self._handles:
                self._offset = right
                self._step_back()
            centers = SCALE * (splats.centers + ((number - middle) * APART_M) * self._offset)
            values = (
                centers.astype(np.float32),
                SCALE**2 * splats.covariances,
                *(splats.colors, splats.opacities),
            )
            if number in self._handles:
                self._handles[number].visible = True
                self._handles[number].set_gaussians(*values)
            else:
                add = self._client.scene.add_gaussian_splats
                self._handles[number] = add(f"/avatar {number}", *values)
            packed = time.perf_counter()
            told.append(
                f"{shown.label}: {len(centers):,} splats posed in {1e3 * (drawn - start):.0f} ms,"
                f" packed in {1e3 * (packed - drawn):.0f} ms"
            )
            start = packed
        self._client.flush()
        self._panel.show_times("; ".join(told))

    # -------------------------------------------------------------- the camera

    def _size(self) -> tuple[int, int]:
        """Width and height of the browser's canvas, pixels, at most `MOST_WIDTH` by `MOST_HEIGHT`."""
        camera = self._client.camera
        width, height = max(1, camera.image_width), max(1, camera.image_height)
        factor = min(1.0, MOST_WIDTH / width, MOST_HEIGHT / height)
        return max(1, round(width * factor)), max(1, round(height * factor))

    def _camera_moved(self) -> None:
        """Record a visible change; a browser that smooths a motion also reports smaller ones."""
        camera = self._client.camera
        now = np.concatenate([camera.position / SCALE, camera.wxyz, [camera.fov, *self._size()]])
        if self._seen is None or np.abs(now - self._seen).max() > STILL:
            self._seen = now
            self._changed.set()

    def _view(self) -> FreeView:
        camera = self._client.camera
        to_world = np.eye(4)
        to_world[:3, :3] = rotations(np.array([camera.wxyz]))[0]
        to_world[:3, 3] = np.asarray(camera.position) / SCALE
        return FreeView(np.linalg.inv(to_world), float(np.clip(camera.fov, LEAST_FOV, MOST_FOV)))

    def _look_at_head(self) -> None:
        """Start in front of the head, which fills the view as in a camera of the capture."""
        clip = self._scene.first.clip
        cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
        front = turntable(cameras, self._scene.first.center, 1, 0.0)[0].camera
        self._place(front)

    def _place(self, view: Camera) -> None:
        camera, center = self._client.camera, self._scene.first.center
        with self._client.atomic():
            camera.up_direction = -view.world_to_camera[1, :3]
            camera.position = SCALE * view.center
            depth = float(np.linalg.norm(center - view.center))
            camera.look_at = SCALE * (view.center + depth * view.world_to_camera[2, :3])
            camera.fov = FreeView.of(view).fov

    def _step_back(self) -> None:
        """Show all avatars side by side."""
        camera, factor = self._client.camera, 1 + 0.5 * (len(self._scene.shown) - 1)
        camera.position = camera.look_at + factor * (camera.position - camera.look_at)

    def _jump(self, name: str) -> None:
        if name:
            self._place(self._scene.first.clip.cameras[name])
        self._changed.set()

    # -------------------------------------------------------------- saved files

    def _do(self, task: Callable[[], None]) -> None:
        if len(self._tasks) < MOST_TASKS:
            self._tasks.append(task)
        self._changed.set()

    def _say(self, text: str) -> None:
        self._client.add_notification(title="Not done", body=text, auto_close_seconds=20)

    def _screenshot(self) -> None:
        with self._lock:
            image = draw(self._scene, self._panel.state, self._view(), self._size()).image
        with tempfile.TemporaryDirectory() as folder:
            content = write_png(Path(folder) / "view.png", image, COMPOSITE)
        self._client.send_file_download("headbench.png", content, save_immediately=True)

    def _turntable(self) -> None:
        clip = self._scene.first.clip
        cameras = [clip.cameras[name] for name in sorted({key.camera for key in clip.splits["train"]})]
        views = turntable(cameras, self._scene.first.center, TURNTABLE_VIEWS, BEYOND_DEGREES)
        state = replace(self._panel.state, camera="")
        self._save("turntable", ((state, FreeView.of(view.camera)) for view in views), len(views))

    def _sequence(self) -> None:
        state, view = self._panel.state, self._view()
        steps = self._panel.timesteps
        self._save("sequence", ((replace(state, timestep=step), view) for step in steps), len(steps))

    def _save(self, name: str, moments: Iterator[tuple[State, FreeView]], count: int) -> None:
        width, height = self._size()
        factor = min(1.0, VIDEO_HEIGHT / height)
        size = 2 * max(1, round(width * factor / 2)), 2 * max(1, round(height * factor / 2))
        bar = self._client.gui.add_progress_bar(0.0)

        def images() -> Iterator[ByteArray]:
            for number, (state, view) in enumerate(moments, 1):
                if self._closed:
                    raise HeadbenchError("the browser has gone")
                with self._lock:
                    yield draw(self._scene, state, view, size).image
                bar.value = 100 * number / count

        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"{name}.webm"
                write_browser_video(path, images(), float(self._panel.fps), COMPOSITE)
                self._client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
        finally:
            bar.remove()
