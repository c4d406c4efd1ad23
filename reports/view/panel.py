"""The controls of one browser, as viser elements, and their state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any

import numpy as np

from ...bench.contracts import FloatArray
from .scene import LIVE, NEUTRAL, Scene, Sliders, State

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

    Attributes
    ----------
    screenshot, turntable, sequence : button
        Buttons, whose actions the caller sets.
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
        self._mode = self._add(
            gui.add_dropdown(
                *("Drawn as", (IMAGES, SPLATS)),
                initial_value=IMAGES,
                hint="Images are exact and drawn by the server; splats are drawn by the browser, about 40 dB near.",
            )
        )
        self._background = self._add(gui.add_rgb("Background", initial_value=(255, 255, 255)))
        with gui.add_folder("Recording"):
            names = (*([LIVE] if scene.first.live else []), NEUTRAL, *scene.recordings)
            self._recording = gui.add_dropdown("Sequence", names, initial_value=names[0])
            self._timestep = self._add(gui.add_slider("Frame", min=0, max=1, step=1, initial_value=0))
            self._playing = self._add(gui.add_checkbox("Play", initial_value=False))
            self._fps = gui.add_slider("Frames per second", min=1, max=MOST_FPS, step=1, initial_value=25)
            cameras = sorted(scene.first.clip.cameras)
            self._camera = gui.add_dropdown(
                *("Camera", (FREE, *cameras)),
                initial_value=FREE,
                hint="A camera of the capture shows the captured image next to it, if there is one.",
            )
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
