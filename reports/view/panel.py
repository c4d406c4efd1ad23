"""The controls of one browser, as viser elements, and their state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from .scene import NEUTRAL, Scene
from .state import Sliders, State

JAW, NECK, EYES = ("open", "sideways", "roll"), ("nod", "turn", "tilt"), ("up and down", "sideways")
REACH = {"jaw": 0.4, "neck": 0.5, "eyes": 0.5}
"""Range of the sliders of joints, radians."""
FREE = "free"
IMAGES, SPLATS = "images", "splats"
MOST_FPS = 60


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
        self._expressions: dict[str, list[Any]] = {}
        self._joints: dict[str, list[Any]] = {}
        gui.set_panel_label("headbench")
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
            self._recording = gui.add_dropdown(
                "Sequence", (NEUTRAL, *scene.recordings), initial_value=NEUTRAL
            )
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
        for version, reach in scene.heads().items():
            with gui.add_folder(f"Expressions of {version}"):
                self._expressions[version] = [
                    self._slider(gui, str(number + 1), float(reach[number]))
                    for number in range(min(expressions, len(reach)))
                ]
        for joint, names in (("jaw", JAW), ("neck", NECK), ("eyes", EYES)):
            with gui.add_folder(joint.capitalize(), expand_by_default=joint == "jaw"):
                self._joints[joint] = [self._slider(gui, name, REACH[joint]) for name in names]
        gui.add_button("Reset sliders").on_click(lambda _: self._reset())
        with gui.add_folder("Save", expand_by_default=False):
            self.screenshot = gui.add_button("Screenshot")
            self.turntable = gui.add_button("Turntable video")
            self.sequence = gui.add_button("Video of the sequence")
        self.show_times("")
        self._recording_chosen()

    @property
    def state(self) -> State:
        """State of the controls."""
        values = {name: tuple(map(_within, sliders)) for name, sliders in self._joints.items()}
        leading = {name: tuple(map(_within, sliders)) for name, sliders in self._expressions.items()}
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
        """Frames per second of a sequence that runs."""
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
        """Go on in the sequence, from the end to its start."""
        self._timestep.value = (self._timestep.value + frames) % len(self._steps)

    def show_times(self, text: str) -> None:
        """Show measurements above the controls."""
        names = " | ".join(shown.label for shown in self._scene.shown)
        lost = "".join(f"\n\nNot shown: {reason}" for reason in self._scene.missing)
        self._legend.content = f"**{names}**\n\n{text}\n\nDrawn by trained models.{lost}"

    def _slider(self, gui: Any, name: str, reach: float) -> Any:
        reach = float(f"{reach:.3g}")
        return self._add(gui.add_slider(name, min=-reach, max=reach, step=reach / 100, initial_value=0.0))

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
        for sliders in (*self._expressions.values(), *self._joints.values()):
            for slider in sliders:
                slider.value = 0.0
        self._changed()


def _within(slider: Any) -> float:
    """The value of a slider, in its range whatever the browser sent."""
    return min(max(slider.value, slider.min), slider.max)
