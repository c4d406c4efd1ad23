"""Presets of GHA that scale with the capture, for CPUs. Light: nothing is imported.

The published design (`config`) splats 32 channels at 512 pixels for images of 2048, with networks of 836,000 numbers
over some 100,000 Gaussians: hours on a GPU. These presets take the capture at its own size, with fewer Gaussians than
it has pixels and networks to match. "demo" and "smoke" are for captures smaller than what the published design splats,
so they splat at the full size, and one block sharpens; "fast" splats at half of it.

What the published method learns of thousands of timesteps, motion in all directions of the expression code, the tracked
head model teaches here (`tracked_motion`), about a neutral head whose mouth is open a little.
"""

from __future__ import annotations

from typing import Any

_SHORT: dict[str, Any] = {
    "start": "mesh",
    "mesh_fraction": 0.12,
    "start_steps": 600,
    "grid_vertices": 12_000,
    "max_points": 8_000,
    "mouth_points": 600,
    "features": 32,
    "channels": 16,
    "geometry_hidden": (64, 64, 64),
    "expression_color_hidden": (64, 64),
    "pose_color_hidden": (32,),
    "expression_deform_hidden": (64, 64, 64),
    "pose_deform_hidden": (64, 64),
    "expression_attribute_hidden": (64, 64),
    "pose_attribute_hidden": (32,),
    "sr_widths": (16,),
    "residual": True,
    "initial_opacity": 0.7,
    "neutral_jaw": 0.15,
    "motion_steps": 1_500,
    "motion_weight": 0.1,
    "appearance_margin": 0.25,
    "at_rest": True,
    "angle_unit": 0.2,
    "expression_noise": 0.1,
    "mesh_views": 2,
    "mesh_size": 96,
    "landmark_weight": 100.0,
    "landmark_timesteps": 1,
    "mesh_lr": 2e-3,
    "network_lr": 5e-4,
    "position_lr": 5e-4,
    "feature_lr": 1e-2,
    "rotation_lr": 5e-3,
    "scale_lr": 1e-2,
    "opacity_lr": 2e-2,
    "final_rate": 0.1,
    "augment": False,
}

GHA_SHORT: dict[str, dict[str, Any]] = {
    "smoke": {
        "budget": {"iterations": 60},
        **_SHORT,
        "max_points": 2_000,
        "start_steps": 200,
        "motion_steps": 200,
    },
    "demo": {"budget": {"iterations": 1_500}, **_SHORT},
    "fast": {"budget": {"iterations": 4_000}, **_SHORT, "max_points": 20_000, "sr_widths": (32, 16)},
}
