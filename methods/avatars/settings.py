"""Settings of the exports, the coded files and the imports of avatars; imports neither torch nor numpy."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import tyro

from ...bench.engine.config import AvatarFolder
from ...bench.options import DependentOptions
from ...datasets.options import CaptureOptions


@dataclass(frozen=True)
class Precision:
    """Quantisation steps of the parts of a coded avatar; smaller is finer, and 0 keeps a part as float32.

    Each step is in a unit in which equal errors are equally visible, so that one number serves a whole part. With a capture,
    steps are those of a splat of average visibility in the training views, and others have steps in inverse proportion to
    their visibility (`coder.visibility_classes`). ``headbench export compact --compare`` measures what each costs.
    """

    step: float = 1.0
    """Factor of all steps: a coarser or finer codec with the same balance."""
    positions: float = 0.08
    """Step of local positions, in the splat's own size (geometric mean of its three standard deviations)."""
    scales: float = 0.045
    """Step of log-scales: 0.045 is an error of at most 2.3 %."""
    rotations: float = 0.02
    """Step of the components of quaternions: 0.02 is an error of about 0.7 degrees."""
    opacities: float = 0.12
    """Step of opacity logits: an opacity is off by 0.015 at most."""
    harmonics: float = 0.0115
    """Step of colours by spherical harmonics, in colour: root mean square over directions."""
    colors: float = 0.0115
    """Step of the separate colours of splats, added to those of the planes."""
    planes: float = 0.0115
    """Step of the colour contribution of the channels of a plane, in [0, 1], as weighted by the colour network."""
    lines: float = 0.012
    """Step of the offset (logits) by the channels of one line at coefficient 1, as weighted by the offset network."""
    networks: float = 0.01
    """Step of network weights, relative to the largest weight of the same output: 1/127 would be 8 bits."""
    tables: float = 0.2
    """Step of trained features (of a hash grid, or of splats that a network shades), in their standard deviation."""
    subject: float = 1e-5
    """Step of the subject's static offset, metres."""

    def __post_init__(self) -> None:
        for part, step in self.parts.items():
            if not 0 <= step < 1:
                raise ValueError(f"{part} must be at least 0 and below 1, found {step}")
        if not 0 < self.step <= MAX_STEP:
            raise ValueError(f"step must be above 0 and at most {MAX_STEP:g}, found {self.step}")

    @property
    def parts(self) -> dict[str, float]:
        """Steps by part, without the factor."""
        return {name: step for name, step in asdict(self).items() if name != "step"}

    @property
    def scaled(self) -> Precision:
        """The same steps with the factor 1."""
        return Precision(**{part: min(self.step * step, LARGEST_STEP) for part, step in self.parts.items()})


MAX_STEP, LARGEST_STEP = 64.0, 0.999
EXACT = Precision(**dict.fromkeys(Precision().parts, 0.0))
"""Nothing is rounded."""


@dataclass(frozen=True)
class AvatarOptions(CaptureOptions):
    """Avatar to export and output file."""

    avatar: AvatarFolder

    out: str
    """File to write."""
    method: str = ""
    """Method of the avatar as package.module:SPEC, where it is not registered."""


@dataclass(frozen=True)
class ExportOptions(AvatarOptions):
    """Avatar and pose to export."""

    capture: str | None = None
    """Capture with the pose to write; without one the pose is neutral."""
    timestep: int | None = None
    """Timestep of the capture; default: the first of its training frames."""
    directions: int = 96
    """Number of viewing directions, evenly spread over the sphere, in which colours other than spherical harmonics are sampled."""
    dependent = (DependentOptions(("timestep", "reader", "head", "cy", "set"), "capture"),)

    def __post_init__(self) -> None:
        if self.directions < 32:
            raise ValueError(
                f"directions must be at least 32, twice the coefficients, found {self.directions}"
            )


@dataclass(frozen=True)
class ExportPlySettings(ExportOptions):
    """Write an avatar in one pose as a 3D Gaussian splatting PLY, in full precision, for common viewers."""


@dataclass(frozen=True)
class ExportGlbSettings(ExportOptions):
    """Write an avatar in one pose as binary glTF with KHR_gaussian_splatting, in full precision."""


@dataclass(frozen=True)
class ExportSogSettings(ExportOptions):
    """Write an avatar in one pose as SOG, for web viewers, in about a sixth of the size of a PLY. Needs gaussforge (extra
    `formats`)."""


@dataclass(frozen=True)
class ImportGASettings(CaptureOptions):
    """Import a GaussianAvatars PLY with the flame_param.npz beside it or the capture it was trained on."""

    ply: tyro.conf.Positional[str]
    """The PLY, with a column binding_0 (`point_cloud/iteration_<N>/point_cloud.ply`)."""
    out: str
    """Folder to write; `headbench export ply`, `headbench render` and the method ga load it."""
    capture: str | None = None
    """Capture it was trained on, in a layout that a reader knows; not needed with a flame_param.npz and --head."""
    flame_param: str | None = None
    """The parameters that the official repository stored with the splats, of one timestep or of all; default: the file
    flame_param.npz beside the PLY, if there is one. "none" ignores it."""
    subject: str = ""
    """Name of the subject, if there is no --capture."""
    dependent = (
        DependentOptions(("reader", "cy"), "capture"),
        DependentOptions(("subject",), "capture", False),
    )


@dataclass(frozen=True)
class ExportHtmlSettings(AvatarOptions):
    """Write an avatar as one HTML file with sliders; it needs no network and no other file.

    For methods with splats, and browsers with WebGL2. Prints the size, and the PSNR relative to the avatar's own frames.
    """

    capture: str | None = None
    """Capture whose sequences the page plays. It also determines the pose of the head, the range of expressions without a
    name (otherwise -2 to 2), and the resolution to which a large picture is smoothed."""
    expressions: int = 10
    """Number of expressions with sliders: the named ones, else the single coefficients, that move the head farthest."""
    degree: int = 3
    """Degree of the spherical harmonics of view-dependent colours, 0 to 3; a lower degree takes fewer bytes."""
    title: str = ""
    """Title of the page; default: the names of subject and method."""
    dependent = (DependentOptions(("reader", "head", "cy", "set"), "capture"),)

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= 3:
            raise ValueError(f"degree is {self.degree}; from 0 to 3")
        if self.expressions < 0:
            raise ValueError(f"expressions is {self.expressions}; at least 0")


@dataclass(frozen=True)
class ExportLamSettings(AvatarOptions):
    """Write an avatar as the folder that LAM's viewers animate with ARKit's blendshapes: LAM_WebRender, OpenAvatarChat, and
    the npm package gsplat-flame-avatar-renderer.

    For methods with splats. The viewers move splats by linear blendshapes and turn the whole head; a splat's colour, opacity,
    size and direction do not change. Prints the size, and the PSNR relative to the avatar's own frames.
    """

    out: str
    """Folder to write, or a file NAME.zip with the folder NAME, which the viewers load."""
    capture: str | None = None
    """Capture the avatar was trained on; its first frame determines the pose of the head from which colours are seen."""
    dependent = (DependentOptions(("reader", "head", "cy", "set"), "capture"),)


@dataclass(frozen=True)
class CompactSettings(CaptureOptions):
    """Store an avatar of a native method by the common codec: quantised by visible effect, and compressed."""

    avatar: AvatarFolder

    out: str
    """Folder to write: the compact file, and the head model beside it."""
    compare: str | None = None
    """Capture that the avatar was trained on. Steps follow the visibility of splats in its training views, and quality is
    measured on held-out frames."""
    frames: int = 8
    """With --compare: held-out frames to compare on, evenly spread over both held-out splits."""
    scale: int = 1
    """With --compare: factor by which the images are enlarged. Above 1 there is no ground truth to compare with, only the exact
    avatar."""
    precision: Precision = field(default_factory=Precision)
    """Quantisation steps of each part."""
    dependent = (DependentOptions(("frames", "scale", "reader", "head", "cy", "set"), "compare"),)

    def __post_init__(self) -> None:
        if self.frames < 1 or self.scale < 1:
            raise ValueError(f"frames and scale must be at least 1, found {self.frames} and {self.scale}")
