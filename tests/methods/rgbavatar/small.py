"""Settings of RGBAvatar for tests: everything that training does, within 24 steps."""

SMALL = {
    "samples": 400,
    "hidden": 8,
    "blendshapes": 3,
    "batch": 4,
    "together": 2,
    "schedule_length": 24,
    "join": 4,
    "position_settles": 12,
    "color_every": 3,
    "final_rate": 0.1,
}
