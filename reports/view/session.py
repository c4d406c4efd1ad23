"""The session of one browser: continuously draws the view of its controls and camera."""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...bench.contracts import ByteArray, Camera, FloatArray, FrameKey, HeadPose, SplatAvatar
from ...bench.errors import HeadbenchError
from ...bench.experiments.viewpoints import turntable
from ...bench.io.images import quantise, write_browser_video, write_png
from ...bench.io.provenance import COMPOSITE
from ...bench.registry import resolve
from .scene import LIVE, NEUTRAL, FreeView, Scene, ShownAvatar, Sliders, State

LABEL_PX = 22
CAPTURED = "captured"
LEAST_PX = 16
HEAD_ASPECT = 0.75
"""Aspect ratio of a head; the arrangement of panels maximises its size."""


class DrawnPanes(NamedTuple):
    """An (H, W, 3) image and the milliseconds that each avatar took."""

    image: ByteArray
    milliseconds: dict[str, float]


class SplatArrays(NamedTuple):
    """Splats of an avatar, float32: (N, 3) centres in metres, (N, 3, 3) covariances, (N, 3) colours, (N, 1) opacities."""

    centers: FloatArray
    covariances: FloatArray
    colors: FloatArray
    opacities: FloatArray


def key_of(scene: Scene, state: State) -> FrameKey | None:
    """The frame of the pose, of the requested camera if it was recorded. None: neutral."""
    recording = scene.recordings.get(state.recording)
    cameras = None if recording is None else recording.get(state.timestep)
    if cameras is None:
        return None
    return cameras.get(state.camera) or cameras[min(cameras)]


def draw(scene: Scene, state: State, view: FreeView, size: tuple[int, int], scale: float = 1.0) -> DrawnPanes:
    """Draw all avatars in one image of about ``size`` (width, height) times ``scale``.

    In a camera of the capture, panels show frames as for metrics, scaled to fit (below a scale of 1, drawn at
    that size); otherwise the free view.
    """
    key = key_of(scene, state)
    captured = key if key is not None and key.camera == state.camera else None
    truth = captured is not None and captured.subject == scene.first.clip.subject
    if truth:
        state = replace(state, background=tuple(scene.first.clip.background))
    labels = [*([CAPTURED] if truth else []), *(shown.label for shown in scene.shown)]
    width, height = (max(LEAST_PX, round(side * scale)) for side in size)
    rows, columns = arrangement(len(labels), width, height)
    strip = max(1, round(LABEL_PX * scale))
    place = max(LEAST_PX, width // columns), max(LEAST_PX, height // rows - strip)
    ground = np.round(255 * np.array(state.background)).astype(np.uint8)
    panels, milliseconds = [], {}
    if truth and captured is not None:
        panels.append(_fitted(scene.first.clip.image(captured), place, ground))
    for shown in scene.shown:
        start = time.perf_counter()
        if truth and captured is not None and shown.clip.subject == captured.subject:
            panel = _frame(shown, state, captured, place if scale < 1 else None)
        else:
            camera = moved(scene, shown, view.camera(*place), key)
            panel = quantise(shown.avatar.render(camera, pose_of(shown, state, key), state.background).rgb)
        milliseconds[shown.label] = 1e3 * (time.perf_counter() - start)
        panels.append(_fitted(panel, place, ground))
    image = np.full((rows * (place[1] + strip), columns * place[0], 3), ground, np.uint8)
    ink = (0, 0, 0) if ground.mean() > 127 else (255, 255, 255)
    for number, (label, panel) in enumerate(zip(labels, panels)):
        top, left = number // columns * (place[1] + strip), number % columns * place[0]
        image[top + strip : top + strip + place[1], left : left + place[0]] = panel
        where = (left + round(6 * scale), top + round(16 * scale))
        cv2.putText(image, label, where, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * scale, ink, 1, cv2.LINE_AA)
    return DrawnPanes(image, milliseconds)


def arrangement(count: int, width: int, height: int) -> tuple[int, int]:
    """Rows and columns for a number of panels that maximise the size of a head in each."""

    def head(rows: int) -> float:
        return min(width / -(-count // rows) / HEAD_ASPECT, height / rows)

    rows = max(range(1, count + 1), key=head)
    return rows, -(-count // rows)


def pose_of(shown: ShownAvatar, state: State, key: FrameKey | None) -> HeadPose:
    """The pose of an avatar."""
    return state.sliders.added(shown.live_pose() if state.recording == LIVE else shown.pose(key))


def moved(scene: Scene, shown: ShownAvatar, camera: Camera, key: FrameKey | None) -> Camera:
    """Convert a camera to an avatar's world; for another subject, relative to its head."""
    motion = np.eye(4)
    motion[:3, 3] = scene.first.center - shown.center
    translated = Camera(camera.id, camera.width, camera.height, camera.K, camera.world_to_camera @ motion)
    return shown.camera(translated, key)


def splats_of(scene: Scene, shown: ShownAvatar, state: State, view: FreeView) -> SplatArrays | None:
    """Splats of an avatar in the first one's world, coloured for the view; None if it provides none."""
    if not isinstance(shown.avatar, SplatAvatar):
        return None
    key = key_of(scene, state)
    camera = moved(scene, shown, view.camera(LEAST_PX, LEAST_PX), key)
    splats = shown.avatar.splats(pose_of(shown, state, key), camera)
    if splats.colors is None:
        return None
    # From the method's world into that of the first avatar: the same camera in both.
    back = np.linalg.inv(view.world_to_camera) @ camera.world_to_camera
    axes = (back[:3, :3] @ rotations(splats.quats)) * splats.scales[:, None, :]
    return SplatArrays(
        (splats.means @ back[:3, :3].T + back[:3, 3]).astype(np.float32),
        np.asarray(axes @ axes.transpose(0, 2, 1), np.float32),
        np.clip(splats.colors, 0.0, 1.0),
        splats.opacities[:, None],
    )


def _frame(shown: ShownAvatar, state: State, key: FrameKey, place: tuple[int, int] | None) -> ByteArray:
    """A frame of the capture as for metrics; with a place, drawn at most at its size."""
    pose, camera = pose_of(shown, state, key), shown.form.clip.cameras[shown.form.key(key).camera]
    if place is None:
        return quantise(shown.form.restore(key, shown.avatar.render(camera, pose, state.background).rgb))
    factor = min(1.0, place[0] / camera.width, place[1] / camera.height)
    small = camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
    return quantise(shown.avatar.render(small, pose, state.background).rgb)


def _fitted(image: ByteArray, place: tuple[int, int], ground: Sequence[int] | ByteArray) -> ByteArray:
    """Fit an image centred into its place; unchanged if it already has its size."""
    height, width = image.shape[:2]
    if (width, height) == place:
        return image
    factor = min(place[0] / width, place[1] / height)
    new = max(1, round(width * factor)), max(1, round(height * factor))
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_NEAREST
    whole = np.full((place[1], place[0], 3), ground, np.uint8)
    left, top = (place[0] - new[0]) // 2, (place[1] - new[1]) // 2
    whole[top : top + new[1], left : left + new[0]] = cv2.resize(image, new, interpolation=how)
    return whole


def rotations(quats: FloatArray) -> FloatArray:
    """(N, 3, 3) of (N, 4) unit quaternions wxyz."""
    w, x, y, z = np.asarray(quats, np.float64).T
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


JAW, NECK, EYES = ("open", "sideways", "roll"), ("nod", "turn", "tilt"), ("up and down", "sideways")
REACH = {"jaw": 0.4, "neck": 0.5, "eyes": 0.5}
"""Range of the sliders of joints, radians."""
FREE = "free"
IMAGES, SPLATS = "images", "splats"
MOST_FPS = 60
LABELS = """<style>
:root { --mantine-color-dimmed: light-dark(#495057, #c1c2c5) !important; }
p.mantine-Text-root:has(> label) { font-size: 1em !important; letter-spacing: 0 !important; }
</style>"""
"""Labels of 13 pixels with a contrast above 4.5; viser's have 11.6 pixels, narrowed, and a contrast of 3.3."""


class ControlPanel:
    """Controls in the browser of ``client``; ``changed`` is called after each change, ``jumped`` with a camera's name.

    The caller sets the actions of the buttons ``screenshot``, ``turntable`` and ``sequence``.
    """

    def __init__(
        self,
        client: Any,
        scene: Scene,
        expressions: int,
        changed: Callable[[], None],
        jumped: Callable[[str], None],
    ):
        gui = client.gui
        self._scene, self._changed = scene, changed
        self._expressions: dict[str, list[tuple[Any, FloatArray]]] = {}
        self._joints: dict[str, list[Any]] = {}
        gui.set_panel_label("headbench")
        gui.add_html(LABELS)
        self._legend = gui.add_markdown("")
        hint = "Images are exact and drawn by the server; splats are drawn by the browser, about 40 dB near."
        mode = gui.add_dropdown("Drawn as", (IMAGES, SPLATS), initial_value=IMAGES, hint=hint)
        self._mode = self._add(mode)
        self._background = self._add(gui.add_rgb("Background", initial_value=(255, 255, 255)))
        with gui.add_folder("Recording"):
            names = (*([LIVE] if scene.first.live else []), NEUTRAL, *scene.recordings)
            self._recording = gui.add_dropdown("Sequence", names, initial_value=names[0])
            self._timestep = self._add(gui.add_slider("Frame", min=0, max=1, step=1, initial_value=0))
            self._playing = self._add(gui.add_checkbox("Play", initial_value=False))
            self._fps = gui.add_slider("Frames per second", min=1, max=MOST_FPS, step=1, initial_value=25)
            cameras = FREE, *sorted(scene.first.clip.cameras)
            hint = "A camera of the capture shows the captured image next to it, if there is one."
            self._camera = gui.add_dropdown("Camera", cameras, initial_value=FREE, hint=hint)
        self._recording.on_update(lambda _: self._recording_chosen())
        self._camera.on_update(lambda _: jumped("" if self._camera.value == FREE else self._camera.value))
        heads = scene.expressions(expressions)
        for version, shapes in heads.items():
            with gui.add_folder(f"Expressions of {version}" if len(heads) > 1 else "Expressions"):
                self._expressions[version] = [
                    (self._slider(gui, shape.name.capitalize(), shape.low, shape.high), shape.direction)
                    for shape in shapes
                ]
        for joint, names in (("jaw", JAW), ("neck", NECK), ("eyes", EYES)):
            with gui.add_folder(joint.capitalize()):
                self._joints[joint] = [
                    self._slider(gui, name.capitalize(), -REACH[joint], REACH[joint]) for name in names
                ]
        gui.add_button("Reset sliders").on_click(lambda _: self._reset())
        with gui.add_folder("Save"):
            self.screenshot = gui.add_button("Screenshot")
            self.turntable = gui.add_button("Turntable video")
            self.sequence = gui.add_button("Video of the sequence")
        self.show_times("")
        self._recording_chosen()

    @property
    def state(self) -> State:
        """State of the controls."""
        values = {name: tuple(map(_within, sliders)) for name, sliders in self._joints.items()}
        leading = {name: _coefficients(sliders) for name, sliders in self._expressions.items()}
        red, green, blue = (min(max(channel / 255, 0.0), 1.0) for channel in self._background.value)
        return State(
            Sliders(leading, **values),
            self._recording.value,
            self._steps[min(int(_within(self._timestep)), len(self._steps) - 1)],
            "" if self._camera.value == FREE else self._camera.value,
            (red, green, blue),
            self._mode.value == SPLATS,
        )

    @property
    def fps(self) -> float:
        """Frames per second of the running sequence."""
        return _within(self._fps)

    @property
    def playing(self) -> bool:
        """Whether a sequence runs."""
        return bool(self._playing.value) and len(self._steps) > 1

    @property
    def timesteps(self) -> Sequence[int]:
        """Of the chosen sequence, in order."""
        return self._steps

    def advance(self, frames: int) -> None:
        """Advance the sequence, in a loop."""
        self._timestep.value = (self._timestep.value + frames) % len(self._steps)

    def show_times(self, text: str) -> None:
        """Show measurements above the controls."""
        names = " | ".join(shown.label for shown in self._scene.shown)
        lost = "".join(f"\n\nNot shown: {reason}" for reason in self._scene.missing)
        self._legend.content = f"**{names}**\n\n{text}\n\nDrawn by trained models.{lost}"

    def _slider(self, gui: Any, name: str, low: float, high: float) -> Any:
        low, high = float(f"{low:.3g}"), float(f"{high:.3g}")
        return self._add(gui.add_slider(name, min=low, max=high, step=high / 100, initial_value=0.0))

    def _add(self, handle: Any) -> Any:
        handle.on_update(lambda _: self._changed())
        return handle

    def _recording_chosen(self) -> None:
        self._steps = sorted(self._scene.recordings.get(self._recording.value, {0: {}}))
        self._timestep.value = 0
        self._timestep.max = max(1, len(self._steps) - 1)
        self._timestep.disabled = self._playing.disabled = len(self._steps) < 2
        self._changed()

    def _reset(self) -> None:
        expressions = [slider for sliders in self._expressions.values() for slider, _ in sliders]
        for slider in (*expressions, *chain.from_iterable(self._joints.values())):
            slider.value = 0.0
        self._changed()


def _within(slider: Any) -> float:
    """The value of a slider, clamped to its range, since the browser may send any value."""
    return min(max(slider.value, slider.min), slider.max)


def _coefficients(sliders: Sequence[tuple[Any, FloatArray]]) -> tuple[float, ...]:
    """Sum of the directions of expressions times the values of their sliders; () if all are at rest."""
    moved = [_within(slider) * direction for slider, direction in sliders if slider.value]
    return tuple(np.sum(moved, axis=0).tolist()) if moved else ()


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
            colors = splats.colors, splats.opacities
            values = (centers.astype(np.float32), SCALE**2 * splats.covariances, *colors)
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
