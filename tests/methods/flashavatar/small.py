"""Settings of a FlashAvatar that trains in a second."""

SMALL = {
    "samples": 400,
    "layers": 2,
    "hidden": 16,
    "frequencies": 2,
    "zero_output": True,
    "offset_m": 0.05,
    "sh_degree": 1,
    "min_sh_every": 8,
}
