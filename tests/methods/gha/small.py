"""GHA made so small that tests train it in a second."""

from headbench.methods.gha.spec import GHAConfig

SMALL = {
    "start": "mesh",
    "start_steps": 20,
    "mesh_fraction": 0.4,
    "grid_vertices": 700,
    "subdivide": False,
    "max_points": 500,
    "mouth_points": 20,
    "features": 8,
    "channels": 6,
    "geometry_hidden": (24, 24),
    "expression_color_hidden": (16,),
    "pose_color_hidden": (16,),
    "expression_deform_hidden": (16, 16),
    "pose_deform_hidden": (16,),
    "expression_attribute_hidden": (16,),
    "pose_attribute_hidden": (8,),
    "sr_widths": (8, 8),
    "mesh_views": 2,
    "checkpoint_every_s": 0.0,
}


def small_config(**more) -> GHAConfig:
    return GHAConfig(**{**SMALL, **more})
