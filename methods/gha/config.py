"""Settings of GHA. Light: neither torch nor numpy is imported here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class GHAConfig:
    """Gaussian Head Avatar (CVPR 2024). The defaults are the published values.

    Lengths are canonical units: the head's own frame, ``unit`` metres each.

    Attributes
    ----------
    schedule_length : iterations of the published run, both phases.
    mesh_fraction : part of the budget that the mesh phase takes.
    unit : metres of one canonical unit.
    landmarks : how many points of the tracked face say where expression rules.
    near_squared, far_squared : squared distances from the nearest landmark up to which expression alone rules, and
        from which on head pose alone does (0.1 and 0.25 units squared are 3.2 and 5 cm).
    start : what the signed distance is fitted to before the mesh phase. "sphere" as published; "mesh", the tracked
        mesh, saves a short run the way from the sphere to a head.
    start_steps : steps of that fit.
    grid_vertices : vertices of the tetrahedral grid about the head.
    subdivide : take the Gaussians from a grid of half the spacing, as published.
    max_points : thin the points taken from the mesh to this number; None keeps them all.
    mouth_points : further points, drawn in a box behind the lips.
    features, channels : features of a point, and channels of what is splatted; the first three are a colour.
    geometry_hidden, expression_color_hidden, ... : widths of the networks' hidden layers.
    sr_widths : widths of the super-resolution network's blocks. The first works at the splatted size, each further
        one at twice the size before: their number decides by how much splats are drawn smaller than the image.
    residual : let super-resolution add to the splatted colours instead of making colours, as published, of nothing;
        a short run then starts where splatting alone arrives, and splatting with the colours of the mesh phase.
    neutral_jaw : radians that the jaw is open in the neutral head (about the first axis). Displacements belong to
        places, so between lips that touch they cannot part; published landmarks start at any first timestep.
    motion_steps : steps that fit the deformation by expression to the head model's own (`TrackedMotion`) before the
        mesh phase; 0 as published.
    motion_weight : of the same error in both phases, relative to the vertices' motion; 0 as published.
    appearance_margin : how far beyond its training range, in parts of that range, each driving value is followed by
        the networks of colour and attributes; None, as published, sets no end. What lies far outside of training
        otherwise tints a face.
    zero_initialised : start all controllers without an effect of expression and pose, deformation and attributes with outputs
        of zero, instead of small random ones: what a short capture never shows then stays without effect.
    angle_unit : radians of jaw and eye angles that count as 1 in the expression code. Expression coefficients are of
        the order of 1, and beside them a short run hardly notices a jaw's tenths of a radian.
    expression_noise : standard deviation of what is added to each driving value that the networks of colour and
        attributes see in training, drawn anew in every iteration. A few timesteps leave most directions of the code
        unseen, in which networks then do as they like; noise keeps them from it. 0 as published.
    displacement_scale, attribute_scale : factors of the networks' outputs.
    initial_opacity : of all Gaussians.
    mesh_views, mesh_size : views of a timestep in one iteration of the mesh phase, and the longer side of their images
        in pixels; smaller images stay as they are.
    landmark_weight : of the mean squared distance, in square units, between moved and tracked landmarks.
    landmark_timesteps : timesteps whose landmarks one iteration of the mesh phase looks at; published is the one that
        its images show, but landmarks cost little, and a short run does not come to each timestep often.
    mesh_lr, landmark_lr : learning rates of the mesh phase.
    network_lr, position_lr, feature_lr, rotation_lr, scale_lr, opacity_lr, correction_lr : of the Gaussian phase, the
        last one for the corrections of the tracked head pose, one for each training timestep.
    final_rate : part of their learning rate that the Gaussian phase's tensors end with, log-linearly over the last
        half of the phase; 1 keeps them constant, as published.
    low_weight, structure_weight : weights of the L1 loss at the splatted size and of 1 - SSIM at the full one.
        The latter stands for the published 0.1 LPIPS, whose backbone is not ours to ship.
    low_image_variant : "paper" compares the splatted colours with area means of the image; "official" with every fourth
        pixel, as the authors' program does.
    augment : rescale the feature image by 0.8 to 1.25 before super-resolution, and cut out of it or put it at random,
        as published.
    checkpoint_every_s : seconds between checkpoints.
    """

    schedule_length: int = 600_000
    mesh_fraction: float = 0.05
    unit: float = 0.1
    landmarks: int = 424
    near_squared: float = 0.1
    far_squared: float = 0.25
    start: Literal["sphere", "mesh"] = "sphere"
    start_steps: int = 300
    grid_vertices: int = 277_410
    subdivide: bool = True
    max_points: int | None = None
    mouth_points: int = 3_000
    features: int = 128
    channels: int = 32
    geometry_hidden: tuple[int, ...] = (256,) * 5
    expression_color_hidden: tuple[int, ...] = (256, 256)
    pose_color_hidden: tuple[int, ...] = (128,)
    expression_deform_hidden: tuple[int, ...] = (256,) * 5
    pose_deform_hidden: tuple[int, ...] = (256, 256)
    expression_attribute_hidden: tuple[int, ...] = (256, 256, 256)
    pose_attribute_hidden: tuple[int, ...] = (128, 128)
    sr_widths: tuple[int, ...] = (128, 64, 32)
    residual: bool = False
    neutral_jaw: float = 0.0
    motion_steps: int = 0
    motion_weight: float = 0.0
    appearance_margin: float | None = None
    zero_initialised: bool = False
    angle_unit: float = 1.0
    expression_noise: float = 0.0
    displacement_scale: float = 0.3
    attribute_scale: float = 0.2
    initial_opacity: float = 0.3
    mesh_views: int = 4
    mesh_size: int = 256
    landmark_weight: float = 1.0
    landmark_timesteps: int = 1
    mesh_lr: float = 1e-3
    landmark_lr: float = 1e-4
    network_lr: float = 1e-4
    position_lr: float = 1e-5
    feature_lr: float = 1e-5
    rotation_lr: float = 1e-5
    scale_lr: float = 3e-5
    opacity_lr: float = 1e-4
    correction_lr: float = 1e-5
    final_rate: float = 1.0
    low_weight: float = 1.0
    structure_weight: float = 0.1
    low_image_variant: Literal["paper", "official"] = "paper"
    augment: bool = True
    checkpoint_every_s: float = 120.0

    def __post_init__(self) -> None:
        counts = (
            *("schedule_length", "landmarks", "grid_vertices", "features"),
            *("mesh_views", "mesh_size", "landmark_timesteps"),
        )
        for name in counts:
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, found {getattr(self, name)}")
        if not 3 <= self.channels <= 32:
            raise ValueError(f"channels must be 3 to 32, found {self.channels}")
        if not 0 < self.mesh_fraction < 1 or not 0 < self.initial_opacity < 1:
            raise ValueError("mesh_fraction and initial_opacity must lie between 0 and 1")
        if not 0 <= self.near_squared < self.far_squared:
            raise ValueError("near_squared must not be negative and far_squared must be larger")
        if not 0 < self.final_rate <= 1:
            raise ValueError(f"final_rate must lie in (0, 1], found {self.final_rate}")
        if not self.sr_widths or min(self.sr_widths) < 1:
            raise ValueError(f"sr_widths must name one width at least, all above 0, found {self.sr_widths}")
        if self.max_points is not None and self.max_points < 1:
            raise ValueError(f"max_points must be at least 1 or null, found {self.max_points}")
        if not self.unit > 0 or not self.angle_unit > 0:
            raise ValueError(f"unit and angle_unit must be above 0, found {self.unit} and {self.angle_unit}")
        not_negative = (
            *("mouth_points", "start_steps", "expression_noise", "motion_steps", "motion_weight"),
            "appearance_margin",
        )
        for name in not_negative:
            if (getattr(self, name) or 0) < 0:
                raise ValueError(f"{name} must not be negative, found {getattr(self, name)}")

    @property
    def upscale(self) -> int:
        """How many times smaller than the image splats are drawn."""
        return 2 ** (len(self.sr_widths) - 1)
