"""Methods that take note of what they are trained with: their render is brighter the longer they were trained."""

from dataclasses import replace

from toy_plugin import ToyAvatar

from headbench.bench.specs import MethodSpec

FITS = []
"""(frames to train with, budget) of every training."""
POSES = []
"""The tracked poses of every training's clip."""
RENDERED = []
"""(timestep, camera) of every frame."""


class Avatar(ToyAvatar):
    def render(self, camera, pose, background=(1.0, 1.0, 1.0)):
        RENDERED.append((pose.timestep, camera.id))
        return super().render(camera, pose, background)


class Method:
    killed = ()
    """Iterations of the trainings that are killed half-way."""

    def fit(self, clip, out, budget, *, device, seed, progress):
        FITS.append((clip.splits["train"], budget))
        POSES.append(clip.poses)
        for key in clip.splits["train"]:
            clip.image(key)
        out.mkdir(parents=True, exist_ok=True)
        assert not (out / "half.txt").exists()
        (out / "half.txt").write_text("half")
        if budget.iterations in Method.killed:
            raise KeyboardInterrupt
        (out / "half.txt").unlink()
        (out / "level.txt").write_text(str(1 - 1 / (1 + (budget.iterations or budget.seconds))))
        return self.load(out, device=device)

    def load(self, path, *, device):
        return Avatar(path)


class Peeking(Method):
    """An adapter to code outside, which is given whole clips, and looks at a test frame."""

    def fit(self, clip, out, budget, **arguments):
        clip.image(clip.splits["train"][0]._replace(camera="2"))
        return super().fit(clip, out, budget, **arguments)


METHOD = MethodSpec(
    "noting", "grey", "curve_plugin:Method", presets={"smoke": {"budget": {"iterations": 64}}}
)
TIMED = replace(METHOD, name="timed", presets={"smoke": {"budget": {"seconds": 8.0}}})
ENDLESS = replace(METHOD, name="endless", presets={})
PEEKING = replace(METHOD, name="peeking", implementation="curve_plugin:Peeking", native=False)
