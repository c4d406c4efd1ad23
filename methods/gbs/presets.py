"""Presets of GaussianBlendshapes. Light: nothing is imported.

A short run has not the 40,000 iterations over which the published differences creep: at their rates they could move by
half a millimetre in 2,000. They are raised to keep the reach of a whole run, the neutral splats start half opaque,
and rates fall at the end as those of the other methods do. Differences of harmonics above degree 0 are most of an
avatar's bytes (45 of 59 numbers) and what so few steps can least learn.
"""

from __future__ import annotations

from typing import Any

_SHORT: dict[str, Any] = {
    "sample_spacing": 2.0,
    "sh_dc_lr": 0.01,
    "sh_rest_lr": 5e-4,
    "difference_sh_degree": 0,
    "difference_position_lr": 1e-5,
    "difference_sh_lr": 0.01,
    "difference_scale_lr": 2e-3,
    "difference_rotation_lr": 1e-3,
    "difference_opacity_lr": 5e-3,
}
_SPLATS: dict[str, Any] = {"initial_opacity": 0.5, "final_rate": 0.1}

GBS_PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {
        "budget": {"iterations": 60},
        **_SHORT,
        "samples": 3_000,
        "teeth_samples": 300,
        "splats": _SPLATS,
    },
    "demo": {
        "budget": {"iterations": 2_000},
        **_SHORT,
        "samples": 12_000,
        "teeth_samples": 600,
        "splats": {**_SPLATS, "max_splats": 20_000},
    },
    "fast": {
        "budget": {"iterations": 10_000},
        **_SHORT,
        "difference_sh_degree": 1,
        "samples": 30_000,
        "teeth_samples": 1_500,
        "splats": {**_SPLATS, "max_splats": 50_000},
    },
    "paper": {
        "budget": {"iterations": 40_000},
        "departures": ("triple_correctives", "blended_lower_teeth"),
    },
}
