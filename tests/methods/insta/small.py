"""Settings that fit the toy head and train in seconds."""

SMALL = {
    "levels": 4,
    "level_features": 2,
    "log2_table": 10,
    "base_resolution": 4,
    "finest_resolution": 24,
    "hidden": 8,
    "density_layers": 1,
    "color_layers": 1,
    "latent": 4,
    "conditions": 4,
    "density_bias": 3.0,
    "step": 0.004,
    "shell_outside": 0.02,
    "shell_inside": 0.01,
    "occupancy_resolution": 24,
    "occupancy_every": 4,
    "samples_per_iteration": 2_000,
    "first_rays": 128,
    "images_per_iteration": 2,
}
